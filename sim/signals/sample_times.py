"""Sample times, computed from the count of samples and never summed."""

from __future__ import annotations

import math

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray


def sample_times(duration_s: float, dt_s: float) -> FloatArray:
    """``k dt_s`` (n,) s for all samples before ``duration_s``. Raises InputError unless both are above 0 and finite."""
    if not (math.isfinite(dt_s) and dt_s > 0.0):
        raise InputError(f"dt_s: got {dt_s!r}, expected a sample time above 0 s")
    if not (math.isfinite(duration_s) and duration_s >= dt_s):
        raise InputError(f"duration_s: got {duration_s!r}, expected at least one sample time, {dt_s} s")
    return np.arange(round(duration_s / dt_s), dtype=np.float64) * dt_s
