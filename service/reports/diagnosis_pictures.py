"""Pictures of a diagnosis as PNGs, drawn without a display: the residual before and after, and each cause's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from service.reports.diagnosis_curves import MEASURED, WITH, WITHOUT, envelope, picture
from service.reports.diagnosis_page import length
from sim.diagnosis.result import Diagnosis, NamedCause

BEFORE, AFTER, DRIVE, FLOOR = "#D55E00", "#0072B2", "#666666", "#BBBBBB"
COLOURS = {MEASURED: "#222222", WITHOUT: BEFORE, WITH: AFTER}


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw_residual(path: Path, diagnosis: Diagnosis, title: str) -> None:
    """Voltage, and the residual of the nominal and of the extended model over time; beside them the loops."""
    data = diagnosis.nominal.model.data
    figure, grid = _figure(3, 1, (9.0, 6.4))
    axes = grid[:, 0]
    for axis in axes[1:]:
        axis.sharex(axes[0])
    axes[0].plot(*envelope(data.t_s, data.u_V), color=DRIVE, lw=0.7)
    axes[0].set_ylabel("voltage / V")
    axes[0].set_title(title)
    pairs = (
        (diagnosis.nominal.residual_um, BEFORE, f"nominal stage, held out {length(diagnosis.nominal_heldout_um)}"),
        (diagnosis.extended.residual_um, AFTER, f"extended stage, held out {length(diagnosis.extended_heldout_um)}"),
    )
    size = float(np.quantile(np.abs(diagnosis.nominal.residual_um), 0.999))
    scale, unit = (1e3, "nm") if size < 1.0 else (1.0, "µm")
    for axis, (residual, colour, label) in zip(axes[1:], pairs, strict=True):
        band = 2.0 * scale * diagnosis.noise_floor_um
        axis.axhspan(-band, band, color=FLOOR, alpha=0.5, lw=0)
        axis.plot(*envelope(data.t_s, scale * residual), color=colour, lw=0.6, label=label)
        # A first moment that nothing knows must not flatten the rest; both on one scale, to be compared.
        axis.set_ylim(-1.3 * scale * max(size, 1e-6), 1.3 * scale * max(size, 1e-6))
        axis.set_ylabel(f"residual / {unit}")
        axis.legend(loc="upper right")
    axes[-1].set_xlabel("time / s (grey: twice the noise floor)")
    figure.savefig(path)


def draw_cause(path: Path, cause: NamedCause, diagnosis: Diagnosis) -> None:
    """The picture in which this cause shows itself: before (without it) and after (with it)."""
    shown = picture(cause, diagnosis.extended.model.data)
    figure, grid = _figure(1, 1, (8.0, 3.6))
    axis = grid[0, 0]
    said: set[str] = set()
    for curve in shown.curves:
        label = curve.label if curve.label not in said else None
        said.add(curve.label)
        axis.plot(
            curve.x,
            curve.y,
            color=COLOURS[curve.role],
            ls="--" if curve.dashed else "-",
            marker="o" if curve.points and curve.x.size < 100 else None,
            ms=3,
            lw=1.8 if curve.role == MEASURED else 1.0,
            alpha=0.5 if curve.role == MEASURED else 1.0,
            label=label,
        )
    for mark in shown.marks:
        axis.axvline(mark, color=DRIVE, lw=0.8, ls=":")
    axis.set(xlabel=shown.x_name, ylabel=shown.y_name, title=cause.name.replace("_", " "))
    if shown.log_x:
        axis.set_xscale("log")
    if shown.log_y:
        axis.set_yscale("log")
    axis.grid(alpha=0.25)
    axis.legend(loc="best", fontsize="small")
    figure.savefig(path)
