"""Turns records into curves, planes and text and draws them on a canvas; it does not know which program draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.viewer import style
from dehyst.service.viewer.plane import Plane, grown
from dehyst.service.viewer.records import (
    Diagnostics,
    Event,
    Health,
    IntArray,
    Record,
    SceneConfig,
    Status,
    Tracking,
)


class Canvas(Protocol):
    """Draws curves, planes and text. Times are those of the stage, s; ``seq`` is the number of the newest sample."""

    def scalars(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None: ...
    def strips(
        self, path: str, t_s: float, seq: int, strips: Sequence[FloatArray], colour: style.Colour, radius: float
    ) -> None: ...
    def points(
        self,
        path: str,
        t_s: float,
        seq: int,
        positions: FloatArray,
        colour: style.Colour,
        radius: float,
        labels: Sequence[str] | None = None,
    ) -> None: ...
    def text(self, path: str, t_s: float, seq: int, text: str, level: str) -> None: ...
    def document(self, path: str, t_s: float, seq: int, markdown: str) -> None: ...


# --- JSON values of a peer, which may contain anything


def number(value: Any) -> float | None:
    """``value`` as a finite float, or None if it is none."""
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        value = float(value)
    except OverflowError:  # JSON allows integers of any length.
        return None
    return value if math.isfinite(value) else None


def column(value: Any) -> FloatArray | None:
    """``value`` as (n,) float64 if it is a list of numbers, else None."""
    if not isinstance(value, (list, tuple, np.ndarray)) or not len(value):
        return None
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.ndim == 1 else None


def as_markdown(title: str, fields: Mapping[str, Any], depth: int = 2) -> str:
    """A status as a Markdown table; nested names are joined by dots, long values are cut."""
    rows: list[str] = []

    def walk(prefix: str, part: Mapping[str, Any], left: int) -> None:
        for name, value in part.items():
            if isinstance(value, Mapping) and left:
                walk(f"{prefix}{name}.", value, left - 1)
            else:
                shown = f"{value:.6g}" if isinstance(value, float) else str(value)
                rows.append(f"| {prefix}{name} | {shown[:80].replace('|', '/')} |")

    walk("", fields, depth)
    return "\n".join([f"**{title}**", "", "| what | value |", "|---|---|", *rows])


# --- The recent samples of a unit

#: Period of drawing the planes and the averages, s of the stage's time.
PLANE_EVERY_S = 0.25
MEAN_EVERY_S = 0.05


@dataclass(slots=True)
class RecentSamples:
    """The last samples of one unit, with columns t_s, u_V, y_um, reference_um, and what of them is due to be drawn."""

    rows: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    next_mean_s: float = -math.inf
    next_plane_s: float = -math.inf

    def add(self, record: Tracking) -> None:
        """Append the samples of ``record``, which are later than all before."""
        self.rows = np.concatenate(
            [self.rows, np.column_stack([record.t_s, record.u_V, record.y_um, record.reference_um])]
        )

    def forget(self, before_s: float) -> None:
        """Drop the samples up to ``before_s``."""
        self.rows = self.rows[self.rows[:, 0] > before_s]

    def loops_due(self, record: Tracking, loop_s: float) -> Iterator[tuple[float, FloatArray]]:
        """Instants of ``record`` at which planes are due, s, with the rows of the last ``loop_s`` before each."""
        # Every PLANE_EVERY_S, however long the record is (offline it holds a whole run).
        first, last = float(record.t_s[0]), float(record.t_s[-1])
        due = max(self.next_plane_s, math.ceil(first / PLANE_EVERY_S - 1e-6) * PLANE_EVERY_S)
        while due <= last:
            start, stop = np.searchsorted(self.rows[:, 0], [due - loop_s, due], side="right")
            if stop > start:
                yield due, self.rows[start:stop]
            due = (math.floor(due / PLANE_EVERY_S + 1e-6) + 1) * PLANE_EVERY_S
            if stop < len(self.rows):  # No planes for a time without samples.
                due = max(due, math.ceil(self.rows[stop, 0] / PLANE_EVERY_S - 1e-6) * PLANE_EVERY_S)
        self.next_plane_s = due

    def mean_errors_due(self, record: Tracking, mae_s: float, range_um: float) -> tuple[FloatArray, FloatArray]:
        """Instants of ``record`` at which averages are due, s, and the mean |error| of the last ``mae_s``, % of range.

        Instants without a known error before them are left out.
        """
        t_s, size = self.rows[:, 0], np.abs(self.rows[:, 3] - self.rows[:, 2])
        known = np.isfinite(size)
        total = np.concatenate([[0.0], np.cumsum(np.where(known, size, 0.0))])
        count = np.concatenate([[0], np.cumsum(known)])
        start = max(self.next_mean_s, float(record.t_s[0]))
        at_s = np.unique(np.ceil(record.t_s / MEAN_EVERY_S - 1e-6))
        last = math.floor(record.t_s[-1] / MEAN_EVERY_S + 1e-6)
        at_s = at_s[(at_s >= math.ceil(start / MEAN_EVERY_S - 1e-6)) & (at_s <= last)]
        self.next_mean_s = (at_s[-1] + 1) * MEAN_EVERY_S if at_s.size else start
        at_s = at_s * MEAN_EVERY_S
        high = np.searchsorted(t_s, at_s + 1e-9, side="right")
        low = np.searchsorted(t_s, at_s - mae_s + 1e-9, side="right")
        n = count[high] - count[low]
        some = n > 0
        return at_s[some], 100.0 / range_um * (total[high] - total[low])[some] / n[some]


#: Points of one loop; the loop is sent again every PLANE_EVERY_S.
LOOP_POINTS = 600
#: A unit whose samples are this far behind the last reference drawn has restarted, s.
REFERENCE_AHEAD_S = 2.0
#: Single values are sent in columns of so many rows: Rerun needs as much time for one row as for a hundred.
SINGLES = 64
#: Several events often report one change: within this time after a change they belong to it, s.
CHANGES_APART_S = 5.0


@dataclass(slots=True)
class Scene:
    """Takes records in order of time and draws them on ``canvas``."""

    canvas: Canvas
    config: SceneConfig
    t_s: float = field(init=False, default=0.0)
    seq: int = field(init=False, default=0)
    _trails: dict[str, RecentSamples] = field(init=False, default_factory=dict)
    _reference_limits: tuple[float, float] | None = field(init=False, default=None)
    _referenced_s: float = field(init=False, default=-math.inf)
    _planes: dict[str, Plane] = field(init=False, default_factory=dict)
    _change_s: float = field(init=False, default=-math.inf)
    _now: FloatArray = field(init=False, default_factory=lambda: np.empty((0, 3)))
    _before: FloatArray = field(init=False, default_factory=lambda: np.empty((0, 3)))
    _counters: dict[str, tuple[float, float]] = field(init=False, default_factory=dict)
    _singles: dict[str, list[tuple[float, int, float]]] = field(init=False, default_factory=dict)

    def take_all(self, records: Iterable[Record]) -> None:
        """Draw a batch of records completely."""
        for record in records:
            self.take(record)
        self.flush()

    def flush(self) -> None:
        """Draw the single values collected so far."""
        for path in list(self._singles):
            self._flush(path)

    def take(self, record: Record) -> None:
        """Draw one record. Single values may wait for more of their kind until `flush`."""
        if isinstance(record, Tracking):
            self._tracking(record)
        elif isinstance(record, Diagnostics):
            self._diagnostics(record)
        elif isinstance(record, Status):
            self.canvas.document(style.STATUS, record.t_s, record.seq, as_markdown(self.config.title, record.fields))
        elif isinstance(record, Event):
            if record.change and record.t_s - self._change_s >= CHANGES_APART_S:
                self._change_s = record.t_s
            # The viewer's time column is too narrow to read, so the time is part of the text.
            self.canvas.text(style.EVENTS, record.t_s, record.seq, f"{record.t_s:.3f} s  {record.text}", record.level)
        elif isinstance(record, Health):
            for name, count in record.counts.items():
                self._one(f"stream/{name}", record.t_s, record.seq, float(count))

    # -- samples ---------------------------------------------------------------------------------------------

    def _tracking(self, record: Tracking) -> None:
        if not record.seq.size:
            return
        model, t_s, seq = record.model, record.t_s, record.seq
        main = model == self.config.models[0]
        self._columns(style.displacement(model), t_s, seq, record.y_um)
        self._columns(style.voltage(model), t_s, seq, record.u_V)
        self._columns(style.error(model), t_s, seq, record.reference_um - record.y_um)
        if t_s[-1] < self._referenced_s - REFERENCE_AHEAD_S:
            self._referenced_s = -math.inf
        new = t_s > self._referenced_s
        if new.any():
            # All units have the same reference; the first that brings it draws it.
            self._columns(style.REFERENCE, t_s[new], seq[new], record.reference_um[new])
            if np.isfinite(record.reference_um[new]).any():
                self._referenced_s = float(t_s[-1])
        if main:
            self.t_s, self.seq = float(t_s[-1]), int(seq[-1])
            if record.std_V is not None:
                self._columns(style.BAND_HIGH, t_s, seq, record.u_V + 2.0 * record.std_V)
                self._columns(style.BAND_LOW, t_s, seq, record.u_V - 2.0 * record.std_V)
                self._columns(style.SIGMA, t_s, seq, 1e3 * record.std_V)
        finite = record.reference_um[np.isfinite(record.reference_um)]
        if finite.size:
            low, high = float(finite.min()), float(finite.max())
            old = self._reference_limits or (low, high)
            self._reference_limits = min(low, old[0]), max(high, old[1])
        self._trail(record, main)

    def _trail(self, record: Tracking, main: bool) -> None:
        """Draw averages and planes, at their own pace, from the recent samples of the unit."""
        trail = self._trails.setdefault(record.model, RecentSamples())
        if len(trail.rows) and record.t_s[0] < trail.rows[-1, 0]:
            trail = self._trails[record.model] = RecentSamples()  # The stage has restarted.
        trail.add(record)
        self._mean_errors(record, trail)
        for due, rows in trail.loops_due(record, self.config.loop_s):
            self._draw_planes(record, main, rows, due)
        keep_s = max(self.config.loop_s, self.config.mae_s) + 2 * PLANE_EVERY_S
        trail.forget(float(record.t_s[-1]) - keep_s)

    def _mean_errors(self, record: Tracking, trail: RecentSamples) -> None:
        range_um = self.config.range_um
        if range_um is None and self._reference_limits is not None:
            range_um = self._reference_limits[1] - self._reference_limits[0]
        if not range_um or range_um <= 0:
            return
        at_s, mean_pct = trail.mean_errors_due(record, self.config.mae_s, range_um)
        if at_s.size:
            seq = np.interp(at_s, record.t_s, record.seq).astype(np.int64)
            self.canvas.scalars(style.mean_error(record.model), at_s, seq, mean_pct)
            # Rerun has no logarithmic axis, and the models' errors differ by a factor of 100.
            decades = np.log10(np.maximum(mean_pct, 1e-6))
            self.canvas.scalars(style.mean_error_log(record.model), at_s, seq, decades)

    def _draw_planes(self, record: Tracking, main: bool, rows: FloatArray, at_s: float) -> None:
        seq = int(np.interp(at_s, record.t_s, record.seq))
        hue = style.colour(record.model)
        rows = rows[:: max(1, len(rows) // LOOP_POINTS)]
        y_um, wanted_um = rows[:, 2], rows[:, 3]
        plane = self._plane(style.DEVIATION_PLANE, wanted_um, wanted_um - y_um, at_s, seq)
        if plane is not None:
            line = [plane.points(wanted_um, wanted_um - y_um)]
            self.canvas.strips(style.deviation(record.model), at_s, seq, line, hue, 0.55 if main else 0.3)
        if not main:
            return
        self._loops(rows[:, :3], hue, at_s, seq)

    def _loops(self, rows: FloatArray, hue: style.Colour, at_s: float, seq: int) -> None:
        """Draw the present loop and, after a change of the stage, the last loop before it."""
        old = self._planes.get(style.LOOP_PLANE)
        plane = self._plane(style.LOOP_PLANE, rows[:, 1], rows[:, 2], at_s, seq)
        if plane is None:
            return
        changed = len(self._now) > 0 and self._now[0, 0] < self._change_s <= at_s
        if changed:
            # The event may arrive late: drop the part of the last loop that is after the change.
            self._before = self._now[self._now[:, 0] < self._change_s]
        if len(self._before) and (changed or plane is not old):
            line = [plane.points(self._before[:, 1], self._before[:, 2])]
            self.canvas.strips(style.LOOP_BEFORE, at_s, seq, line, style.AMBER, 0.5)
        self._now = rows if at_s < self._change_s else rows[rows[:, 0] >= self._change_s]
        self.canvas.strips(style.LOOP_NOW, at_s, seq, [plane.points(self._now[:, 1], self._now[:, 2])], hue, 0.4)

    def _plane(self, name: str, x: FloatArray, y: FloatArray, t_s: float, seq: int) -> Plane | None:
        """The axes that contain these data, drawn again when they have to grow; None while nothing is finite."""
        old = self._planes.get(name)
        x_limits = grown(old.x_limits if old else None, x)
        y_limits = grown(old.y_limits if old else None, y)
        if x_limits is None or y_limits is None:
            return None
        if old is not None and (x_limits, y_limits) == (old.x_limits, old.y_limits):
            return old
        titles = {
            style.LOOP_PLANE: ("voltage, V", "displacement, µm"),
            style.DEVIATION_PLANE: ("wanted, µm", "error, µm"),
            style.WINDOW_PLANE: ("displacement, µm", "velocity, µm/s"),
        }
        plane = self._planes[name] = Plane(*titles[name], x_limits, y_limits)
        self.canvas.strips(f"{name}/axes/grid", t_s, seq, plane.frame(), style.FRAME, 0.1)
        where, what = plane.labels()
        self.canvas.points(f"{name}/axes/labels", t_s, seq, where, style.LABEL, 0.01, what)
        return plane

    # -- diagnostics of the learner ------------------------------------------------------------------------------

    def _diagnostics(self, record: Diagnostics) -> None:
        t_s, seq, fields = record.t_s, record.seq, record.fields
        for name, value in fields.items():
            if name in ("seq", "t_s"):
                continue
            if name in ("gain", "offset_V"):
                self._one(f"drift/{name}", t_s, seq, value)
            elif name == "query_us":
                for part, us in value.items() if isinstance(value, Mapping) else ():
                    self._one(f"latency/{part}_us", t_s, seq, us)
            elif name == "counters":
                for part, count in value.items() if isinstance(value, Mapping) else ():
                    self._counter(str(part), t_s, seq, count)
            else:
                self._one(f"learner/{name}", t_s, seq, value)
        std_V, u_V = number(fields.get("std_V")), number(fields.get("u_V"))
        if std_V is not None:
            self._one(style.SIGMA, t_s, seq, 1e3 * std_V)
        if u_V is None:
            trail = self._trails.get(self.config.models[0])
            u_V = float(np.interp(t_s, trail.rows[:, 0], trail.rows[:, 1])) if trail and len(trail.rows) else None
        if std_V is not None and u_V is not None:
            self._one(style.BAND_HIGH, t_s, seq, u_V + 2.0 * std_V)
            self._one(style.BAND_LOW, t_s, seq, u_V - 2.0 * std_V)
        y_um, v_um_per_s = column(fields.get("window_y_um")), column(fields.get("window_v_um_per_s"))
        if y_um is not None and v_um_per_s is not None and y_um.size == v_um_per_s.size:
            plane = self._plane(style.WINDOW_PLANE, y_um, v_um_per_s, t_s, seq)
            if plane is not None:
                hue = style.colour(self.config.models[0])
                self.canvas.points(style.WINDOW_POINTS, t_s, seq, plane.points(y_um, v_um_per_s), hue, 0.7)

    def _counter(self, name: str, t_s: float, seq: int, value: Any) -> None:
        """A count, and its rate over at least the last second so that the curve is smooth enough to read."""
        count = number(value)
        if count is None:
            return
        self._one(f"counter/{name}", t_s, seq, count)
        since_s, before = self._counters.setdefault(name, (t_s, count))
        if t_s - since_s >= 1.0:
            self._one(f"rate/{name}", t_s, seq, (count - before) / (t_s - since_s))
            self._counters[name] = (t_s, count)
        elif t_s < since_s or count < before:  # The service has restarted.
            self._counters[name] = (t_s, count)

    def _columns(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None:
        known = np.isfinite(values)
        if known.all():
            self.canvas.scalars(path, t_s, seq, values)
        elif known.any():
            self.canvas.scalars(path, t_s[known], seq[known], values[known])

    def _one(self, path: str, t_s: float, seq: int, value: Any) -> None:
        got = number(value)
        if got is not None:
            rows = self._singles.setdefault(path, [])
            rows.append((t_s, seq, got))
            if len(rows) >= SINGLES:
                self._flush(path)

    def _flush(self, path: str) -> None:
        t_s, seq, values = zip(*self._singles.pop(path), strict=True)
        self.canvas.scalars(path, np.array(t_s), np.array(seq, dtype=np.int64), np.array(values))
