"""Runs and distances in masks over samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptive.types import BoolArray


def runs(mask: BoolArray) -> NDArray[np.int64]:
    """(k, 2) start and stop (exclusive) of each run of True in ``mask`` (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def samples_since(moved: BoolArray, before: int = 0) -> NDArray[np.int64]:
    """(n,) samples since the last True in ``moved`` (n,); the first counts as ``before`` samples after one."""
    last = np.full(moved.size, -before)
    moves = np.flatnonzero(moved)
    last[moves] = moves
    return np.asarray(np.arange(moved.size) - np.maximum.accumulate(last))
