"""The picture of a rehearsal: for each event the error of the learning and of the frozen model over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from lab.rehearsal.loop import LoopRecord
from lab.rehearsal.rehearsal import EventRun, Rehearsal, remarks
from service.reports.plot_style import figure, legend, line, save
from service.viewer.colours import ADAPTIVE, EVENT, FROZEN, TROUBLE

#: Time over which the errors are averaged, s.
MEAN_S = 0.02
#: Lower limit of the logarithmic error axis, percent of the range.
LEAST_PCT = 1e-3


def draw_rehearsal(path: Path, rehearsal: Rehearsal) -> None:
    """Write one PNG with one plot per event. Raises OSError from the disk."""
    runs = rehearsal.runs
    drawn, axes = figure(len(runs), 1, (11.0, 1.0 + 1.9 * len(runs)))
    for plot, run in zip(axes[:, 0], runs, strict=True):
        for course, colour, name in ((run.frozen, FROZEN, "frozen"), (run.adaptive, ADAPTIVE, "learning")):
            line(plot, course.t_s, _error_pct(course, run), color=colour, lw=0.9, label=name)
        plot.set_yscale("log")
        plot.axvline(run.event.at_s, color=EVENT, lw=1.0, ls=":")
        if run.event.over_s:
            plot.axvspan(run.event.at_s, run.event.end_s, color=EVENT, alpha=0.08, lw=0)
        said = run.adaptive.trouble > 0
        if said.any():
            plot.plot(run.adaptive.t_s[said], np.full(int(said.sum()), LEAST_PCT), "|", color=TROUBLE, ms=8)
        marks = remarks(run.outcome)
        plot.set_title(run.outcome.text + (f"; {', '.join(marks)}" if marks else ""), fontsize=9, loc="left")
        plot.set_ylabel("|error|, % of range", fontsize=8)
        plot.set_ylim(LEAST_PCT, None)
        plot.margins(x=0)
    legend(axes[0, 0], ncols=2, loc="upper right")
    axes[-1, 0].set_xlabel("time, s; dotted: the event begins; marks at the bottom: the axis reported trouble")
    save(drawn, path)


def _error_pct(course: LoopRecord, run: EventRun) -> FloatArray:
    """(n,) mean absolute error, percent of the range, about each sample."""
    error = 100.0 / run.range_um * np.abs(course.wanted_um - course.true_um)
    window = max(1, round(MEAN_S / (course.t_s[1] - course.t_s[0])))
    return np.maximum(np.convolve(error, np.ones(window) / window, mode="same"), LEAST_PCT)
