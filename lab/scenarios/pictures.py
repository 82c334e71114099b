"""Pictures of scenarios: one of each over time, and one of all of them beside what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.scenarios.judgement import FACTOR, FLOORS, WINDOW_S, Verdict, windows
from lab.scenarios.run import ADAPTIVE, FROZEN, ScenarioRecord
from service.reports.plot_style import MOST_TRACE_POINTS, envelope, traces

#: Colour-blind safe; the adaptive model is the dark one.
ADAPTIVE_COLOUR, FROZEN_COLOUR, ALLOWED_COLOUR, EVENT_COLOUR = "#004d40", "#e69f00", "#999999", "#d55e00"


def draw_course(path: Path, course: ScenarioRecord, verdict: Verdict) -> None:
    """Reference, errors, mean errors of every window beside what is allowed, and what the learner said of samples."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    t_s = np.arange(course.wanted_um.size) * dt
    figure, (top, middle, bottom, gates) = traces(11.0, 9.5, 4, sharex=True, height_ratios=(0.8, 1.2, 1.4, 0.8))
    figure.suptitle(f"{s.name}: {s.text}; {'held' if verdict.held else 'NOT held'}", fontsize=11)
    top.plot(*envelope(t_s, course.wanted_um), color="black", lw=0.6)
    top.set_ylabel("reference, µm")
    for name, colour, front in ((FROZEN, FROZEN_COLOUR, 2), (ADAPTIVE, ADAPTIVE_COLOUR, 3)):
        middle.plot(*envelope(t_s, course.error_um[name] * percent), color=colour, lw=0.6, zorder=front)
    middle.set_ylabel("error, % of range")
    w = windows(course)
    lines = (
        (w.frozen_um, FROZEN_COLOUR, "-", "not adapting"),
        (w.allowed_um, ALLOWED_COLOUR, "--", f"allowed: {FACTOR:g} x that + {FLOORS:g} noise floors"),
        (w.adaptive_um, ADAPTIVE_COLOUR, "-", "adapting"),
    )
    for values, colour, style, label in lines:
        bottom.semilogy(*envelope(w.t_s, np.maximum(values * percent, 1e-4)), style, color=colour, lw=1.2, label=label)
    bottom.plot(verdict.worst_s, verdict.worst_pct, "v", color=EVENT_COLOUR, ms=6, label="closest to the limit")
    bottom.set_ylabel(f"mean |error| over {WINDOW_S:g} s,\n% of range")
    bottom.legend(fontsize=8, ncols=2)
    draw_gates(gates, course.gate, course.gates, t_s)
    gates.set_xlabel("time, s")
    for axes in (top, middle, bottom, gates):
        axes.axvline(s.change_s, color=EVENT_COLOUR, lw=1.0, ls=":")
        axes.margins(x=0)
        axes.grid(True, alpha=0.25)
    figure.align_ylabels()
    figure.savefig(path)


def draw_gates(axes: Any, gate: Any, names: tuple[str, ...], t_s: Any) -> None:
    """A row for each of the learner's answers, marked where it was given."""
    order = sorted(range(len(names)), key=lambda i: names[i] in ("learnt", "passed"))
    for row, index in enumerate(order):
        at = np.flatnonzero(gate == index)
        if at.size == 0:
            continue
        # One mark a bin: thousands of samples make one line.
        bins = np.unique((at * MOST_TRACE_POINTS) // max(1, gate.size)) if gate.size > MOST_TRACE_POINTS else at
        when = t_s[bins * gate.size // MOST_TRACE_POINTS] if gate.size > MOST_TRACE_POINTS else t_s[at]
        axes.plot(when, np.full(when.size, row), "|", ms=6, color="#0072b2")
    axes.set_yticks(range(len(order)), [names[i] for i in order], fontsize=7)
    axes.set_ylim(-0.7, len(order) - 0.3)


def draw_overview(path: Path, verdicts: list[Verdict]) -> None:
    """A bar a scenario: its worst window over what that window allows."""
    figure, axes = traces(9.0, 1.2 + 0.28 * len(verdicts), 1)
    ratios = [v.worst_ratio for v in verdicts]
    colours = [ADAPTIVE_COLOUR if v.held else EVENT_COLOUR for v in verdicts]
    bars = axes.barh(range(len(verdicts)), ratios, color=colours)
    axes.bar_label(bars, labels=[f"{v.worst_ratio:.2f}" for v in verdicts], padding=3, fontsize=8)
    axes.axvline(1.0, color="black", lw=1.0, ls="--")
    axes.set_yticks(range(len(verdicts)), [f"{v.name}: {v.text}" for v in verdicts], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0.0, max(1.15, 1.12 * max(ratios, default=1.0)))
    axes.set_xlabel(f"worst {WINDOW_S:g} s: adaptive error over what is allowed")
    figure.savefig(path)
