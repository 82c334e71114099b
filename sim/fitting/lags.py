"""First-order lags and moved instants of a signal: what several forms, the black box and the direct tests use."""

from __future__ import annotations

import math

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray


@compiled
def lag_ends(u: FloatArray, ratio: float, straight: bool) -> FloatArray:
    """(n,) output of a first-order lag at the beginning of each sample. ``ratio`` = time constant / sample time.

    The input is held over a sample or, with ``straight``, runs linearly to the next one.
    """
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    decay = math.exp(-1.0 / ratio)
    slope = 1.0 - ratio * (1.0 - decay)
    for k in range(n):
        out[k] = s
        gap = (s - u[k]) * decay
        s = u[k] + gap
        if straight and k + 1 < n:
            s += (u[k + 1] - u[k]) * slope
    return out


@compiled
def slow_poles(x: FloatArray, rates: FloatArray) -> FloatArray:
    """(m, n) first-order lags of x - x[0] with rates dt/tau (m,), exact for an x that is held over each sample."""
    m = rates.shape[0]
    n = x.shape[0]
    out = np.empty((m, n))
    for j in range(m):
        keep = math.exp(-rates[j])
        take = 1.0 - keep
        s = 0.0
        for k in range(n):
            out[j, k] = s
            s = keep * s + take * (x[k] - x[0])
    return out


@compiled
def resample_by(x: FloatArray, shifts: FloatArray) -> FloatArray:
    """(n,) x at the instants k + shifts[k] by cubic (Catmull-Rom) interpolation, constant beyond the ends."""
    n = x.shape[0]
    out = np.empty(n)
    for k in range(n):
        whole = math.floor(shifts[k])
        f = shifts[k] - whole
        i = k + int(whole)
        a = x[min(max(i - 1, 0), n - 1)]
        b = x[min(max(i, 0), n - 1)]
        c = x[min(max(i + 1, 0), n - 1)]
        d = x[min(max(i + 2, 0), n - 1)]
        out[k] = b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a)))
    return out
