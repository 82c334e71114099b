"""Figures of the report: forward models, control, and measured data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.lab.reproduce.measured import WINDOWS, PresetStudy, Stack
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.viewer.colours import REFERENCE, SERIES, model_colour
from dehyst.sim.chapter.control import FROZEN, GAIN_CHANGE, LEARNING, Control, Loop, moving_mae
from dehyst.sim.chapter.experiments import Record
from dehyst.sim.chapter.modelling import ForwardRun

# Forward models on test records.

#: A curve: x, y, and its style. A panel: its curves, the label of its y axis, and its title.
Curve = tuple[FloatArray, FloatArray, dict[str, Any]]
Panel = tuple[list[Curve], str, str]


def stacked(path: Path, title: str, panels: list[Panel], size: tuple[float, float] = (9, 6), **options: Any) -> Path:
    """Panels below each other over time, each with a legend where its curves have labels."""
    drawn, axes = figure(len(panels), 1, size, title, sharex=True, **options)
    for axis, (curves, y_label, text) in zip(axes[:, 0], panels, strict=True):
        for x, y, style in curves:
            line(axis, x, y, **style)
        if any("label" in style for _, _, style in curves):
            legend(axis)
        label(axis, "", y_label, text)
    axes[-1, 0].set_xlabel("time / s", fontsize=9)
    return save(drawn, path)


def figure_2_15(path: Path, title: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: errors of the models, on one scale."""
    curves: list[Curve] = []
    for run in runs:
        style = {"color": model_colour(run.key), "label": f"{run.label}: MAE {run.generalisation.mae_pct:.3f} %"}
        curves.append((record.coarse_t_s, record.coarse_y_um - run.generalisation_um, style))
    return stacked(path, title, [(curves, "stage less model / µm", "")], (9, 4))


def third_figure(path: Path, name: str, runs: list[ForwardRun]) -> Path:
    """Records that the chapter does not test: MAE of every model on a logarithmic scale."""
    drawn, axes = figure(1, 1, (10, 4.5), f"What the chapter did not test, on the stage {name!r}")
    axis = axes[0, 0]
    names = list(runs[0].third)
    width = 0.8 / len(runs)
    for i, run in enumerate(runs):
        at = [j + (i - 0.5 * (len(runs) - 1)) * width for j in range(len(names))]
        axis.bar(at, [run.third[key].mae_pct for key in names], width, color=model_colour(run.key), label=run.label)
    axis.set_yscale("log")
    axis.set_ylim(bottom=0.3 * min(score.mae_pct for run in runs for score in run.third.values()))
    axis.set_xticks(range(len(names)), names, fontsize=8)
    legend(axis, ncols=3)
    label(axis, "", "MAE, % of range")
    return save(drawn, path)


def draw_models(folder: Path, study: PresetStudy) -> dict[str, Path]:
    """Draw the figures of forward models into ``folder``; figure -> file."""
    name, test = study.name, study.data.generalisation
    kinds = ("bouc_wen", "mpi", "mpi_lag", "lssvm", "lssvm_memory")
    runs = [run for key in kinds for run in study.forward if run.key == key]
    chapter = [run for run in runs if run.key != "mpi_lag"]
    title = f"Fig. 2.15 on the stage {name!r}: errors on (2.45)"
    return {
        "2.15": figure_2_15(folder / "figure_2_15.png", title, test, chapter),
        "third": third_figure(folder / "third_family.png", name, runs),
    }


# Fig. 2.17, and control of a stage that changes.


LABELS = {"none": "no model", **FROZEN, **{key: text for key, (text, _) in LEARNING.items()}}
#: The columns of Table 2.5, and ours beside them.
COMPARED = ("bouc_wen", "mpi", "lssvm", "lssvm_memory", "lssvm_adaptive")


def followed(path: Path, title: str, loops: dict[str, Loop], colours: Sequence[str]) -> Path:
    """Reference and displacements above, errors of every run, by its name, on one scale below."""
    first = next(iter(loops.values())).run
    above: list[Curve] = [(first.t_s, first.reference_um, {"color": REFERENCE})]
    below: list[Curve] = []
    for (name, loop), colour in zip(loops.items(), colours, strict=False):
        style = {"color": colour, "ls": "--" if loop.model in LEARNING else "-", "lw": 0.7}
        above.append((first.t_s, loop.run.y_um, style))
        below.append((first.t_s, loop.run.error_um, {**style, "label": f"{name}: MAE {loop.score.mae_pct:.4f} %"}))
    panels: list[Panel] = [(above, "displacement / µm", "a  reference and displacement")]
    return stacked(path, title, [*panels, (below, "error / µm", "b  reference less displacement")], (9, 6.5))


def change_figure(path: Path, name: str, control: Control) -> Path:
    """Moving MAE of every model while the gain of the stage drops."""
    title = f"Feedforward alone on the stage {name!r}, whose gain drops by {-100 * GAIN_CHANGE:g} % at 5 s"
    drawn, axes = figure(1, 1, (10, 4.8), title)
    axis = axes[0, 0]
    for loop in control.changed:
        trace = moving_mae(loop.run.error_um, control.range_um)
        learns = loop.model in LEARNING
        line(
            axis,
            loop.run.t_s,
            trace,
            color=model_colour(loop.model),
            ls="-" if learns else ":",
            lw=1.6 if learns else 1.0,
            label=LABELS[loop.model],
        )
    axis.set_yscale("log")
    drawn.legend(loc="outside lower center", fontsize=8, ncols=3)
    label(axis, "time / s", "MAE over the last 0.5 s, % of range")
    return save(drawn, path)


def draw_control(folder: Path, study: PresetStudy) -> dict[str, Path]:
    """Draw the figures of control into ``folder``; figure -> file."""
    name, control = study.name, study.control
    first = control.loops[0].reference
    forward = {LABELS[key]: control.loop(key, "FF", first) for key in COMPARED}
    title = f"Fig. 2.17 on the stage {name!r}: feedforward alone"
    return {
        "2.17": followed(folder / "figure_2_17.png", title, forward, [model_colour(key) for key in COMPARED]),
        "change": change_figure(folder / "gain_change.png", name, control),
    }


# The measured stack actuator.


def stack_figure(path: Path, found: Stack) -> Path:
    """The test recording, the equivalent errors of the models, and both published windows."""
    drawn, axes = figure(3, 1, (10, 9), "Measured stack actuator: the ramped sine, on which nothing was identified")
    line(axes[0, 0], found.t_s, found.y_um - np.mean(found.y_um), color="black", label="measured")
    for name, (start, stop, _) in WINDOWS.items():
        axes[0, 0].axvspan(found.t_s[start], found.t_s[min(stop, found.t_s.size - 1)], alpha=0.2, color=SERIES[5])
        axes[0, 0].text(found.t_s[start], 20.0, name, fontsize=8)
    label(axes[0, 0], "time / s", "displacement / µm", "a  recording and the windows that its authors report on")
    for result in found.results:
        if result.score is None or result.name in ("linear", "lssvm_frozen"):
            continue
        shade = model_colour(result.name)
        dash = "--" if result.name.endswith("_online") else "-"
        style = {"color": shade, "ls": dash, "lw": 0.6}
        error = result.error_V * found.gain_um_per_V
        line(axes[1, 0], found.t_s, error, label=f"{result.name}: {result.score.rmse_um:.3f} µm RMSE", **style)
    axes[1, 0].set_ylim(-4.0, 4.0)
    legend(axes[1, 0], ncols=2)
    label(axes[1, 0], "time / s", "equivalent error / µm", "b  errors of the inverse models (dashed: learning)")
    windows = {r.name: found.windows_rmse_um(r) for r in found.results if r.score is not None}
    at = np.arange(len(windows))
    for i, name in enumerate(WINDOWS):
        axes[2, 0].bar(
            at + 0.4 * (i - 0.5), [errors[name] for errors in windows.values()], 0.38, label=f"window: {name}"
        )
    for (start, stop, value), dash in zip(WINDOWS.values(), ("--", ":"), strict=True):
        text = f"published, rows {start} to {stop - 1}: {value} µm"
        axes[2, 0].axhline(value, color="black", ls=dash, lw=1.0, label=text)
    axes[2, 0].set_xticks(at, list(windows), fontsize=8, rotation=12)
    legend(axes[2, 0])
    label(axes[2, 0], "", "RMSE / µm", "c  in the published windows, mean removed")
    return save(drawn, path)
