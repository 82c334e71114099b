"""The style of all pictures: one figure maker, one thinning of long lines, one way to save.

Figures are drawn without a display and without matplotlib's global state. matplotlib is imported at the first figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray
from dehyst.sim.pictures import MOST_POINTS, envelope

__all__ = ["MOST_POINTS", "envelope", "figure", "label", "legend", "line", "save", "thinned"]


def figure(rows: int, columns: int, size: tuple[float, float], title: str = "", **options: Any) -> tuple[Any, Any]:
    """A figure and its (rows, columns) array of axes. ``size`` in inches; ``options`` are those of ``subplots``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=size, layout="constrained", dpi=110)
    FigureCanvasAgg(drawn)
    if title:
        drawn.suptitle(title, fontsize=11)
    axes = drawn.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.ravel():
        axis.grid(True, alpha=0.25)
        axis.tick_params(labelsize=8)
    return drawn, axes


def save(drawn: Any, path: Path) -> Path:
    """Write the PNG. Raises OSError from the disk."""
    drawn.align_ylabels()
    drawn.savefig(path)
    return path


def thinned(*columns: FloatArray) -> list[FloatArray]:
    """The columns of a loop, every k-th point, at most `MOST_POINTS` to twice as many."""
    stride = max(1, len(columns[0]) // MOST_POINTS)
    return [column[::stride] for column in columns]


def line(axis: Any, x: NDArray[np.floating[Any]], y: NDArray[np.floating[Any]], **style: Any) -> None:
    """Plot a long line: over time by its `envelope`, a loop by every k-th point."""
    along, values = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    over_time = bool(np.all(np.diff(along) >= 0.0))
    points = envelope(along, values) if over_time else thinned(along, values)
    axis.plot(*points, **{"lw": 0.8, **style})


def label(axis: Any, x: str, y: str, title: str = "") -> None:
    """Axis labels with units, and a title."""
    axis.set_xlabel(x, fontsize=9)
    axis.set_ylabel(y, fontsize=9)
    if title:
        axis.set_title(title, fontsize=9)


def legend(axis: Any, **options: Any) -> None:
    """A legend in small print."""
    axis.legend(**{"fontsize": 8, **options})
