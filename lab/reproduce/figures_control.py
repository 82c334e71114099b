"""Figs. 2.17 to 2.20, and beyond: control with frozen and with learning models, and what a change does to them."""

from __future__ import annotations

from pathlib import Path

from lab.reproduce.study import PresetStudy
from service.reports.plot_style import colour, figure, label, line, save
from sim.chapter.control import FROZEN, GAIN_CHANGE, LEARNING, Control, Loop, moving_mae

LABELS = {"none": "no model", **FROZEN, **{key: text for key, (text, _) in LEARNING.items()}}
#: The columns of Table 2.5, and ours beside them.
COMPARED = ("bouc_wen", "mpi", "lssvm", "lssvm_memory", "lssvm_adaptive")


def followed(path: Path, title: str, loops: list[Loop], names: list[str]) -> Path:
    """Reference and displacements above, errors of every run on one scale below."""
    drawn, axes = figure(2, 1, (9, 6.5), title, sharex=True, height_ratios=(1, 1.4))
    first = loops[0].run
    line(axes[0, 0], first.t_s, first.reference_um, color="black", label="reference")
    for loop, name in zip(loops, names, strict=True):
        run, learns = loop.run, loop.model in LEARNING
        style = {"color": colour(loop.model), "linestyle": "--" if learns else "-", "linewidth": 0.7}
        line(axes[0, 0], run.t_s, run.y_um, **style)
        line(axes[1, 0], run.t_s, run.error_um, label=f"{name}: MAE {loop.score.mae_pct:.4f} %", **style)
    axes[1, 0].legend(fontsize=8)
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
    shades = ("#E69F00", "#56B4E9", "#009E73")
    line(axes[0, 0], loops[0].run.t_s, loops[0].run.reference_um, color="black", label="reference")
    for loop, shade in zip(loops, shades, strict=True):
        text = f"{loop.controller}: MAE {loop.score.mae_pct:.4f} %"
        line(axes[0, 0], loop.run.t_s, loop.run.y_um, color=shade, linewidth=0.7)
        line(axes[1, 0], loop.run.t_s, loop.run.error_um, color=shade, linewidth=0.7, label=text)
    axes[1, 0].legend(fontsize=8)
    label(axes[0, 0], "", "displacement / µm", "a  results")
    label(axes[1, 0], "time / s", "error / µm", "b  errors")
    return save(drawn, path)


def figure_2_20(path: Path, name: str, control: Control, model: str, reference: str) -> Path:
    """Actual against wanted displacement, and the two parts of the control signal."""
    drawn, axes = figure(1, 2, (10, 4.5), f"Fig. 2.20 on the stage {name!r}: {LABELS[model]}")
    shades = {"FF": "#E69F00", "FB": "#56B4E9", "FF+FB": "#009E73"}
    for controller, shade in shades.items():
        run = control.loop("none" if controller == "FB" else model, controller, reference).run
        # the error is drawn, since at this scale the curves themselves are one line
        line(axes[0, 0], run.reference_um, run.y_um - run.reference_um, color=shade, linewidth=0.5, label=controller)
    axes[0, 0].legend(fontsize=8)
    label(axes[0, 0], "reference / µm", "actual less reference / µm", "a  actual against reference")
    run = control.loop(model, "FF+FB", reference).run
    line(axes[0, 1], run.t_s, run.u_V, color="black", label="whole")
    line(axes[0, 1], run.t_s, run.feedforward_V, color="#E69F00", linestyle="--", label="feedforward")
    line(axes[0, 1], run.t_s, run.feedback_V, color="#56B4E9", label="feedback")
    axes[0, 1].legend(fontsize=8)
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
            color=colour(loop.model),
            linestyle="-" if learns else ":",
            linewidth=1.6 if learns else 1.0,
            label=LABELS[loop.model],
        )
    axis.set_yscale("log")
    drawn.legend(loc="outside lower center", fontsize=8, ncols=3)
    label(axis, "time / s", "MAE over the last 0.5 s, % of range")
    return save(drawn, path)


def draw_control(folder: Path, study: PresetStudy) -> dict[str, Path]:
    """All of this file's figures for one stage; name of the figure -> file."""
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
