"""What the JSON of a peer holds, as numbers that can be drawn and as text: it may hold anything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from adaptive.types import FloatArray


def number(value: Any) -> float | None:
    """A finite number, or None for all else: JSON of a peer may hold anything."""
    if not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        value = float(value)
    except OverflowError:  # JSON knows integers of any length.
        return None
    return value if math.isfinite(value) else None


def column(value: Any) -> FloatArray | None:
    """A list of numbers as (n,) doubles, or None for all else."""
    if not isinstance(value, (list, tuple, np.ndarray)) or not len(value):
        return None
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return array if array.ndim == 1 else None


def as_markdown(title: str, fields: Mapping[str, Any], depth: int = 2) -> str:
    """A status as a table, nested names joined by dots; long lists are cut."""
    rows: list[str] = []

    def walk(prefix: str, part: Mapping[str, Any], left: int) -> None:
        for name, value in part.items():
            if isinstance(value, Mapping) and left:
                walk(f"{prefix}{name}.", value, left - 1)
            else:
                shown = f"{value:.6g}" if isinstance(value, float) else str(value)
                rows.append(f"| {prefix}{name} | {shown[:80].replace('|', '/')} |")

    walk("", fields, depth)
    return "\n".join([f"**{title}**", "", "| what | value |", "|---|---|", *rows])
