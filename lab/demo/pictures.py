"""The two pictures of a demonstration: errors over time, and the hysteresis that each model leaves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from lab.demo.plan import MODELS, Plan
from service.reports.plot_style import figure, line, save
from service.viewer.colours import EVENT, REFERENCE, model_colour


def draw_tracking(path: Path, plan: Plan, reference_um: FloatArray, displacement_um: dict[str, FloatArray]) -> None:
    """Reference, error of every model, and its moving mean absolute error on a logarithmic scale."""
    t_s = np.arange(plan.ticks) * plan.dt_s
    change_s = plan.change_tick * plan.dt_s
    drawn, axes = figure(3, 1, (11, 9), sharex=True, height_ratios=(1, 1.4, 1.4))
    top, middle, bottom = axes[:, 0]
    line(top, t_s, reference_um, color=REFERENCE, lw=0.6)
    top.set_ylabel("reference, µm")
    span = round(0.5 / plan.dt_s)
    kernel = np.ones(span) / span
    for model, y_um in displacement_um.items():
        error_pct = 100.0 * (reference_um - y_um) / plan.range_um
        style = {"color": model_colour(model), "zorder": 3 if model == "lssvm_adaptive" else 2}
        line(middle, t_s, error_pct, lw=0.6, **style)
        moving = np.convolve(np.abs(error_pct), kernel, mode="same")
        line(bottom, t_s, np.maximum(moving, 1e-4), lw=1.6, label=MODELS[model], **style)
    middle.set_ylabel("error, % of range")
    bottom.set_yscale("log")
    bottom.set_ylabel("mean |error| over 0.5 s,\n% of range")
    bottom.set_xlabel("time, s")
    for axis in (top, middle, bottom):
        axis.axvline(change_s, color=EVENT, lw=1.0, ls="--")
        axis.margins(x=0)
    top.set_title(plan.change_text, color=EVENT, fontsize=9)
    drawn.legend(ncols=3, fontsize=8, loc="outside lower center")
    save(drawn, path)


def draw_loops(path: Path, plan: Plan, reference_um: FloatArray, displacement_um: dict[str, FloatArray]) -> None:
    """Deviation of the reached from the wanted displacement, for each model before and after the change."""
    parts = {"before the change": plan.phases()["before"], "settled after it": plan.phases()["settled"]}
    models = list(displacement_um)
    drawn, grid = figure(
        2,
        len(models),
        (3.0 * len(models), 6.2),
        "Remaining hysteresis (each column has its own scale)",
        sharex=True,
        sharey="col",
    )
    for row, (title, part) in zip(grid, parts.items(), strict=True):
        for axis, model in zip(row, models, strict=True):
            wanted = reference_um[part]
            line(axis, wanted, displacement_um[model][part] - wanted, color=model_colour(model), lw=0.5)
            axis.axhline(0.0, color="black", lw=0.5)
        row[0].set_ylabel(f"{title}\nreached - wanted, µm")
    for axis, model in zip(grid[0], models, strict=True):
        axis.set_title(MODELS[model], fontsize=9)
    for axis in grid[1]:
        axis.set_xlabel("wanted, µm")
    save(drawn, path)
