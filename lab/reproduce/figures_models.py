"""Figs. 2.2, 2.3, 2.8 to 2.15: the stage's loops, and the forward models on what they were taught and were not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from adaptive.types import FloatArray
from lab.reproduce.study import PresetStudy
from service.reports.plot_style import colour, figure, label, line, save
from sim.chapter.characterisation import Characterisation, Width
from sim.chapter.experiments import Record
from sim.chapter.forward_lssvm import two_inputs
from sim.chapter.modelling import ForwardRun


def figure_2_2(path: Path, name: str, found: Characterisation) -> Path:
    """Triangles of growing amplitude: input, displacements, loops, and the loop's width against amplitude."""
    drawn, axes = figure(2, 2, (10, 7), f"Fig. 2.2 on the stage {name!r}: triangles of growing amplitude")
    run, other = found.triangles, found.second_axis
    line(axes[0, 0], run.t_s, run.u_V, color="black")
    label(axes[0, 0], "time / s", "voltage / V", "a  input")
    line(axes[0, 1], run.t_s, run.y_um, color="black", label="x, driven")
    line(axes[1, 0], run.u_V, run.y_um, color="black", label="x, driven")
    if other is not None:
        line(axes[0, 1], run.t_s, run.y2_um, color="#D55E00", label="y, at rest")
        line(axes[1, 0], run.u_V, run.y2_um, color="#D55E00", label="y, at rest")
        line(axes[1, 0], run.u_V, other.y2_um, color="#56B4E9", linewidth=0.5, label="y, when driven")
    talk = f", cross-talk {found.cross_talk_pct:.2f} %" if found.cross_talk_pct is not None else ", one axis"
    label(axes[0, 1], "time / s", "displacement / µm", "b  both axes" + talk)
    label(axes[1, 0], "voltage / V", "displacement / µm", "c  loops")
    axes[1, 0].legend(fontsize=8)
    _widths(axes[1, 1], found.triangle_widths, [w.amplitude_V for w in found.triangle_widths], "amplitude / V")
    return save(drawn, path)


def figure_2_3(path: Path, name: str, found: Characterisation) -> Path:
    """Sines of 1 to 10 Hz: displacement, loops, and the loop's width against frequency."""
    drawn, axes = figure(2, 2, (10, 7), f"Fig. 2.3 on the stage {name!r}: sines of one amplitude, 1 to 10 Hz")
    shades = [0.75 - 0.75 * i / (len(found.sines) - 1) for i in range(len(found.sines))]
    for run, shade, width in zip(found.sines, shades, found.sine_widths, strict=True):
        style = {"color": (0.9 * (1 - shade), 0.4, shade), "linewidth": 0.6}
        axes[0, 0].plot(run.t_s, run.u_V, **style)
        axes[0, 1].plot(run.t_s, run.y_um, **style)
        last = slice(run.u_V.size - round(1000 / width.frequency_Hz), run.u_V.size)
        axes[1, 0].plot(run.u_V[last], run.y_um[last], **style)
    for axis in axes[0]:
        axis.set_xlim(0.0, 1.0)
    label(axes[0, 0], "time / s", "voltage / V", "a  inputs (first second)")
    label(axes[0, 1], "time / s", "displacement / µm", "b  displacement")
    label(axes[1, 0], "voltage / V", "displacement / µm", "c  last cycles, blue 1 Hz to red 10 Hz")
    _widths(axes[1, 1], found.sine_widths, [w.frequency_Hz for w in found.sine_widths], "frequency / Hz")
    return save(drawn, path)


def _widths(axis: Any, widths: tuple[Width, ...], at: list[float], title: str) -> None:
    axis.plot(at, [w.width_um for w in widths], "o-", color="black", markersize=4, label="µm")
    axis.plot(at, [w.width_pct for w in widths], "s--", color="#0072B2", markersize=4, label="% of the loop's stroke")
    axis.set_ylim(bottom=0.0)
    axis.legend(fontsize=8)
    label(axis, title, "loop width", "d  width at one voltage")


def record_figure(path: Path, title: str, record: Record) -> Path:
    """Figs. 2.8 and 2.13: an input and what the stage made of it."""
    drawn, axes = figure(2, 1, (9, 5.5), title, sharex=True)
    line(axes[0, 0], record.t_s, record.u_V, color="black")
    line(axes[1, 0], record.t_s, record.y_um, color="black")
    label(axes[0, 0], "", "voltage / V", "a  input")
    label(axes[1, 0], "time / s", "displacement / µm", "b  output")
    return save(drawn, path)


def result_figure(path: Path, title: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Figs. 2.9, 2.10, 2.12: measured and modelled displacement on the training record, and the errors."""
    drawn, axes = figure(2, 1, (9, 6), title, sharex=True)
    t_s, y_um = record.coarse_t_s, record.coarse_y_um
    axes[0, 0].plot(t_s, y_um, color="black", linewidth=1.0, label="stage")
    for run, dash in zip(runs, ("-", "--", ":"), strict=False):
        style = {"color": colour(run.key), "linestyle": dash, "linewidth": 0.9, "label": f"{run.label}, {run.route}"}
        axes[0, 0].plot(t_s, run.training_um, **style)
        axes[1, 0].plot(t_s, y_um - run.training_um, **style)
    axes[0, 0].legend(fontsize=8)
    label(axes[0, 0], "", "displacement / µm", "a  stage and model")
    worst = ", ".join(f"{run.training.max_um:.2f} µm" for run in runs)
    label(axes[1, 0], "time / s", "error / µm", f"b  stage less model (largest {worst})")
    return save(drawn, path)


def figure_2_11(path: Path, name: str, record: Record) -> Path:
    """The two inputs of the chapter's LSSVM."""
    drawn, axes = figure(2, 1, (9, 5.5), f"Fig. 2.11 on the stage {name!r}: inputs of the LSSVM", sharex=True)
    rows = two_inputs(record.coarse_u_V)
    axes[0, 0].plot(record.coarse_t_s, rows[:, 0], color="black", linewidth=0.9)
    axes[1, 0].plot(record.coarse_t_s, rows[:, 1], color="black", linewidth=0.9)
    label(axes[0, 0], "", "u / V", "a  voltage")
    label(axes[1, 0], "time / s", "du/dt / V/s", "b  its backward difference (2.41)")
    return save(drawn, path)


def figure_2_14(path: Path, name: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: each model's output beside the stage."""
    drawn, axes = figure(len(runs), 1, (9, 2.1 * len(runs)), f"Fig. 2.14 on the stage {name!r}: (2.45)", sharex=True)
    for axis, run in zip(axes[:, 0], runs, strict=True):
        axis.plot(record.coarse_t_s, record.coarse_y_um, color="black", linewidth=1.0, label="stage")
        axis.plot(record.coarse_t_s, run.generalisation_um, color=colour(run.key), linewidth=0.9, label=run.label)
        axis.legend(fontsize=8, loc="upper right")
        label(axis, "", "µm")
    label(axes[-1, 0], "time / s", "µm")
    return save(drawn, path)


def figure_2_15(path: Path, name: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: errors of the models, on one scale."""
    drawn, axes = figure(1, 1, (9, 4), f"Fig. 2.15 on the stage {name!r}: errors on (2.45)")
    for run in runs:
        error: FloatArray = record.coarse_y_um - run.generalisation_um
        text = f"{run.label}: MAE {run.generalisation.mae_pct:.3f} %"
        axes[0, 0].plot(record.coarse_t_s, error, color=colour(run.key), linewidth=0.9, label=text)
    axes[0, 0].legend(fontsize=8)
    label(axes[0, 0], "time / s", "stage less model / µm")
    return save(drawn, path)


def third_figure(path: Path, name: str, runs: list[ForwardRun]) -> Path:
    """The family that the chapter lacks: MAE of every model on every record, logarithmic."""
    drawn, axes = figure(1, 1, (10, 4.5), f"What the chapter did not test, on the stage {name!r}")
    axis = axes[0, 0]
    names = list(runs[0].third)
    width = 0.8 / len(runs)
    for i, run in enumerate(runs):
        at = [j + (i - 0.5 * (len(runs) - 1)) * width for j in range(len(names))]
        axis.bar(at, [run.third[key].mae_pct for key in names], width, color=colour(run.key), label=run.label)
    axis.set_yscale("log")
    axis.set_ylim(bottom=0.3 * min(score.mae_pct for run in runs for score in run.third.values()))
    axis.set_xticks(range(len(names)), names, fontsize=8)
    axis.legend(fontsize=8, ncols=3)
    label(axis, "", "MAE, % of range")
    return save(drawn, path)


def draw_models(folder: Path, study: PresetStudy) -> dict[str, Path]:
    """All of this file's figures for one stage into ``folder``; name of the figure -> file."""
    name, data = study.name, study.data
    keys = {run.key for run in study.forward}

    def runs(*wanted: str) -> list[ForwardRun]:
        return [study.model(key) for key in wanted if key in keys]

    compared = runs("bouc_wen", "mpi", "lssvm", "lssvm_memory")
    on = f"on the stage {name!r}"
    train, test = data.training, data.generalisation
    return {
        "2.2": figure_2_2(folder / "figure_2_02.png", name, study.characterisation),
        "2.3": figure_2_3(folder / "figure_2_03.png", name, study.characterisation),
        "2.8": record_figure(folder / "figure_2_08.png", f"Fig. 2.8 {on}: training data (2.37)", train),
        "2.9": result_figure(
            folder / "figure_2_09.png", f"Fig. 2.9 {on}: Bouc-Wen", train, runs("bouc_wen", "bouc_wen_pso")
        ),
        "2.10": result_figure(
            folder / "figure_2_10.png", f"Fig. 2.10 {on}: MPI", train, runs("mpi", "mpi_pso", "mpi_lag")
        ),
        "2.11": figure_2_11(folder / "figure_2_11.png", name, train),
        "2.12": result_figure(
            folder / "figure_2_12.png", f"Fig. 2.12 {on}: LSSVM", train, runs("lssvm", "lssvm_memory")
        ),
        "2.13": record_figure(folder / "figure_2_13.png", f"Fig. 2.13 {on}: test data (2.45)", test),
        "2.14": figure_2_14(folder / "figure_2_14.png", name, test, compared),
        "2.15": figure_2_15(folder / "figure_2_15.png", name, test, compared),
        "third": third_figure(
            folder / "third_family.png", name, runs("bouc_wen", "mpi", "mpi_lag", "lssvm", "lssvm_memory")
        ),
    }
