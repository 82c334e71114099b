"""The figures of the chapter: characterisation and forward models, control, and measured data."""

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
from dehyst.sim.chapter.experiments import Characterisation, Record, Width
from dehyst.sim.chapter.forward_lssvm import two_inputs
from dehyst.sim.chapter.modelling import ForwardRun

# Figs. 2.2, 2.3, 2.8 to 2.15: the stage's loops, and the forward models on training and test records.


def figure_2_2(path: Path, title: str, found: Characterisation) -> Path:
    """Triangles of growing amplitude: input, displacements, loops, and the loop's width against amplitude."""
    drawn, axes = figure(2, 2, (10, 7), title)
    run, other = found.triangles, found.second_axis
    line(axes[0, 0], run.t_s, run.u_V, color="black")
    label(axes[0, 0], "time / s", "voltage / V", "a  input")
    line(axes[0, 1], run.t_s, run.y_um, color="black", label="x, driven")
    line(axes[1, 0], run.u_V, run.y_um, color="black", label="x, driven")
    if other is not None:
        line(axes[0, 1], run.t_s, run.y2_um, color=SERIES[1], label="y, at rest")
        line(axes[1, 0], run.u_V, run.y2_um, color=SERIES[1], label="y, at rest")
        line(axes[1, 0], run.u_V, other.y2_um, color=SERIES[3], lw=0.5, label="y, when driven")
    talk = f", cross-talk {found.cross_talk_pct:.2f} %" if found.cross_talk_pct is not None else ", one axis"
    label(axes[0, 1], "time / s", "displacement / µm", "b  both axes" + talk)
    label(axes[1, 0], "voltage / V", "displacement / µm", "c  loops")
    legend(axes[1, 0])
    _widths(axes[1, 1], found.triangle_widths, [w.amplitude_V for w in found.triangle_widths], "amplitude / V")
    return save(drawn, path)


def figure_2_3(path: Path, title: str, found: Characterisation) -> Path:
    """Sines of 1 to 10 Hz: displacement, loops, and the loop's width against frequency."""
    drawn, axes = figure(2, 2, (10, 7), title)
    shades = [0.75 - 0.75 * i / (len(found.sines) - 1) for i in range(len(found.sines))]
    for run, shade, width in zip(found.sines, shades, found.sine_widths, strict=True):
        style = {"color": (0.9 * (1 - shade), 0.4, shade), "lw": 0.6}
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
    axis.plot(at, [w.width_pct for w in widths], "s--", color=SERIES[0], markersize=4, label="% of the loop's stroke")
    axis.set_ylim(bottom=0.0)
    legend(axis)
    label(axis, title, "loop width", "d  width at one voltage")


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


def record_figure(path: Path, title: str, record: Record) -> Path:
    """Figs. 2.8 and 2.13: an input and the response of the stage."""
    black = {"color": "black"}
    above: Panel = ([(record.t_s, record.u_V, black)], "voltage / V", "a  input")
    return stacked(path, title, [above, ([(record.t_s, record.y_um, black)], "displacement / µm", "b  output")])


def result_figure(path: Path, title: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Figs. 2.9, 2.10, 2.12: measured and modelled displacement on the training record, and the errors."""
    t_s, y_um = record.coarse_t_s, record.coarse_y_um
    models: list[Curve] = [(t_s, y_um, {"color": "black", "lw": 1.0, "label": "stage"})]
    errors: list[Curve] = []
    for run, dash in zip(runs, ("-", "--", ":"), strict=False):
        style = {"color": model_colour(run.key), "ls": dash}
        models.append((t_s, run.training_um, {**style, "label": f"{run.label}, {run.route}"}))
        errors.append((t_s, y_um - run.training_um, style))
    worst = ", ".join(f"{run.training.max_um:.2f} µm" for run in runs)
    below: Panel = (errors, "error / µm", f"b  stage less model (largest {worst})")
    return stacked(path, title, [(models, "displacement / µm", "a  stage and model"), below])


def figure_2_11(path: Path, title: str, record: Record) -> Path:
    """The two inputs of the chapter's LSSVM."""
    u_V, rate = two_inputs(record.coarse_u_V).T
    black = {"color": "black"}
    above: Panel = ([(record.coarse_t_s, u_V, black)], "u / V", "a  voltage")
    below: Panel = ([(record.coarse_t_s, rate, black)], "du/dt / V/s", "b  its backward difference (2.41)")
    return stacked(path, title, [above, below])


def figure_2_14(path: Path, title: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: each model's output beside the stage."""
    stage: Curve = (record.coarse_t_s, record.coarse_y_um, {"color": "black", "lw": 1.0, "label": "stage"})
    panels: list[Panel] = []
    for run in runs:
        style = {"color": model_colour(run.key), "label": run.label}
        panels.append(([stage, (record.coarse_t_s, run.generalisation_um, style)], "µm", ""))
    return stacked(path, title, panels, (9, 2.1 * len(runs)))


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
    """Draw the figures of characterisation and forward models into ``folder``; figure -> file."""
    name, train, test = study.name, study.data.training, study.data.generalisation

    def at(key: str, what: str) -> tuple[Path, str]:
        return folder / f"figure_2_{key[2:].zfill(2)}.png", f"Fig. {key} on the stage {name!r}: {what}"

    def runs(*wanted: str) -> list[ForwardRun]:
        return [run for key in wanted for run in study.forward if run.key == key]

    compared = runs("bouc_wen", "mpi", "lssvm", "lssvm_memory")
    results = {
        "2.9": ("Bouc-Wen", "bouc_wen", "bouc_wen_pso"),
        "2.10": ("MPI", "mpi", "mpi_pso", "mpi_lag"),
        "2.12": ("LSSVM", "lssvm", "lssvm_memory"),
    }
    return {
        "2.2": figure_2_2(*at("2.2", "triangles of growing amplitude"), study.characterisation),
        "2.3": figure_2_3(*at("2.3", "sines of one amplitude, 1 to 10 Hz"), study.characterisation),
        "2.8": record_figure(*at("2.8", "training data (2.37)"), train),
        **{key: result_figure(*at(key, what), train, runs(*keys)) for key, (what, *keys) in results.items()},
        "2.11": figure_2_11(*at("2.11", "inputs of the LSSVM"), train),
        "2.13": record_figure(*at("2.13", "test data (2.45)"), test),
        "2.14": figure_2_14(*at("2.14", "models on (2.45)"), test, compared),
        "2.15": figure_2_15(*at("2.15", "errors on (2.45)"), test, compared),
        "third": third_figure(
            folder / "third_family.png", name, runs("bouc_wen", "mpi", "mpi_lag", "lssvm", "lssvm_memory")
        ),
    }


# Figs. 2.17 to 2.20, and control of a stage that changes.


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


def figure_2_20(path: Path, title: str, loops: dict[str, Loop]) -> Path:
    """Actual against wanted displacement of FF, FB and FF+FB, and the two parts of the last one's control signal."""
    drawn, axes = figure(1, 2, (10, 4.5), title)
    for (controller, loop), shade in zip(loops.items(), SERIES, strict=False):
        run = loop.run
        # the error is drawn, since at this scale the curves themselves are one line
        line(axes[0, 0], run.reference_um, run.y_um - run.reference_um, color=shade, lw=0.5, label=controller)
    label(axes[0, 0], "reference / µm", "actual less reference / µm", "a  actual against reference")
    run = loops["FF+FB"].run
    line(axes[0, 1], run.t_s, run.u_V, color="black", label="whole")
    line(axes[0, 1], run.t_s, run.feedforward_V, color=SERIES[0], ls="--", label="feedforward")
    line(axes[0, 1], run.t_s, run.feedback_V, color=SERIES[1], label="feedback")
    label(axes[0, 1], "time / s", "voltage / V", "b  parts of the control signal, FF+FB")
    for axis in axes[0]:
        legend(axis)
    return save(drawn, path)


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
    forward, hybrid = (
        {LABELS[key]: control.loop(key, controller, first) for key in COMPARED} for controller in ("FF", "FF+FB")
    )
    colours, model = [model_colour(key) for key in COMPARED], "lssvm_memory"
    parts = {c: control.loop("none" if c == "FB" else model, c, first) for c in ("FF", "FB", "FF+FB")}
    on = f"on the stage {name!r}"
    return {
        "2.17": followed(folder / "figure_2_17.png", f"Fig. 2.17 {on}: feedforward alone", forward, colours),
        "2.18": followed(folder / "figure_2_18.png", f"Fig. 2.18 {on}: feedforward and feedback", hybrid, colours),
        "2.19": followed(folder / "figure_2_19.png", f"Fig. 2.19 {on}: {LABELS[model]}", parts, SERIES),
        "2.20": figure_2_20(folder / "figure_2_20.png", f"Fig. 2.20 {on}: {LABELS[model]}", parts),
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
