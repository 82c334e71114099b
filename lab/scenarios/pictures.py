"""Pictures of scenarios: each one over time, and all of them against the allowed error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.scenarios.judgement import FACTOR, FLOORS, WINDOW_S, Verdict, windows
from lab.scenarios.run import ADAPTIVE, FROZEN, ScenarioRecord
from service.reports.plot_style import MOST_POINTS, figure, legend, line, save
from service.viewer.colours import DIAGNOSTIC, EVENT, LIMIT, REFERENCE, model_colour


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
