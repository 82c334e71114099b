"""Least squares with lower bounds from normal equations, compiled: what the online fits solve while they serve.

The active-set method of Lawson and Hanson (Solving Least Squares Problems, 1974, ch. 23) as in ``scipy.optimize.nnls``,
on the normal matrix that a fit with forgetting keeps anyway, and with unknowns that are free. The serving process needs
no ``scipy.optimize`` by it, whose import is a tenth of its start. The identification from a recording, which has the
rows themselves, solves by those (``baselines.prandtl_ishlinskii.identify.bounded_least_squares``).
"""

from __future__ import annotations

import math

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import BoolArray, FloatArray

#: Share of the largest right-hand side below which a gradient counts as zero.
_FLAT = 1e-12


@compiled
def _solve_passive(
    A: FloatArray, b: FloatArray, passive: BoolArray, L: FloatArray, s: FloatArray
) -> bool:  # pragma: no cover - compiled
    """Minimum over the unknowns in ``passive``, the others 0, into ``s``; False where A is not positive there."""
    p = b.shape[0]
    for i in range(p):
        s[i] = 0.0
        if not passive[i]:
            continue
        for j in range(i + 1):
            if not passive[j]:
                continue
            value = A[i, j]
            for k in range(j):
                if passive[k]:
                    value -= L[i, k] * L[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                L[i, i] = math.sqrt(value)
            else:
                L[i, j] = value / L[j, j]
    for i in range(p):
        if passive[i]:
            value = b[i]
            for k in range(i):
                if passive[k]:
                    value -= L[i, k] * s[k]
            s[i] = value / L[i, i]
    for i in range(p - 1, -1, -1):
        if passive[i]:
            value = s[i]
            for k in range(i + 1, p):
                if passive[k]:
                    value -= L[k, i] * s[k]
            s[i] = value / L[i, i]
    return True


@compiled
def _active_set(A: FloatArray, b: FloatArray, free: BoolArray, z: FloatArray) -> bool:  # pragma: no cover - compiled
    """Minimise z'Az/2 - b'z with z >= 0 but for the ``free``, into ``z``; False where it does not come to an end."""
    p = b.shape[0]
    L, s, passive = np.zeros((p, p)), np.zeros(p), free.copy()
    largest = 0.0
    for i in range(p):
        z[i] = 0.0
        largest = max(largest, abs(b[i]))
    if not _solve_passive(A, b, passive, L, s):
        return False
    for i in range(p):
        z[i] = s[i]
    for _ in range(50 * p):
        best, steepest = -1, _FLAT * largest
        for i in range(p):
            if not passive[i]:
                slope = b[i]
                for j in range(p):
                    slope -= A[i, j] * z[j]
                if slope > steepest:
                    best, steepest = i, slope
        if best < 0:
            return True
        passive[best] = True
        while True:
            if not _solve_passive(A, b, passive, L, s):
                return False
            way, blocked = 1.0, -1
            for i in range(p):
                if passive[i] and not free[i] and s[i] <= 0.0:
                    share = z[i] / (z[i] - s[i]) if z[i] > 0.0 else 0.0
                    if share < way:
                        way, blocked = share, i
            for i in range(p):
                z[i] += way * (s[i] - z[i])
            if blocked < 0:
                break
            passive[blocked] = False
            for i in range(p):
                if not free[i] and (not passive[i] or z[i] <= 0.0):
                    passive[i], z[i] = False, 0.0
    return False


def bounded_minimum(normal: FloatArray, right: FloatArray, lower: FloatArray) -> FloatArray:
    """Minimise x'Nx/2 - r'x over x >= lower, N (p, p) positive definite; a bound of -inf leaves an unknown free.

    Returns (p,). Raises RuntimeError where N is not positive definite in double precision or the search has no end.
    """
    free = np.isneginf(lower)
    shift = np.where(free, 0.0, lower)
    scale = np.sqrt(np.diag(normal))
    scale[~(scale > 0.0)] = 1.0
    z = np.empty(lower.size)
    scaled, scaled_right = normal / np.outer(scale, scale), (right - normal @ shift) / scale
    # A slope that is not a number would count as none.
    finite = np.isfinite(scaled).all() and np.isfinite(scaled_right).all()
    if not (finite and _active_set(scaled, scaled_right, free, z)):
        raise RuntimeError("the normal matrix is not positive definite")
    out: FloatArray = shift + z / scale
    return out
