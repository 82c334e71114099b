"""A rehearsal drawn: for each event the error over time, of the learning and of the frozen model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from lab.rehearsal.loop import LoopRecord
from lab.rehearsal.rehearsal import EventRun, Rehearsal, remarks
from service.reports.plot_style import envelope, traces

#: Colour-blind safe; the learning model is the dark one.
ADAPTIVE_COLOUR, FROZEN_COLOUR, EVENT_COLOUR, TROUBLE_COLOUR = "#004d40", "#e69f00", "#d55e00", "#cc79a7"
#: What the errors are averaged over, s.
MEAN_S = 0.02
#: Errors below this, percent of the range, are drawn as this: the axis is logarithmic.
LEAST_PCT = 1e-3


def draw_rehearsal(path: Path, rehearsal: Rehearsal) -> None:
    """Write one PNG, a plot an event below each other. Raises OSError from the disk."""
    runs = rehearsal.runs
    figure, axes = traces(11.0, 1.0 + 1.9 * len(runs), len(runs), squeeze=False)
    for plot, run in zip(axes[:, 0], runs, strict=True):
        for course, colour, label in (
            (run.frozen, FROZEN_COLOUR, "frozen"), (run.adaptive, ADAPTIVE_COLOUR, "learning")
        ):  # fmt: skip
            plot.semilogy(*envelope(course.t_s, _error_pct(course, run)), color=colour, lw=0.9, label=label)
        plot.axvline(run.event.at_s, color=EVENT_COLOUR, lw=1.0, ls=":")
        if run.event.over_s:
            plot.axvspan(run.event.at_s, run.event.end_s, color=EVENT_COLOUR, alpha=0.08, lw=0)
        said = run.adaptive.trouble > 0
        if said.any():
            plot.plot(run.adaptive.t_s[said], np.full(int(said.sum()), LEAST_PCT), "|", color=TROUBLE_COLOUR, ms=8)
        marks = remarks(run.outcome)
        plot.set_title(run.outcome.text + (f"; {', '.join(marks)}" if marks else ""), fontsize=9, loc="left")
        plot.set_ylabel("|error|, % of range", fontsize=8)
        plot.set_ylim(LEAST_PCT, None)
        plot.margins(x=0)
        plot.grid(True, alpha=0.25)
    axes[0, 0].legend(fontsize=8, ncols=2, loc="upper right")
    axes[-1, 0].set_xlabel("time, s; dotted: the event begins; marked below: the axis said that something is wrong")
    figure.savefig(path)


def _error_pct(course: LoopRecord, run: EventRun) -> FloatArray:
    """(n,) mean absolute error, percent of the range, about each sample."""
    error = 100.0 / run.range_um * np.abs(course.wanted_um - course.true_um)
    window = max(1, round(MEAN_S / (course.t_s[1] - course.t_s[0])))
    return np.maximum(np.convolve(error, np.ones(window) / window, mode="same"), LEAST_PCT)
