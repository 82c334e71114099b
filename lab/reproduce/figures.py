"""The figures of the chapter: characterisation and forward models, control, and measured data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.lab.reproduce.measured import WINDOWS, Benchmark, PresetStudy, Stack
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.viewer.colours import BEFORE, REFERENCE, SERIES, model_colour
from dehyst.sim.chapter.control import FROZEN, GAIN_CHANGE, LEARNING, Control, Loop, moving_mae
from dehyst.sim.chapter.experiments import Characterisation, Record, Width
from dehyst.sim.chapter.forward_lssvm import two_inputs
from dehyst.sim.chapter.modelling import ForwardRun

# Figs. 2.2, 2.3, 2.8 to 2.15: the stage's loops, and the forward models on training and test records.


def figure_2_2(path: Path, name: str, found: Characterisation) -> Path:
    """Triangles of growing amplitude: input, displacements, loops, and the loop's width against amplitude."""
    drawn, axes = figure(2, 2, (10, 7), f"Fig. 2.2 on the stage {name!r}: triangles of growing amplitude")
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


def figure_2_3(path: Path, name: str, found: Characterisation) -> Path:
    """Sines of 1 to 10 Hz: displacement, loops, and the loop's width against frequency."""
    drawn, axes = figure(2, 2, (10, 7), f"Fig. 2.3 on the stage {name!r}: sines of one amplitude, 1 to 10 Hz")
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


def record_figure(path: Path, title: str, record: Record) -> Path:
    """Figs. 2.8 and 2.13: an input and the response of the stage."""
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
    axes[0, 0].plot(t_s, y_um, color="black", lw=1.0, label="stage")
    for run, dash in zip(runs, ("-", "--", ":"), strict=False):
        style = {
            "color": model_colour(run.key),
            "ls": dash,
            "lw": 0.9,
            "label": f"{run.label}, {run.route}",
        }
        axes[0, 0].plot(t_s, run.training_um, **style)
        axes[1, 0].plot(t_s, y_um - run.training_um, **style)
    legend(axes[0, 0])
    label(axes[0, 0], "", "displacement / µm", "a  stage and model")
    worst = ", ".join(f"{run.training.max_um:.2f} µm" for run in runs)
    label(axes[1, 0], "time / s", "error / µm", f"b  stage less model (largest {worst})")
    return save(drawn, path)


def figure_2_11(path: Path, name: str, record: Record) -> Path:
    """The two inputs of the chapter's LSSVM."""
    drawn, axes = figure(2, 1, (9, 5.5), f"Fig. 2.11 on the stage {name!r}: inputs of the LSSVM", sharex=True)
    rows = two_inputs(record.coarse_u_V)
    axes[0, 0].plot(record.coarse_t_s, rows[:, 0], color="black", lw=0.9)
    axes[1, 0].plot(record.coarse_t_s, rows[:, 1], color="black", lw=0.9)
    label(axes[0, 0], "", "u / V", "a  voltage")
    label(axes[1, 0], "time / s", "du/dt / V/s", "b  its backward difference (2.41)")
    return save(drawn, path)


def figure_2_14(path: Path, name: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: each model's output beside the stage."""
    drawn, axes = figure(len(runs), 1, (9, 2.1 * len(runs)), f"Fig. 2.14 on the stage {name!r}: (2.45)", sharex=True)
    for axis, run in zip(axes[:, 0], runs, strict=True):
        axis.plot(record.coarse_t_s, record.coarse_y_um, color="black", lw=1.0, label="stage")
        axis.plot(record.coarse_t_s, run.generalisation_um, color=model_colour(run.key), lw=0.9, label=run.label)
        legend(axis, loc="upper right")
        label(axis, "", "µm")
    label(axes[-1, 0], "time / s", "µm")
    return save(drawn, path)


def figure_2_15(path: Path, name: str, record: Record, runs: list[ForwardRun]) -> Path:
    """Generalisation: errors of the models, on one scale."""
    drawn, axes = figure(1, 1, (9, 4), f"Fig. 2.15 on the stage {name!r}: errors on (2.45)")
    for run in runs:
        error: FloatArray = record.coarse_y_um - run.generalisation_um
        text = f"{run.label}: MAE {run.generalisation.mae_pct:.3f} %"
        axes[0, 0].plot(record.coarse_t_s, error, color=model_colour(run.key), lw=0.9, label=text)
    legend(axes[0, 0])
    label(axes[0, 0], "time / s", "stage less model / µm")
    return save(drawn, path)


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


# Figs. 2.17 to 2.20, and control of a stage that changes.


LABELS = {"none": "no model", **FROZEN, **{key: text for key, (text, _) in LEARNING.items()}}
#: The columns of Table 2.5, and ours beside them.
COMPARED = ("bouc_wen", "mpi", "lssvm", "lssvm_memory", "lssvm_adaptive")


def followed(path: Path, title: str, loops: list[Loop], names: list[str]) -> Path:
    """Reference and displacements above, errors of every run on one scale below."""
    drawn, axes = figure(2, 1, (9, 6.5), title, sharex=True, height_ratios=(1, 1.4))
    first = loops[0].run
    line(axes[0, 0], first.t_s, first.reference_um, color=REFERENCE, label="reference")
    for loop, name in zip(loops, names, strict=True):
        run, learns = loop.run, loop.model in LEARNING
        style = {"color": model_colour(loop.model), "ls": "--" if learns else "-", "lw": 0.7}
        line(axes[0, 0], run.t_s, run.y_um, **style)
        line(axes[1, 0], run.t_s, run.error_um, label=f"{name}: MAE {loop.score.mae_pct:.4f} %", **style)
    legend(axes[1, 0])
    label(axes[0, 0], "", "displacement / µm", "a  reference and displacement")
    label(axes[1, 0], "time / s", "error / µm", "b  reference less displacement")
    return save(drawn, path)


def figure_2_19(path: Path, name: str, control: Control, model: str, reference: str) -> Path:
    """FF, FB and FF+FB with one model."""
    loops = [
        control.loop(model, "FF", reference),
        control.loop("none", "FB", reference),
        control.loop(model, "FF+FB", reference),
    ]
    drawn, axes = figure(2, 1, (9, 6.5), f"Fig. 2.19 on the stage {name!r}: {LABELS[model]}", sharex=True)
    shades = SERIES[:3]
    line(axes[0, 0], loops[0].run.t_s, loops[0].run.reference_um, color=REFERENCE, label="reference")
    for loop, shade in zip(loops, shades, strict=True):
        text = f"{loop.controller}: MAE {loop.score.mae_pct:.4f} %"
        line(axes[0, 0], loop.run.t_s, loop.run.y_um, color=shade, lw=0.7)
        line(axes[1, 0], loop.run.t_s, loop.run.error_um, color=shade, lw=0.7, label=text)
    legend(axes[1, 0])
    label(axes[0, 0], "", "displacement / µm", "a  results")
    label(axes[1, 0], "time / s", "error / µm", "b  errors")
    return save(drawn, path)


def figure_2_20(path: Path, name: str, control: Control, model: str, reference: str) -> Path:
    """Actual against wanted displacement, and the two parts of the control signal."""
    drawn, axes = figure(1, 2, (10, 4.5), f"Fig. 2.20 on the stage {name!r}: {LABELS[model]}")
    shades = dict(zip(("FF", "FB", "FF+FB"), SERIES, strict=False))
    for controller, shade in shades.items():
        run = control.loop("none" if controller == "FB" else model, controller, reference).run
        # the error is drawn, since at this scale the curves themselves are one line
        line(axes[0, 0], run.reference_um, run.y_um - run.reference_um, color=shade, lw=0.5, label=controller)
    legend(axes[0, 0])
    label(axes[0, 0], "reference / µm", "actual less reference / µm", "a  actual against reference")
    run = control.loop(model, "FF+FB", reference).run
    line(axes[0, 1], run.t_s, run.u_V, color="black", label="whole")
    line(axes[0, 1], run.t_s, run.feedforward_V, color=SERIES[0], ls="--", label="feedforward")
    line(axes[0, 1], run.t_s, run.feedback_V, color=SERIES[1], label="feedback")
    legend(axes[0, 1])
    label(axes[0, 1], "time / s", "voltage / V", "b  parts of the control signal, FF+FB")
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
    names = [LABELS[key] for key in COMPARED]
    forward = [control.loop(key, "FF", first) for key in COMPARED]
    hybrid = [control.loop(key, "FF+FB", first) for key in COMPARED]
    on = f"on the stage {name!r}"
    return {
        "2.17": followed(folder / "figure_2_17.png", f"Fig. 2.17 {on}: feedforward alone", forward, names),
        "2.18": followed(folder / "figure_2_18.png", f"Fig. 2.18 {on}: feedforward and feedback", hybrid, names),
        "2.19": figure_2_19(folder / "figure_2_19.png", name, control, "lssvm_memory", first),
        "2.20": figure_2_20(folder / "figure_2_20.png", name, control, "lssvm_memory", first),
        "change": change_figure(folder / "gain_change.png", name, control),
    }


# The measured stack actuator and the Bouc-Wen benchmark.


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
    models = [model for model in found.models if not model.failed]
    at = np.arange(len(models))
    for i, name in enumerate(WINDOWS):
        axes[2, 0].bar(at + 0.4 * (i - 0.5), [m.windows_um[name] for m in models], 0.38, label=f"window: {name}")
    for (start, stop, value), dash in zip(WINDOWS.values(), ("--", ":"), strict=True):
        text = f"published, rows {start} to {stop - 1}: {value} µm"
        axes[2, 0].axhline(value, color="black", ls=dash, lw=1.0, label=text)
    axes[2, 0].set_xticks(at, [m.name for m in models], fontsize=8, rotation=12)
    legend(axes[2, 0])
    label(axes[2, 0], "", "RMSE / µm", "c  in the published windows, mean removed")
    return save(drawn, path)


def benchmark_figure(path: Path, found: Benchmark, rate_Hz: float = 750.0) -> Path:
    """Prediction of the test multisine, its error, and the spectrum of the error."""
    drawn, axes = figure(3, 1, (10, 8), "Bouc-Wen benchmark: forward prediction of the test multisine")
    n = 750
    t_s = np.arange(n) / rate_Hz
    axes[0, 0].plot(t_s, 1e3 * found.test_y_m[:n], color="black", lw=1.0, label="test")
    axes[0, 0].plot(t_s, 1e3 * found.test_model_m[:n], color=model_colour("bouc_wen"), lw=0.8, ls="--", label="model")
    legend(axes[0, 0])
    label(axes[0, 0], "time / s", "displacement / mm", "a  the first second")
    whole = np.arange(found.test_y_m.size) / rate_Hz
    axes[1, 0].plot(whole, 1e6 * (found.test_model_m - found.test_y_m), color=BEFORE, lw=0.4)
    label(axes[1, 0], "time / s", "error / µm", f"b  model less test: RMSE {1e6 * found.rmse_m:.3f} µm")
    frequency, amplitude = found.residual_spectrum
    axes[2, 0].semilogy(frequency[1:], np.abs(np.fft.rfft(found.test_y_m))[1:] * 2 / whole.size, color="black", lw=0.5)
    axes[2, 0].semilogy(frequency[1:], amplitude[1:], color=BEFORE, lw=0.5)
    label(axes[2, 0], "frequency / Hz", "amplitude / m", "c  spectrum of the test (black) and of the error")
    return save(drawn, path)
