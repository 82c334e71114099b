"""Judges scenarios: in no half second may adapting be worse than not adapting. Table, JSON and pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive.types import FloatArray
from lab.scenarios.run import ADAPTIVE, FROZEN, ScenarioRecord
from service.reports.plot_style import MOST_POINTS, figure, legend, line, save
from service.viewer.colours import DIAGNOSTIC, EVENT, LIMIT, REFERENCE, model_colour

# --- Judges scenarios: in no half second may adapting be worse than not adapting. Table and JSON.

#: In every window of this length, s, the adaptive mean absolute error may be at most ...
WINDOW_S: Final = 0.5
#: ... this many times the frozen model's ...
FACTOR: Final = 1.1
#: ... plus this many noise floors.
FLOORS: Final = 3.0
#: Length of "settled" at the end of the run, and of "before" just before the change, s.
SETTLED_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a scenario; errors are mean absolute errors in percent of the commanded range.

    Attributes
    ----------
    before_pct, first_second_pct, settled_pct : of the adaptive model, before the change (up to 10 s), in the first
    second, and at the end (10 s); ``frozen_*`` of the model that does not adapt.
    worst_ratio : largest error of a window over what that window allows; held if at most 1.
    worst_s : middle of that window, s. worst_pct, worst_frozen_pct : the two errors in it.
    broken_share : share of all windows above what they allow.
    floor_pct : noise floor at the end.
    """

    name: str
    kind: str
    seed: int
    text: str
    before_pct: float
    first_second_pct: float
    settled_pct: float
    frozen_before_pct: float
    frozen_first_second_pct: float
    frozen_settled_pct: float
    worst_ratio: float
    worst_s: float
    worst_pct: float
    worst_frozen_pct: float
    broken_share: float
    floor_pct: float
    held: bool
    verdicts: dict[str, int]
    counters: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {key: round(value, 6) if isinstance(value, float) else value for key, value in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class Windows:
    """Mean absolute errors of every window, µm; ``t_s`` is the middle of a window."""

    t_s: FloatArray
    adaptive_um: FloatArray
    frozen_um: FloatArray
    allowed_um: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Adaptive error over what is allowed."""
        return self.adaptive_um / self.allowed_um


def windows(course: ScenarioRecord) -> Windows:
    """All windows: one begins at each sample."""
    dt = course.scenario.stage.dt_s
    span = max(1, round(WINDOW_S / dt))

    def moving(values: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(values)])
        means: FloatArray = (total[span:] - total[:-span]) / span
        return means

    adaptive, frozen = (moving(np.abs(course.error_um[name])) for name in (ADAPTIVE, FROZEN))
    t_s: FloatArray = ((np.arange(adaptive.size) + 0.5 * span) * dt).astype(np.float64)
    return Windows(t_s, adaptive, frozen, FACTOR * frozen + FLOORS * moving(course.floor_um))


def judge(course: ScenarioRecord) -> Verdict:
    """The verdict on a scenario."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    w = windows(course)
    worst = int(np.argmax(w.ratio))
    # A dwell is judged by its strokes: "before" is the motion before the rest.
    change = round((s.quiet_s[0] if s.quiet_s else s.change_s) / dt)
    begin = round(s.change_s / dt)
    settled = round(SETTLED_S / dt)
    parts = {
        "before": slice(max(0, change - settled), change),
        "first_second": slice(begin, begin + round(1.0 / dt)),
        "settled": slice(-settled, None),
    }
    errors = {
        f"{prefix}{part}_pct": float(np.mean(np.abs(course.error_um[name][where]))) * percent
        for prefix, name in (("", ADAPTIVE), ("frozen_", FROZEN))
        for part, where in parts.items()
    }
    ratio = float(w.ratio[worst])
    return Verdict(
        name=s.name,
        kind=s.kind,
        seed=s.seed,
        text=s.text,
        **errors,
        worst_ratio=ratio,
        worst_s=float(w.t_s[worst]),
        worst_pct=float(w.adaptive_um[worst]) * percent,
        worst_frozen_pct=float(w.frozen_um[worst]) * percent,
        broken_share=float(np.mean(w.ratio > 1.0)),
        floor_pct=float(course.floor_um[-1]) * percent,
        held=ratio <= 1.0,
        verdicts=dict(sorted(course.verdicts.items())),
        counters=course.counters,
    )


def table(verdicts: list[Verdict], markdown: bool = False) -> str:
    """One row per scenario; ``markdown`` for a page."""
    head = (
        "scenario",
        "what happens",
        "before",
        "first 1 s",
        "settled",
        "frozen settled",
        "worst / allowed",
        "at",
        "held",
    )
    rows = [head]
    for v in verdicts:
        rows.append(
            (
                v.name, v.text, f"{v.before_pct:.3f}", f"{v.first_second_pct:.3f}", f"{v.settled_pct:.3f}",
                f"{v.frozen_settled_pct:.3f}", f"{v.worst_ratio:.2f}", f"{v.worst_s:.1f} s", "yes" if v.held else "NO",
            )
        )  # fmt: skip
    if markdown:
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        lines.insert(1, "|" + "---|" * len(head))
        return "\n".join(lines)
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    cells = [
        "  ".join(
            text.ljust(w) if i < 2 else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    held = sum(v.held for v in verdicts)
    cells.insert(1, "-" * len(cells[0]))
    cells.append(
        f"errors: mean absolute, % of the commanded range; allowed in every {WINDOW_S:g} s: {FACTOR:g} x the frozen "
        f"model's + {FLOORS:g} noise floors"
    )
    cells.append(f"held in {held} of {len(verdicts)} scenarios")
    return "\n".join(cells)


# --- Pictures of scenarios: each one over time, and all of them against the allowed error.


def draw_course(path: Path, course: ScenarioRecord, verdict: Verdict) -> None:
    """Reference, errors, mean error and allowed error of every window, and the learner's answers to samples."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    t_s = np.arange(course.wanted_um.size) * dt
    title = f"{s.name}: {s.text}; {'held' if verdict.held else 'NOT held'}"
    drawn, axes = figure(4, 1, (11.0, 9.5), title, sharex=True, height_ratios=(0.8, 1.2, 1.4, 0.8))
    top, middle, bottom, gates = axes[:, 0]
    line(top, t_s, course.wanted_um, color=REFERENCE, lw=0.6)
    top.set_ylabel("reference, µm")
    for name, front in ((FROZEN, 2), (ADAPTIVE, 3)):
        line(middle, t_s, course.error_um[name] * percent, color=model_colour(name), lw=0.6, zorder=front)
    middle.set_ylabel("error, % of range")
    w = windows(course)
    lines = (
        (w.frozen_um, model_colour(FROZEN), "-", "not adapting"),
        (w.allowed_um, LIMIT, "--", f"allowed: {FACTOR:g} x that + {FLOORS:g} noise floors"),
        (w.adaptive_um, model_colour(ADAPTIVE), "-", "adapting"),
    )
    for values, colour, style, text in lines:
        line(bottom, w.t_s, np.maximum(values * percent, 1e-4), color=colour, ls=style, lw=1.2, label=text)
    bottom.set_yscale("log")
    bottom.plot(verdict.worst_s, verdict.worst_pct, "v", color=EVENT, ms=6, label="closest to the limit")
    bottom.set_ylabel(f"mean |error| over {WINDOW_S:g} s,\n% of range")
    legend(bottom, ncols=2)
    draw_gates(gates, course.gate, course.gates, t_s)
    gates.set_xlabel("time, s")
    for axis in (top, middle, bottom, gates):
        axis.axvline(s.change_s, color=EVENT, lw=1.0, ls=":")
        axis.margins(x=0)
    save(drawn, path)


def draw_gates(axes: Any, gate: Any, names: tuple[str, ...], t_s: Any) -> None:
    """One row per kind of answer of the learner, marked where it was given."""
    order = sorted(range(len(names)), key=lambda i: names[i] in ("learnt", "passed"))
    for row, index in enumerate(order):
        at = np.flatnonzero(gate == index)
        if at.size == 0:
            continue
        # At most one mark per bin.
        bins = np.unique((at * MOST_POINTS) // max(1, gate.size)) if gate.size > MOST_POINTS else at
        when = t_s[bins * gate.size // MOST_POINTS] if gate.size > MOST_POINTS else t_s[at]
        axes.plot(when, np.full(when.size, row), "|", ms=6, color=DIAGNOSTIC)
    axes.set_yticks(range(len(order)), [names[i] for i in order], fontsize=7)
    axes.set_ylim(-0.7, len(order) - 0.3)


def draw_overview(path: Path, verdicts: list[Verdict]) -> None:
    """One bar per scenario: the error of its worst window relative to the allowed error."""
    drawn, grid = figure(1, 1, (9.0, 1.2 + 0.28 * len(verdicts)))
    axes = grid[0, 0]
    ratios = [v.worst_ratio for v in verdicts]
    colours = [model_colour(ADAPTIVE) if v.held else EVENT for v in verdicts]
    bars = axes.barh(range(len(verdicts)), ratios, color=colours)
    axes.bar_label(bars, labels=[f"{v.worst_ratio:.2f}" for v in verdicts], padding=3, fontsize=8)
    axes.axvline(1.0, color="black", lw=1.0, ls="--")
    axes.set_yticks(range(len(verdicts)), [f"{v.name}: {v.text}" for v in verdicts], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0.0, max(1.15, 1.12 * max(ratios, default=1.0)))
    axes.set_xlabel(f"worst {WINDOW_S:g} s: adaptive error / allowed error")
    save(drawn, path)
