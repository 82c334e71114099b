"""The files of `dehyst diagnose`: report.json, report.md, its pictures, and the extended stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.service.reports.diagnosis_page import Source, length, page, picture_name
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.service.viewer import colours
from dehyst.service.viewer.colours import AFTER, BEFORE, DRIVE, NOISE_BAND
from dehyst.sim.diagnosis.export import export_stage
from dehyst.sim.diagnosis.result import Diagnosis, NamedCause, picture
from dehyst.sim.pictures import MEASURED, WITH, WITHOUT
from dehyst.sim.stage.file import save_stage

__all__ = ["Source", "draw_cause", "draw_residual", "write_report"]

_ROLES = {MEASURED: colours.MEASURED, WITHOUT: BEFORE, WITH: AFTER}


def write_report(out: Path, diagnosis: Diagnosis, source: Source) -> dict[str, Any]:
    """Write all files into the folder ``out`` and return the content of report.json.

    Raises InputError if the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        # Remove the pictures of an earlier diagnosis in this folder.
        for old in out.glob("[0-9]-*.png"):
            old.unlink()
        data = diagnosis.as_dict()
        (out / "report.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        exported = export_stage(diagnosis)
        save_stage(exported.config, out / "stage.toml")
        draw_residual(out / "residual.png", diagnosis, f"{source.data}: {diagnosis.verdict}")
        for place, cause in enumerate(diagnosis.causes):
            draw_cause(out / picture_name(place, cause), cause, diagnosis)
        (out / "report.md").write_text(page(diagnosis, exported, source), encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out: cannot write into {out}: {error.strerror}; name a folder you may write to") from error
    return data


def draw_residual(path: Path, diagnosis: Diagnosis, title: str) -> None:
    """Voltage, and the residuals of both stages over time, on the test recording if there is one."""
    nominal, extended = diagnosis.shown
    data = nominal.model.data
    drawn, grid = figure(3, 1, (9.0, 6.4), title, sharex=True)
    axes = grid[:, 0]
    line(axes[0], data.t_s, data.u_V, color=DRIVE, lw=0.7)
    axes[0].set_ylabel("voltage / V")
    pairs = (
        (nominal.residual_um, BEFORE, f"nominal stage, held out {length(diagnosis.nominal_heldout_um)}"),
        (extended.residual_um, AFTER, f"extended stage, held out {length(diagnosis.extended_heldout_um)}"),
    )
    size = float(np.quantile(np.abs(nominal.residual_um), 0.999))
    scale, unit = (1e3, "nm") if size < 1.0 else (1.0, "µm")
    for axis, (residual, colour, name) in zip(axes[1:], pairs, strict=True):
        band = 2.0 * scale * diagnosis.noise_floor_um
        axis.axhspan(-band, band, color=NOISE_BAND, alpha=0.5, lw=0)
        line(axis, data.t_s, scale * residual, color=colour, lw=0.6, label=name)
        # Both on one scale; the first samples, where the initial state shows, may be cut off.
        axis.set_ylim(-1.3 * scale * max(size, 1e-6), 1.3 * scale * max(size, 1e-6))
        axis.set_ylabel(f"residual / {unit}")
        legend(axis, loc="upper right")
    axes[-1].set_xlabel("time / s (grey: twice the noise floor)")
    save(drawn, path)


def draw_cause(path: Path, cause: NamedCause, diagnosis: Diagnosis) -> None:
    """The picture of one cause: the residual without it and with it."""
    shown = picture(cause, diagnosis.extended.model.data, diagnosis.catalogue)
    drawn, grid = figure(1, 1, (8.0, 3.6), cause.name.replace("_", " "))
    axis = grid[0, 0]
    named: set[str] = set()
    for curve in shown.curves:
        name = curve.label if curve.label not in named else None
        named.add(curve.label)
        axis.plot(
            curve.x,
            curve.y,
            color=_ROLES[curve.role],
            ls="--" if curve.dashed else "-",
            marker="o" if curve.points and curve.x.size < 100 else None,
            ms=3,
            lw=1.8 if curve.role == MEASURED else 1.0,
            alpha=0.5 if curve.role == MEASURED else 1.0,
            label=name,
        )
    for mark in shown.marks:
        axis.axvline(mark, color=DRIVE, lw=0.8, ls=":")
    label(axis, shown.x_name, shown.y_name)
    if shown.log_x:
        axis.set_xscale("log")
    if shown.log_y:
        axis.set_yscale("log")
    legend(axis, loc="best")
    save(drawn, path)
