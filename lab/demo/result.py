"""The result of a demonstration, live or fast: its table, ``summary.json``, and two pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.lab.demo.plan import MODELS, Plan
from dehyst.lab.rehearsal.outcome import moving_mean
from dehyst.service.reports.plot_style import figure, line, save
from dehyst.service.viewer.colours import EVENT, REFERENCE, model_colour

# --- The result of a demonstration, live or fast, and its table and ``summary.json``.

#: Share of the ticks without their voltage above which the errors are those of the machine: at 0.016 the table did not
#: change, at 0.5 every model was off by a fifth of the range.
MOST_LATE = 0.02
#: Phases with three numbers in the table; "catching_up" has its mean absolute error alone.
PHASE_TITLES = {"before": "before the change", "first_second": "first second after", "settled": "settled"}
#: Length of the worst stretch of the run that is told, s.
WORST_S = 0.5


def score(error_um: FloatArray, plan: Plan) -> dict[str, dict[str, float]]:
    """MAE (2.43), RMSE (2.44) and maximum of an error, in percent of the commanded range, by phase."""
    percent = 100.0 * error_um / plan.range_um
    return {
        name: {
            "mae_pct": float(np.mean(np.abs(percent[part]))),
            "rmse_pct": float(np.sqrt(np.mean(percent[part] ** 2))),
            "max_pct": float(np.max(np.abs(percent[part]))),
        }
        for name, part in plan.phases().items()
    }


def worst_stretch(error_um: FloatArray, plan: Plan) -> dict[str, float]:
    """Largest mean absolute error over ``WORST_S`` of the whole run, percent of the range, and where it begins, s."""
    means = moving_mean(np.abs(error_um), round(WORST_S / plan.dt_s))
    at = int(np.argmax(means))
    return {"mae_pct": float(100.0 * means[at] / plan.range_um), "t_s": at * plan.dt_s}


def evaluations(seconds: FloatArray, late: float) -> dict[str, Any]:
    """Evaluations of a block: count, median and 99th percentile in µs, and how many had an older model than planned."""
    p50, p99 = np.percentile(seconds * 1e6, [50, 99])
    return {"count": int(seconds.size), "p50_us": round(float(p50), 1), "p99_us": round(float(p99), 1), "late": late}


def clock_missed(ticks: dict[str, int]) -> str:
    """A warning if voltages often came too late; "" if the machine kept up."""
    share = ticks["late"] / max(1, ticks["count"])
    if share <= MOST_LATE:
        return ""
    return (
        f"THIS MACHINE DID NOT KEEP UP: {100.0 * share:.0f} % of the ticks went without their voltage, so the table "
        "shows the delays and not the models. Close other programs, or run without a clock: dehyst demo --fast is the "
        "same run in one process"
    )


def pace(summary: dict[str, Any]) -> str:
    """How much slower than real time the stage ran; "" for a run without a clock."""
    found = summary["pace"]
    if not found:
        return ""
    stage_s, ran_s, waited_s = found["stage_s"], found["ran_s"], found["waited_s"]
    return (
        f"{stage_s:g} s of the stage took {ran_s:.1f} s ({ran_s / stage_s:.2f} times real time); "
        f"its clock stood still for {waited_s:.1f} s of them, until voltages came"
    )


def table(summary: dict[str, Any]) -> str:
    """The result as a table: one row per model. The second line says which seconds of the run a column scores."""
    width = max(len(title) for title in MODELS.values())
    seconds = summary["seconds"]
    columns = ["before", "first_second", "catching_up", "settled"]
    titles = PHASE_TITLES | {"catching_up": "1 s after to settled"}
    head, when = " " * width, f"{'seconds of the run':<{width}}"
    units = f"{'% of ' + format(summary['range_um'], '.0f') + ' µm':<{width}}"
    for phase in columns:
        wide = 23 if phase in PHASE_TITLES else 20
        head += f" | {titles[phase]:^{wide}}"
        when += f" | {'{:g} to {:g}'.format(*seconds[phase]):^{wide}}"
        units += " |    MAE    RMSE     max" if phase in PHASE_TITLES else f" | {'MAE':^20}"
    head += f" | {'worst half second':^18}"
    when += f" | {'{:g} to {:g}'.format(0.0, seconds['settled'][1]):^18}"
    units += f" | {'MAE':>7}{'from, s':>11}"
    lines = [head, when, units, "-" * len(head)]
    for model, title in MODELS.items():
        found, worst = summary["models"][model], summary["worst_half_second"][model]
        cells = ""
        for phase in columns:
            keys = ("mae_pct", "rmse_pct", "max_pct") if phase in PHASE_TITLES else ("mae_pct",)
            numbers = " ".join(f"{found[phase][key]:7.3f}" for key in keys)
            cells += f" | {numbers}" if len(keys) > 1 else f" | {numbers:^20}"
        lines.append(f"{title:<{width}}{cells} | {worst['mae_pct']:7.3f}{worst['t_s']:11.1f}")
    return "\n".join(lines)


@dataclass(slots=True)
class DemoRun:
    """Motion of the twin stages, by model, and the counts of a run.

    Attributes
    ----------
    y_um : by model, (ticks,), the readings.
    query_s : durations of the evaluations of a block, s. followed : of the learning model, see `FollowedModels.counts`.
    samples : counts ``sent``, ``received``, ``learnt`` of the stage that the service learns from.
    ticks : counts ``count`` and ``late`` (no command in time).
    pace : of a run with a clock, s: ``stage_s`` of the stage's time, ``ran_s`` that it took, and ``waited_s`` for which
    the stage's clock stood still. Empty without a clock.
    """

    y_um: dict[str, FloatArray]
    query_s: FloatArray
    samples: dict[str, int]
    ticks: dict[str, int]
    followed: dict[str, float]
    pace: dict[str, float] = field(default_factory=dict)

    def summary(self, plan: Plan, reference_um: FloatArray) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return {
            "schema": 1,
            "range_um": plan.range_um,
            "models": {name: score(reference_um - self.y_um[name], plan) for name in MODELS},
            "seconds": {name: [part.start * plan.dt_s, part.stop * plan.dt_s] for name, part in plan.phases().items()},
            "worst_half_second": {name: worst_stretch(reference_um - self.y_um[name], plan) for name in MODELS},
            "followed": self.followed,
            "queries": evaluations(self.query_s, self.followed["late_models"]),
            "samples": self.samples,
            "ticks": self.ticks,
            "pace": self.pace,
            "change": {
                "t_s": plan.change_tick * plan.dt_s,
                "gain": plan.gain_change,
                "payload_ratio": plan.payload_ratio,
                "text": plan.change_text,
            },
            "seed": plan.seed,
        }


def empty(plan: Plan) -> dict[str, FloatArray]:
    """An array of ticks for each model, filled with NaN."""
    return {name: np.full(plan.ticks, np.nan) for name in MODELS}


# --- The two pictures of a demonstration: errors over time, and the hysteresis that each model leaves.


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
