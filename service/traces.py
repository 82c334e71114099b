"""Figures with long lines over time, drawn without a display: what pictures of replays and of scenarios share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

#: Points beyond which a line is drawn as its extremes only.
MOST_POINTS = 4000


def traces(width: float, height: float, rows: int, **options: Any) -> tuple[Any, Any]:
    """(figure, axes) of ``rows`` plots below each other; sizes in inches, ``options`` are those of ``subplots``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, 1, **options)


def envelope(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """A line (n,) that keeps the extremes of what it leaves out."""
    stride = max(1, 2 * len(values) // MOST_POINTS)
    if stride < 3:
        return t_s, values
    n = len(values) // stride * stride
    rows = values[:n].reshape(-1, stride)
    return np.repeat(t_s[:n:stride], 2), np.stack([rows.min(axis=1), rows.max(axis=1)], axis=1).ravel()
