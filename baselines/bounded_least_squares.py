"""Least squares with lower bounds on the unknowns: from the rows, and from a normal matrix.

`bounded_least_squares` solves from the rows with ``scipy.optimize.nnls``; the identification of a recording uses it.
`bounded_minimum` solves from the normal matrix that an online fit keeps, with the same active-set method (Lawson and
Hanson, Solving Least Squares Problems, 1974, ch. 23) in compiled code. A serving process therefore does not import
``scipy.optimize``, which would take a tenth of its start-up time.
"""

from __future__ import annotations

import math

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import BoolArray, FloatArray

#: Least slope of an invertible curve, as a share of its mean slope.
SLOPE_FLOOR = 0.02
#: Share of the largest right-hand side below which a gradient counts as zero.
_FLAT = 1e-12


def bounded_least_squares(matrix: FloatArray, target: FloatArray, lower: FloatArray) -> FloatArray:
    """Minimise |matrix x - target| over x >= lower (p,); a bound of -inf leaves an unknown free. Returns (p,)."""
    from scipy.optimize import nnls  # slow to import, and a serving process may never need it

    free = np.isneginf(lower)
    shift = np.where(free, 0.0, lower)
    wide = np.hstack([matrix, -matrix[:, free]])
    scale = np.linalg.norm(wide, axis=0)
    scale[scale == 0.0] = 1.0
    solution = nnls(wide / scale, target - matrix @ shift, maxiter=50 * wide.shape[1])[0] / scale
    out: FloatArray = shift + solution[: matrix.shape[1]]
    out[free] -= solution[matrix.shape[1] :]
    return out


@compiled
def _solve_passive(
    A: FloatArray, b: FloatArray, passive: BoolArray, L: FloatArray, s: FloatArray
) -> bool:  # pragma: no cover - compiled
    """Minimise over the unknowns in ``passive``, with the others 0, into ``s`` (p,).

    Returns False where A (p, p) is not positive definite in these unknowns. ``L`` (p, p) is work space.
    """
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
    """Minimise z'Az/2 - b'z into ``z`` (p,), with z >= 0 except where ``free``; False where it does not converge."""
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
    """Minimise x'Nx/2 - r'x over x >= lower (p,), N (p, p) positive definite; a bound of -inf leaves an unknown free.

    Returns (p,). Raises RuntimeError where N is not positive definite in double precision or the search does not end.
    """
    free = np.isneginf(lower)
    shift = np.where(free, 0.0, lower)
    scale = np.sqrt(np.diag(normal))
    scale[~(scale > 0.0)] = 1.0
    z = np.empty(lower.size)
    scaled, scaled_right = normal / np.outer(scale, scale), (right - normal @ shift) / scale
    # The search would take a NaN gradient for zero.
    finite = np.isfinite(scaled).all() and np.isfinite(scaled_right).all()
    if not (finite and _active_set(scaled, scaled_right, free, z)):
        raise RuntimeError("the normal matrix is not positive definite")
    out: FloatArray = shift + z / scale
    return out
