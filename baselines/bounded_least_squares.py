"""Least squares with lower bounds on the unknowns: from the rows, and from a normal matrix.

`bounded_least_squares` solves from the rows, as the identification of a recording does, `bounded_minimum` from the
normal matrix that an online fit keeps. Both by the active-set method of Lawson and Hanson, ``scipy.optimize.nnls``.
"""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.types import FloatArray

#: Least slope of an invertible curve, as a share of its mean slope.
SLOPE_FLOOR = 0.02


def bounded_least_squares(matrix: FloatArray, target: FloatArray, lower: FloatArray) -> FloatArray:
    """Minimise |matrix x - target| over x >= lower (p,); a bound of -inf leaves an unknown free. Returns (p,).

    Raises RuntimeError where the search does not end.
    """
    from scipy.optimize import nnls  # slow to import, and a process that only answers never needs it

    free = np.isneginf(lower)
    shift = np.where(free, 0.0, lower)
    wide = np.hstack([matrix, -matrix[:, free]])
    scale = np.linalg.norm(wide, axis=0)
    scale[scale == 0.0] = 1.0
    solution = nnls(wide / scale, target - matrix @ shift, maxiter=50 * wide.shape[1])[0] / scale
    out: FloatArray = shift + solution[: matrix.shape[1]]
    out[free] -= solution[matrix.shape[1] :]
    return out


def bounded_minimum(normal: FloatArray, right: FloatArray, lower: FloatArray) -> FloatArray:
    """Minimise x'Nx/2 - r'x over x >= lower (p,), N (p, p) positive definite; a bound of -inf leaves an unknown free.

    Returns (p,). Raises RuntimeError where N is not positive definite in double precision or the search does not end.
    """
    scale = np.sqrt(np.abs(np.diag(normal)))
    scale[~(scale > 0.0)] = 1.0
    try:
        L = np.linalg.cholesky(normal / np.outer(scale, scale))
    except np.linalg.LinAlgError as error:
        raise RuntimeError("the normal matrix is not positive definite") from error
    if not (np.isfinite(L).all() and np.isfinite(right).all()):
        raise RuntimeError("the normal matrix is not finite and positive definite")
    # x'Nx/2 - r'x is half of |L'z - L^-1 r|² but for a constant, with z the scaled x.
    target = np.asarray(np.linalg.solve(L, right / scale), dtype=np.float64)
    found: FloatArray = bounded_least_squares(L.T, target, lower * scale) / scale
    return found
