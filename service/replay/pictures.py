"""Pictures of a replay: errors of the prediction over time, the learner's diagnostics, and its answers to samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from service.replay.replay import Replayed, covered
from service.reports.plot_style import envelope, figure, legend, line, save
from service.viewer.colours import ADAPTIVE, DIAGNOSTIC, FROZEN, MEASURED, NOISE_BAND

#: Diagnostics of the learner that are drawn, in this order, where it has them.
SHOWN = (("gain", "gain"), ("frame_offset_um", "offset of the frame, µm"), ("offset_V", "offset, V"))


def _moving(values: FloatArray, span: int) -> FloatArray:
    """(n,) mean of the finite values over the last ``span`` samples; NaN if there are none."""
    good = np.isfinite(values)
    total, count = np.cumsum(np.where(good, values, 0.0)), np.cumsum(good)
    total[span:], count[span:] = total[span:] - total[:-span], count[span:] - count[:-span]
    mean: FloatArray = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def draw_errors(path: Path, title: str, replayed: Replayed, span_V: float, window_s: float) -> None:
    """Motion, errors with the stated uncertainty, their moving mean, and the learner's diagnostics."""
    r, percent = replayed, 100.0 / span_V
    dt = float(np.median(np.diff(r.t_s)))
    shown = [(key, label) for key, label in SHOWN if key in r.notes]
    heights = (0.8, 1.4, 1.4, *[0.6] * len(shown))
    drawn, axes = figure(len(heights), 1, (11.0, 8.0 + 1.3 * len(shown)), title, sharex=True, height_ratios=heights)
    grid = axes[:, 0]
    top, middle, bottom = grid[:3]
    line(top, r.t_s, r.y_um, color=MEASURED, lw=0.6)
    top.set_ylabel("reading, µm")
    line(middle, r.t_s, r.frozen_V * percent, color=FROZEN, lw=0.6, label="not adapting")
    t_std, std = envelope(r.t_s, r.std_V * percent)
    middle.fill_between(t_std, -2.0 * std, 2.0 * std, color=NOISE_BAND, alpha=0.5, lw=0, label="± 2 stated deviations")
    line(middle, r.t_s, r.adaptive_V * percent, color=ADAPTIVE, lw=0.6, label="adapting")
    shares = covered(r)
    middle.set_title(
        f"errors within one stated deviation: {100 * shares['one_std']:.0f} % (68 stated), "
        f"within two: {100 * shares['two_std']:.0f} % (95 stated)",
        fontsize=9,
    )
    middle.set_ylabel("predicted less applied,\n% of voltage span")
    legend(middle, ncols=3, loc="upper right")
    span = max(1, round(window_s / dt))
    for values, colour, label in (
        (r.frozen_V, FROZEN, "not adapting"),
        (r.adaptive_V, ADAPTIVE, "adapting"),
    ):
        running = np.maximum(_moving(np.abs(values), span) * percent, 1e-5)
        line(bottom, r.t_s, running, color=colour, lw=1.3, label=label)
    bottom.set_yscale("log")
    bottom.grid(True, which="both", alpha=0.25)
    bottom.set_ylabel(f"mean |error| of the last {window_s:g} s,\n% of voltage span")
    legend(bottom, loc="upper right")
    for axis, (key, label) in zip(grid[3:], shown, strict=True):
        axis.plot(r.note_t_s, r.notes[key], color=DIAGNOSTIC, lw=1.0)
        axis.set_ylabel(label, fontsize=8)
    for axis in grid:
        axis.margins(x=0)
    grid[-1].set_xlabel("time, s")
    save(drawn, path)


def draw_gates(path: Path, title: str, replayed: Replayed, bins: int = 300) -> None:
    """For each kind of answer of the learner the share of samples that got it, over time."""
    r = replayed
    t_s = r.row_t_s
    finite = np.isfinite(t_s)
    low, high = float(t_s[finite].min()), float(t_s[finite].max())
    edges = np.linspace(low, high if high > low else low + 1.0, min(bins, max(2, t_s.size // 5)) + 1)
    total = np.histogram(t_s[finite], edges)[0]
    counts = np.bincount(r.gate, minlength=len(r.gates))
    order = sorted(range(len(r.gates)), key=lambda i: (r.gates[i] in ("learnt", "passed"), counts[i]), reverse=True)
    size = (11.0, 1.2 + 0.75 * len(order))
    drawn, grid = figure(len(order), 1, size, f"{title}: the learner's answers", sharex=True, sharey=True)
    for axes, index in zip(grid[:, 0], order, strict=True):
        seen = np.histogram(t_s[finite & (r.gate == index)], edges)[0]
        share = np.divide(seen, total, out=np.zeros(seen.shape), where=total > 0)
        axes.stairs(share, edges, fill=True, color=ADAPTIVE if r.gates[index] == "learnt" else DIAGNOSTIC)
        axes.set_ylabel(f"{r.gates[index]}\n{counts[index]}", rotation=0, ha="right", va="center", fontsize=8)
        axes.set_ylim(0.0, 1.0)
        axes.set_yticks([])
        axes.margins(x=0)
    grid[-1, 0].set_xlabel("time, s")
    save(drawn, path)
