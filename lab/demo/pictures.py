"""The two pictures of a demonstration: errors over time, and the loop that the feedforward takes out."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from adaptive.types import FloatArray
from lab.demo.plan import MODELS, Plan

#: Colour-blind safe; the adaptive model is the dark one in front.
COLOURS = {
    "linear": "#bbbbbb",
    "bouc_wen": "#cc79a7",
    "mpi": "#e69f00",
    "lssvm_frozen": "#56b4e9",
    "lssvm_adaptive": "#004d40",
}


def draw_tracking(path: Path, plan: Plan, reference_um: FloatArray, displacement_um: dict[str, FloatArray]) -> None:
    """Reference, every model's error over the run, and a moving mean absolute error on a logarithmic scale."""
    t_s = np.arange(plan.ticks) * plan.dt_s
    change_s = plan.change_tick * plan.dt_s
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(11, 9), sharex=True, height_ratios=(1, 1.4, 1.4))
    top.plot(t_s, reference_um, color="black", lw=0.6)
    top.set_ylabel("reference, µm")
    span = round(0.5 / plan.dt_s)
    kernel = np.ones(span) / span
    for model, y_um in displacement_um.items():
        error_pct = 100.0 * (reference_um - y_um) / plan.range_um
        front = 3 if model == "lssvm_adaptive" else 2
        middle.plot(t_s, error_pct, color=COLOURS[model], lw=0.6, zorder=front)
        moving = np.convolve(np.abs(error_pct), kernel, mode="same")
        bottom.semilogy(t_s, np.maximum(moving, 1e-4), color=COLOURS[model], lw=1.6, zorder=front, label=MODELS[model])
    middle.set_ylabel("error, % of range")
    bottom.set_ylabel("mean |error| over 0.5 s,\n% of range")
    bottom.set_xlabel("time, s")
    bottom.legend(ncol=3, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    bottom.grid(True, which="both", alpha=0.25)
    middle.grid(True, alpha=0.25)
    for axes in (top, middle, bottom):
        axes.axvline(change_s, color="#d55e00", lw=1.0, ls="--")
        axes.margins(x=0)
    top.annotate(
        plan.change_text,
        (change_s, 1.02),
        xycoords=("data", "axes fraction"),
        color="#d55e00",
        ha="center",
        fontsize=9,
    )
    figure.align_ylabels()
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def draw_loops(path: Path, plan: Plan, reference_um: FloatArray, displacement_um: dict[str, FloatArray]) -> None:
    """Reached against wanted displacement, as deviation from it: the loop of each model before and after."""
    parts = {"before the change": plan.phases()["before"], "settled after it": plan.phases()["settled"]}
    models = list(displacement_um)
    figure, grid = plt.subplots(2, len(models), figsize=(3.0 * len(models), 6.2), sharex=True, sharey="col")
    for row, (title, part) in zip(grid, parts.items(), strict=True):
        for axes, model in zip(row, models, strict=True):
            wanted = reference_um[part]
            axes.plot(wanted, displacement_um[model][part] - wanted, color=COLOURS[model], lw=0.5)
            axes.axhline(0.0, color="black", lw=0.5)
            axes.grid(True, alpha=0.25)
        row[0].set_ylabel(f"{title}\nreached - wanted, µm")
    for axes, model in zip(grid[0], models, strict=True):
        axes.set_title(MODELS[model], fontsize=9)
    for axes in grid[1]:
        axes.set_xlabel("wanted, µm")
    figure.suptitle("What is left of the hysteresis (each column has its own scale)", fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
