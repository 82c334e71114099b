"""Pictures of a replay: how well was foretold over time, what the learner followed, and what its gates said."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from service.replay.replay import Replayed, covered
from service.reports.plot_style import envelope, traces

ADAPTIVE_COLOUR, FROZEN_COLOUR, STATED_COLOUR = "#004d40", "#e69f00", "#56b4e9"
#: Points beyond which a line is drawn by the extremes of what it leaves out.
#: What the learner's diagnostics show, in this order, where it has them.
SHOWN = (("gain", "gain"), ("frame_offset_um", "offset of the frame, µm"), ("offset_V", "offset, V"))


def _moving(values: FloatArray, span: int) -> FloatArray:
    """Mean over ``span`` samples of what is scored; NaN where nothing of a window is."""
    good = np.isfinite(values)
    total, count = np.cumsum(np.where(good, values, 0.0)), np.cumsum(good)
    total[span:], count[span:] = total[span:] - total[:-span], count[span:] - count[:-span]
    mean: FloatArray = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def draw_errors(path: Path, title: str, replayed: Replayed, span_V: float, window_s: float) -> None:
    """Motion, errors with what was stated of them, their running mean, and what the learner followed."""
    r, percent = replayed, 100.0 / span_V
    dt = float(np.median(np.diff(r.t_s)))
    shown = [(key, label) for key, label in SHOWN if key in r.notes]
    figure, grid = traces(
        11.0, 8.0 + 1.3 * len(shown), 3 + len(shown), sharex=True, height_ratios=(0.8, 1.4, 1.4, *[0.6] * len(shown))
    )
    top, middle, bottom = grid[:3]
    figure.suptitle(title, fontsize=11)
    top.plot(*envelope(r.t_s, r.y_um), color="black", lw=0.6)
    top.set_ylabel("reading, µm")
    middle.plot(*envelope(r.t_s, r.frozen_V * percent), color=FROZEN_COLOUR, lw=0.6, label="not adapting")
    t_std, std = envelope(r.t_s, r.std_V * percent)
    middle.fill_between(
        t_std, -2.0 * std, 2.0 * std, color=STATED_COLOUR, alpha=0.4, lw=0, label="± 2 stated deviations"
    )
    middle.plot(*envelope(r.t_s, r.adaptive_V * percent), color=ADAPTIVE_COLOUR, lw=0.6, label="adapting")
    shares = covered(r)
    middle.set_title(
        f"errors within one stated deviation: {100 * shares['one_std']:.0f} % (68 stated), "
        f"within two: {100 * shares['two_std']:.0f} % (95 stated)",
        fontsize=9,
    )
    middle.set_ylabel("foretold less applied,\n% of voltage span")
    middle.legend(fontsize=8, ncols=3, loc="upper right")
    span = max(1, round(window_s / dt))
    for values, colour, label in (
        (r.frozen_V, FROZEN_COLOUR, "not adapting"),
        (r.adaptive_V, ADAPTIVE_COLOUR, "adapting"),
    ):
        running = np.maximum(_moving(np.abs(values), span) * percent, 1e-5)
        bottom.semilogy(*envelope(r.t_s, running), color=colour, lw=1.3, label=label)
    bottom.set_ylabel(f"mean |error| of the last {window_s:g} s,\n% of voltage span")
    bottom.legend(fontsize=8, loc="upper right")
    for axes, (key, label) in zip(grid[3:], shown, strict=True):
        axes.plot(r.note_t_s, r.notes[key], color="#0072b2", lw=1.0)
        axes.set_ylabel(label, fontsize=8)
    for axes in grid:
        axes.margins(x=0)
        axes.grid(True, which="both", alpha=0.25)
    grid[-1].set_xlabel("time, s")
    figure.align_ylabels()
    figure.savefig(path)


def draw_gates(path: Path, title: str, replayed: Replayed, bins: int = 300) -> None:
    """For each of the learner's answers, the share of samples that got it, over time."""
    r = replayed
    t_s = r.row_t_s
    finite = np.isfinite(t_s)
    low, high = float(t_s[finite].min()), float(t_s[finite].max())
    edges = np.linspace(low, high if high > low else low + 1.0, min(bins, max(2, t_s.size // 5)) + 1)
    total = np.histogram(t_s[finite], edges)[0]
    counts = np.bincount(r.gate, minlength=len(r.gates))
    order = sorted(range(len(r.gates)), key=lambda i: (r.gates[i] in ("learnt", "passed"), counts[i]), reverse=True)
    figure, grid = traces(11.0, 1.2 + 0.75 * len(order), len(order), sharex=True, sharey=True, squeeze=False)
    figure.suptitle(f"{title}: what the learner said of the samples", fontsize=11)
    for axes, index in zip(grid[:, 0], order, strict=True):
        seen = np.histogram(t_s[finite & (r.gate == index)], edges)[0]
        share = np.divide(seen, total, out=np.zeros(seen.shape), where=total > 0)
        axes.stairs(share, edges, fill=True, color=ADAPTIVE_COLOUR if r.gates[index] == "learnt" else "#0072b2")
        axes.set_ylabel(f"{r.gates[index]}\n{counts[index]}", rotation=0, ha="right", va="center", fontsize=8)
        axes.set_ylim(0.0, 1.0)
        axes.set_yticks([])
        axes.margins(x=0)
    grid[-1, 0].set_xlabel("time, s")
    figure.savefig(path)
