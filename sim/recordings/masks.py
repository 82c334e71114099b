"""Readings that are none, by place: dropouts to zero, and samples that a recorder has doubled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptive.types import BoolArray, FloatArray
from sim.recordings.recording import Recording


def runs(mask: BoolArray) -> NDArray[np.int64]:
    """(k, 2) start and stop (excluded) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def dropout_mask(values: FloatArray) -> BoolArray:
    """(n,) True where a reading is exactly zero between readings far from it: no motion goes there and back."""
    mask = np.zeros(len(values), dtype=np.bool_)
    zero = values == 0.0
    if not zero.any() or zero.all():
        return mask
    others = values[~zero & np.isfinite(values)]
    if len(others) < 3:
        return mask
    steps = np.abs(np.diff(values))
    steps = steps[np.isfinite(steps) & (steps > 0.0)]
    jump = max(10.0 * float(np.median(steps)) if len(steps) else 0.0, 0.02 * float(np.ptp(others)))
    for start, stop in runs(zero):
        if start == 0 or stop == len(values):
            continue
        if abs(values[start - 1]) > jump and abs(values[stop]) > jump and values[start - 1] * values[stop] > 0.0:
            mask[start:stop] = True
    return mask


def repeat_mask(recording: Recording) -> BoolArray:
    """(n,) True where voltage and sensor both repeat the sample before exactly, though both move before and after."""
    du, dy = np.abs(np.diff(recording.u_V)), np.abs(np.diff(recording.y_um))
    mask = np.zeros(len(recording), dtype=np.bool_)
    if len(du) < 4:
        return mask
    still = (du == 0.0) & (dy == 0.0)
    steps = du[du > 0.0]
    # Where a coarse command moves by single steps of its converter, standing still once is no double.
    quantum = float(np.min(steps)) if len(steps) else 0.0
    moves = du > 3.0 * quantum
    mask[2:-1] = still[1:-1] & moves[:-2] & moves[2:]
    return mask
