"""Turns records into curves, planes and text and draws them on a canvas; it does not know which program draws."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.viewer import style
from dehyst.service.viewer.plane import Plane, grown
from dehyst.service.viewer.records import Diagnostics, Event, Health, IntArray, Record, SceneConfig, Status, Tracking

if TYPE_CHECKING:
    from dehyst.service.viewer.rerun_sink import RerunSink

#: Least time between two drawings of the planes, and distance of the averages, s of the stage's time.
PLANE_EVERY_S: Final = 0.15
MEAN_EVERY_S: Final = 0.05
#: Points of one loop.
LOOP_POINTS: Final = 600
#: A unit whose samples are this far behind the last reference drawn has restarted, s.
REFERENCE_AHEAD_S: Final = 2.0
#: Several events often report one change: within this time after a change they belong to it, s.
CHANGES_APART_S: Final = 5.0
#: Shorter than a sample time, s.
_TINY_S: Final = 1e-9


def numbers(value: Any, dimensions: int = 0) -> FloatArray | None:
    """``value`` of a peer, which may send anything, as float64; None unless it is a number or a list of numbers."""
    try:
        array = np.asarray(value)
    except ValueError:
        return None
    good = array.dtype.kind in "iuf" and array.ndim == dimensions and array.size > 0
    return array.astype(np.float64) if good else None


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


@dataclass(slots=True)
class RecentSamples:
    """The last samples of one unit as rows t_s, u_V, y_um, reference_um, and until when they are drawn, s."""

    rows: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    averaged: float = -math.inf
    plane_s: float = -math.inf

    def averages_due(self, t_s: FloatArray, mae_s: float) -> tuple[FloatArray, FloatArray]:
        """Instants of the newest samples ``t_s`` at which averages are due, s, and the mean |error| before each, µm.

        An instant without a known error in the last ``mae_s`` is left out.
        """
        grid = np.unique(np.ceil(t_s / MEAN_EVERY_S - 1e-6))
        grid = grid[(grid > self.averaged) & (grid <= t_s[-1] / MEAN_EVERY_S + 1e-6)]
        if grid.size:
            self.averaged = grid[-1]
        at_s, size = grid * MEAN_EVERY_S, np.abs(self.rows[:, 3] - self.rows[:, 2])
        known = np.isfinite(size)
        total = np.concatenate([[0.0], np.cumsum(np.where(known, size, 0.0))])
        count = np.concatenate([[0], np.cumsum(known)])
        low, high = (np.searchsorted(self.rows[:, 0], at_s - back_s + _TINY_S, "right") for back_s in (mae_s, 0.0))
        n = count[high] - count[low]
        return at_s[n > 0], (total[high] - total[low])[n > 0] / n[n > 0]


@dataclass(slots=True)
class Scene:
    """Takes records in order of time and draws them on ``canvas``."""

    canvas: RerunSink
    config: SceneConfig
    _recent: dict[str, RecentSamples] = field(init=False, default_factory=dict)
    _reference_um: tuple[float, float] = field(init=False, default=(math.inf, -math.inf))
    _referenced_s: float = field(init=False, default=-math.inf)
    _planes: dict[str, Plane] = field(init=False, default_factory=dict)
    _change_s: float = field(init=False, default=-math.inf)
    _now: FloatArray = field(init=False, default_factory=lambda: np.empty((0, 4)))
    _before: FloatArray = field(init=False, default_factory=lambda: np.empty((0, 4)))
    _counters: dict[str, tuple[float, float]] = field(init=False, default_factory=dict)
    #: Single values of a batch: drawn as columns, because Rerun needs as much time for one row as for a hundred.
    _singles: dict[str, list[tuple[float, int, float]]] = field(init=False, default_factory=lambda: defaultdict(list))

    def take_all(self, records: Iterable[Record]) -> None:
        """Draw a batch of records completely."""
        for record in records:
            if isinstance(record, Tracking):
                self._tracking(record)
                continue
            t_s, seq = record.t_s, record.seq
            if isinstance(record, Diagnostics):
                self._diagnostics(t_s, seq, record.fields)
            elif isinstance(record, Status):
                self.canvas.document(style.STATUS, t_s, seq, as_markdown(self.config.title, record.fields))
            elif isinstance(record, Event):
                if record.change and t_s - self._change_s >= CHANGES_APART_S:
                    self._change_s = t_s
                # The viewer's time column is too narrow to read, so the time is part of the text.
                self.canvas.text(style.EVENTS, t_s, seq, f"{t_s:.3f} s  {record.text}", record.level)
            elif isinstance(record, Health):
                for name, count in record.fields.items():
                    self._single(f"stream/{name}", t_s, seq, count)
        for path, rows in self._singles.items():
            columns = (np.array(column) for column in zip(*rows, strict=True))
            self.canvas.scalars(path, *columns)
        self._singles.clear()

    # -- samples ---------------------------------------------------------------------------------------------

    def _tracking(self, record: Tracking) -> None:
        if not record.seq.size:
            return
        model, t_s, seq, wanted_um = record.model, record.t_s, record.seq, record.reference_um
        main = model == self.config.models[0]
        self._curve(style.DISPLACEMENT.format(model), t_s, seq, record.y_um)
        self._curve(style.VOLTAGE.format(model), t_s, seq, record.u_V)
        self._curve(style.ERROR.format(model), t_s, seq, wanted_um - record.y_um)
        if t_s[-1] < self._referenced_s - REFERENCE_AHEAD_S:
            self._referenced_s = -math.inf
        # All units have the same reference; the first that brings it draws it.
        new, known_um = t_s > self._referenced_s, wanted_um[np.isfinite(wanted_um)]
        self._curve(style.REFERENCE, t_s[new], seq[new], wanted_um[new])
        if np.isfinite(wanted_um[new]).any():
            self._referenced_s = float(t_s[-1])
        if main and record.std_V is not None:
            self._curve(style.BAND_HIGH, t_s, seq, record.u_V + 2.0 * record.std_V)
            self._curve(style.BAND_LOW, t_s, seq, record.u_V - 2.0 * record.std_V)
            self._curve(style.SIGMA, t_s, seq, 1e3 * record.std_V)
        if known_um.size:
            low_um, high_um = self._reference_um
            self._reference_um = min(float(known_um.min()), low_um), max(float(known_um.max()), high_um)
        recent = self._recent.setdefault(model, RecentSamples())
        if len(recent.rows) and t_s[0] < recent.rows[-1, 0]:
            recent = self._recent[model] = RecentSamples()  # The stage has restarted.
        recent.rows = np.concatenate([recent.rows, np.column_stack([t_s, record.u_V, record.y_um, wanted_um])])
        self._mean_errors(record, recent)
        if t_s[-1] - recent.plane_s >= PLANE_EVERY_S - _TINY_S:
            recent.plane_s = float(t_s[-1])
            loop = recent.rows[recent.rows[:, 0] > recent.plane_s - self.config.loop_s]
            self._draw_planes(model, main, loop[:: max(1, len(loop) // LOOP_POINTS)], recent.plane_s, int(seq[-1]))
        keep_s = max(self.config.loop_s, self.config.mae_s + MEAN_EVERY_S)
        recent.rows = recent.rows[recent.rows[:, 0] > t_s[-1] - keep_s]

    def _mean_errors(self, record: Tracking, recent: RecentSamples) -> None:
        range_um = self.config.range_um or self._reference_um[1] - self._reference_um[0]
        if not range_um > 0:
            return
        at_s, mean_um = recent.averages_due(record.t_s, self.config.mae_s)
        seq, mean_pct = np.interp(at_s, record.t_s, record.seq).astype(np.int64), 100.0 / range_um * mean_um
        self._curve(style.MEAN_ERROR.format(record.model), at_s, seq, mean_pct)
        # Rerun has no logarithmic axis, and the models' errors differ by a factor of 100.
        decades = np.log10(np.maximum(mean_pct, 1e-6))
        self._curve(style.MEAN_ERROR_LOG.format(record.model), at_s, seq, decades)

    def _draw_planes(self, model: str, main: bool, rows: FloatArray, at_s: float, seq: int) -> None:
        """Draw the deviation of a unit; of the main one the loop too, and after a change the last loop before it."""
        hue, wanted_um, error_um = style.colour(model), rows[:, 3], rows[:, 3] - rows[:, 2]
        if plane := self._plane(style.DEVIATION_PLANE, wanted_um, error_um, at_s, seq):
            line = [plane.points(wanted_um, error_um)]
            self.canvas.strips(style.DEVIATION.format(model), at_s, seq, line, hue, 0.55 if main else 0.3)
        if not main:
            return
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
        plane = Plane(*style.AXES[name], x_limits, y_limits)
        if old == plane:
            return old
        self._planes[name] = plane
        self.canvas.strips(f"{name}/axes/grid", t_s, seq, plane.frame(), style.FRAME, 0.1)
        where, what = plane.labels()
        self.canvas.points(f"{name}/axes/labels", t_s, seq, where, style.LABEL, 0.01, what)
        return plane

    # -- diagnostics of the learner ------------------------------------------------------------------------------

    def _diagnostics(self, t_s: float, seq: int, fields: Mapping[str, Any]) -> None:
        for name, value in fields.items():
            if name in style.GROUPS:
                for part, figure in value.items() if isinstance(value, Mapping) else ():
                    self._single(style.GROUPS[name].format(part), t_s, seq, figure)
                    if name == "counters":
                        self._rate(str(part), t_s, seq, figure)
            elif name not in ("seq", "t_s"):
                self._single(style.FIGURES.get(name, f"learner/{name}"), t_s, seq, value)
        std_V, u_V = numbers(fields.get("std_V")), numbers(fields.get("u_V"))
        recent = self._recent.get(self.config.models[0])
        if u_V is None and recent is not None and len(recent.rows):
            u_V = np.asarray(np.interp(t_s, recent.rows[:, 0], recent.rows[:, 1]))
        if std_V is not None:
            self._single(style.SIGMA, t_s, seq, 1e3 * std_V)
            if u_V is not None:
                self._single(style.BAND_HIGH, t_s, seq, u_V + 2.0 * std_V)
                self._single(style.BAND_LOW, t_s, seq, u_V - 2.0 * std_V)
        y_um, v_um_per_s = (numbers(fields.get(name), 1) for name in ("window_y_um", "window_v_um_per_s"))
        if y_um is not None and v_um_per_s is not None and y_um.size == v_um_per_s.size:
            plane = self._plane(style.WINDOW_PLANE, y_um, v_um_per_s, t_s, seq)
            if plane is not None:
                hue = style.colour(self.config.models[0])
                self.canvas.points(style.WINDOW_POINTS, t_s, seq, plane.points(y_um, v_um_per_s), hue, 0.7)

    def _rate(self, name: str, t_s: float, seq: int, value: Any) -> None:
        """The rate of a count over at least the last second, so that the curve is smooth enough to read."""
        count = numbers(value)
        if count is None:
            return
        since_s, before = self._counters.setdefault(name, (t_s, float(count)))
        if t_s - since_s >= 1.0:
            self._single(f"rate/{name}", t_s, seq, (count - before) / (t_s - since_s))
        if t_s - since_s >= 1.0 or t_s < since_s or count < before:  # The service has restarted.
            self._counters[name] = (t_s, float(count))

    def _curve(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None:
        known = np.isfinite(values)
        if known.any():
            self.canvas.scalars(path, t_s[known], seq[known], values[known])

    def _single(self, path: str, t_s: float, seq: int, value: Any) -> None:
        got = numbers(value)
        if got is not None and np.isfinite(got):
            self._singles[path].append((t_s, seq, float(got)))
