"""Pictures of an identification, drawn without a display. The only place besides the demo that imports matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.identification.identifying import Identified, Stretch

#: Colours that stay apart in print and for the colour-blind (Okabe and Ito), one per model.
COLOURS = {
    "linear": "#999999",
    "bouc_wen": "#E69F00",
    "mpi": "#56B4E9",
    "lssvm_frozen": "#CC79A7",
    "lssvm_adaptive": "#009E73",
}
LABELS = {
    "linear": "linear gain",
    "bouc_wen": "Bouc-Wen",
    "mpi": "modified Prandtl-Ishlinskii",
    "lssvm_frozen": "LSSVM, two inputs",
    "lssvm_adaptive": "LSSVM with memory",
}
#: Points beyond which a line is thinned for drawing.
MOST_POINTS = 4000


def _thinned(*columns: NDArray[Any]) -> list[NDArray[Any]]:
    stride = max(1, len(columns[0]) // MOST_POINTS)
    return [column[::stride] for column in columns]


def _figure(width: float, height: float, rows: int, columns: int, **options: Any) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def draw_identification(
    path: Path,
    title: str,
    train: Stretch,
    test: Stretch,
    dt_s: float,
    results: list[Identified],
    gain_um_per_V: float,
) -> None:
    """Write one PNG: the measured loop beside the models' held-out loops, and the held-out residual over time.

    Residuals are voltage errors seen as displacement through the mean gain, µm. Raises OSError from the disk.
    """
    shown = [result for result in results if result.score is not None]
    figure, axes = _figure(12.0, 8.0, 2, 2, width_ratios=[1.0, 1.4])
    figure.suptitle(title)
    loop, spread, residual, bars = axes[0, 0], axes[0, 1], axes[1, 1], axes[1, 0]

    u, y = _thinned(train.u_V, train.y_um)
    loop.plot(u, y, color="#BBBBBB", linewidth=0.8, label="identified from")
    u, y = _thinned(test.u_V, test.y_um)
    loop.plot(u, y, color="black", linewidth=0.8, label="held out")
    loop.set_xlabel("voltage u / V")
    loop.set_ylabel("displacement y / µm")
    loop.set_title("measured loop")
    loop.legend(loc="upper left", fontsize="small")

    best = min(shown, key=lambda result: result.score.rmse_V if result.score else np.inf, default=None)
    for name in dict.fromkeys(["linear", best.name if best else ""]):
        result = next((r for r in shown if r.name == name), None)
        if result is not None:
            motion, error = _thinned(test.motion[:, 0], result.error_V)
            spread.plot(motion, error * 1e3, color=COLOURS[name], linewidth=0.7, label=LABELS[name])
    spread.set_xlabel("displacement y / µm")
    spread.set_ylabel("voltage error / mV")
    spread.set_title("what of the loop is left, held out")
    spread.legend(loc="best", fontsize="small")

    t_s = np.arange(len(test)) * dt_s
    # A straight line's error is many times the others' and would hide them; the plot above has it.
    compared = [result for result in shown if result.name != "linear"] or shown
    for result in compared:
        time_s, error = _thinned(t_s, result.error_V)
        label = LABELS[result.name]
        residual.plot(time_s, error * abs(gain_um_per_V), color=COLOURS[result.name], linewidth=0.8, label=label)
    residual.set_xlabel("time since the held-out part began / s")
    residual.set_ylabel("equivalent displacement error / µm")
    residual.set_title("held-out residual, free run")
    residual.axhline(0.0, color="black", linewidth=0.5)
    residual.margins(y=0.18)
    residual.legend(loc="upper right", fontsize="small", ncols=2)

    values = [result.score.rmse_um for result in shown if result.score]
    names = [result.name for result in shown]
    drawn = bars.barh(range(len(names)), values, color=[COLOURS[name] for name in names])
    bars.bar_label(drawn, labels=[f"{value:.3g}" for value in values], padding=3, fontsize="small")
    bars.set_yticks(range(len(names)), [LABELS[name] for name in names])
    bars.invert_yaxis()
    bars.set_xlabel("held-out RMSE, equivalent displacement / µm")
    bars.set_title("held-out error")
    bars.margins(x=0.15)
    for axis in (loop, spread, residual, bars):
        axis.grid(True, alpha=0.3)
    figure.savefig(path)
