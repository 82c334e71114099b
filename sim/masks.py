"""Runs and distances in masks over samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import BoolArray


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


def samples_until(moved: BoolArray) -> NDArray[np.int64]:
    """(n,) samples until the next True in ``moved`` (n,); n where none follows."""
    n = moved.size
    return np.asarray(samples_since(np.ascontiguousarray(moved[::-1]), before=2 * n)[::-1].clip(max=n))
