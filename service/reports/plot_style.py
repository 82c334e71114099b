"""What all pictures share: size, colours, thinning. Drawn without a display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray

#: Colour-blind safe (Okabe and Ito), one per model; a learning form has its frozen model's colour.
COLOURS = {
    "measured": "black",
    "bouc_wen": "#E69F00",
    "mpi": "#56B4E9",
    "mpi_lag": "#0072B2",
    "lssvm": "#CC79A7",
    "lssvm_memory": "#009E73",
    "none": "#999999",
}
MOST_POINTS = 2500


def colour(key: str) -> str:
    """Colour of a model by its key, that of its frozen form where it learns."""
    for suffix in ("_online", "_adaptive", "_pso", "_given"):
        if key.endswith(suffix):
            key = "lssvm_memory" if suffix == "_adaptive" else key.removesuffix(suffix)
    return COLOURS.get(key, "#D55E00")


def figure(rows: int, columns: int, size: tuple[float, float], title: str, **options: Any) -> tuple[Any, Any]:
    """A figure of ``rows`` x ``columns`` axes (always a 2-D array of them), inches; savable as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=size, layout="constrained", dpi=100)
    FigureCanvasAgg(drawn)
    drawn.suptitle(title, fontsize=11)
    axes = drawn.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.ravel():
        axis.grid(True, alpha=0.25)
        axis.tick_params(labelsize=8)
    return drawn, axes


def save(drawn: Any, path: Path) -> Path:
    """Write the PNG. Raises OSError from the disk."""
    drawn.savefig(path)
    return path


def line(axis: Any, x: FloatArray, y: FloatArray, **style: Any) -> None:
    """Plot, thinned to what can be seen; peaks of fast waves are kept by thinning no further than needed."""
    stride = max(1, x.size // MOST_POINTS)
    axis.plot(np.asarray(x)[::stride], np.asarray(y)[::stride], **{"linewidth": 0.8, **style})


def label(axis: Any, x: str, y: str, title: str = "") -> None:
    """Axis labels with units, and a title."""
    axis.set_xlabel(x, fontsize=9)
    axis.set_ylabel(y, fontsize=9)
    if title:
        axis.set_title(title, fontsize=9)


# --- Figures with long lines over time, drawn without a display: what pictures of replays and of scenarios share.


Floats = NDArray[np.floating[Any]]

#: Points beyond which a line is drawn as its extremes only.
MOST_TRACE_POINTS = 4000


def traces(width: float, height: float, rows: int, **options: Any) -> tuple[Any, Any]:
    """(figure, axes) of ``rows`` plots below each other; sizes in inches, ``options`` are those of ``subplots``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, **options)


def envelope(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """A line (n,) that keeps the extremes of what it leaves out."""
    stride = max(1, 2 * len(values) // MOST_TRACE_POINTS)
    if stride < 3:
        return t_s, values
    n = len(values) // stride * stride
    rows = values[:n].reshape(-1, stride)
    return np.repeat(t_s[:n:stride], 2), np.stack([rows.min(axis=1), rows.max(axis=1)], axis=1).ravel()
