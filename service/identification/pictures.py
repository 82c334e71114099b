"""The picture of an identification: measured loop, remaining loop, held-out residual and errors of all models."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.identification.identifying import Identified, Stretch
from service.reports.plot_style import figure, label, legend, line, save
from service.viewer.colours import MEASURED, TRAINING, model_colour

#: Names of the models in the legends.
LABELS = {
    "linear": "linear gain",
    "bouc_wen": "Bouc-Wen",
    "mpi": "modified Prandtl-Ishlinskii",
    "lssvm_frozen": "LSSVM, two inputs",
    "lssvm_adaptive": "LSSVM with memory",
}


def draw_identification(
    path: Path,
    title: str,
    train: Stretch,
    test: Stretch,
    dt_s: float,
    results: list[Identified],
    gain_um_per_V: float,
) -> None:
    """Write one PNG: measured loop, remaining loops on held-out data, held-out residual over time, errors.

    Residuals are voltage errors times the mean gain, µm. Raises OSError if the file cannot be written.
    """
    shown = [result for result in results if result.score is not None]
    drawn, axes = figure(2, 2, (12.0, 8.0), title, width_ratios=[1.0, 1.4])
    loop, remaining, residual, bars = axes[0, 0], axes[0, 1], axes[1, 1], axes[1, 0]

    line(loop, train.u_V, train.y_um, color=TRAINING, label="identified from")
    line(loop, test.u_V, test.y_um, color=MEASURED, label="held out")
    label(loop, "voltage u / V", "displacement y / µm", "measured loop")
    legend(loop, loc="upper left")

    best = min(shown, key=lambda result: result.score.rmse_V if result.score else np.inf, default=None)
    for name in dict.fromkeys(["linear", best.name if best else ""]):
        result = next((r for r in shown if r.name == name), None)
        if result is not None:
            motion, error = test.motion[:, 0], result.error_V * 1e3
            line(remaining, motion, error, color=model_colour(name), lw=0.7, label=LABELS[name])
    label(remaining, "displacement y / µm", "voltage error / mV", "remaining loop, held out")
    legend(remaining, loc="best")

    t_s = np.arange(len(test)) * dt_s
    # Without the linear model: its error is many times larger and is visible in the plot above.
    compared = [result for result in shown if result.name != "linear"] or shown
    for result in compared:
        error = result.error_V * abs(gain_um_per_V)
        line(residual, t_s, error, color=model_colour(result.name), label=LABELS[result.name])
    label(residual, "time since the held-out part began / s", "equivalent displacement error / µm")
    residual.set_title("held-out residual, free run", fontsize=9)
    residual.axhline(0.0, color="black", lw=0.5)
    residual.margins(y=0.18)
    legend(residual, loc="upper right", ncols=2)

    values = [result.score.rmse_um for result in shown if result.score]
    names = [result.name for result in shown]
    rows = bars.barh(range(len(names)), values, color=[model_colour(name) for name in names])
    bars.bar_label(rows, labels=[f"{value:.3g}" for value in values], padding=3, fontsize=8)
    bars.set_yticks(range(len(names)), [LABELS[name] for name in names])
    bars.invert_yaxis()
    label(bars, "held-out RMSE, equivalent displacement / µm", "", "held-out error")
    bars.margins(x=0.15)
    save(drawn, path)
