"""The window's arithmetic that knows no window: scalar products, small triangular systems, bounds of vectors."""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window.arrays import PIVOT_SHARE, UNDETERMINED


@compiled_reassociating
def dot(a: FloatArray, b: FloatArray, n: int) -> float:
    """Scalar product of the first n elements."""
    total = 0.0
    for j in range(n):
        total += a[j] * b[j]
    return total


@compiled_reassociating
def add_scaled(a: FloatArray, factor: float, b: FloatArray, n: int) -> None:
    """a <- a + factor b over the first n elements."""
    for j in range(n):
        a[j] += factor * b[j]


@compiled_reassociating
def factor_small(G: FloatArray) -> None:
    """Cholesky factor of a small matrix in place (lower); pivots that vanish are set to 0 with their column."""
    p = G.shape[0]
    for j in range(p):
        whole = G[j, j]
        t = whole
        for k in range(j):
            t -= G[j, k] * G[j, k]
        pivot = np.sqrt(t) if t > PIVOT_SHARE * whole else 0.0
        G[j, j] = pivot
        for i in range(j + 1, p):
            t = G[i, j]
            for k in range(j):
                t -= G[i, k] * G[j, k]
            G[i, j] = t / pivot if pivot > 0.0 else 0.0


@compiled_reassociating
def solve_small(G: FloatArray, rhs: FloatArray) -> None:
    """rhs <- (G G')^-1 rhs in place; coefficients of columns with a zero pivot become 0."""
    p = rhs.shape[0]
    for i in range(p):
        t = rhs[i]
        for j in range(i):
            t -= G[i, j] * rhs[j]
        rhs[i] = t / G[i, i] if G[i, i] > 0.0 else 0.0
    for r in range(p):
        i = p - 1 - r
        t = rhs[i]
        for j in range(i + 1, p):
            t -= G[j, i] * rhs[j]
        rhs[i] = t / G[i, i] if G[i, i] > 0.0 else 0.0


@compiled_reassociating
def half_norm_small(G: FloatArray, u: FloatArray) -> float:
    """u' (G G')^-1 u; ``u`` is overwritten."""
    total = 0.0
    for i in range(u.shape[0]):
        t = u[i]
        for j in range(i):
            t -= G[i, j] * u[j]
        u[i] = t / G[i, i] if G[i, i] > 0.0 else 0.0
        total += u[i] * u[i]
    return total


@compiled_reassociating
def bounded(a: FloatArray, n: int, most: float) -> bool:
    """True where the first n elements are numbers of at most this size."""
    good = True
    for j in range(n):
        good = good and abs(a[j]) <= most
    return good


@compiled_reassociating
def finite(a: FloatArray, n: int) -> bool:
    """True where the first n elements are all finite."""
    total = 0.0
    for j in range(n):
        total += a[j] * 0.0
    return total == 0.0


@compiled_reassociating
def left_out(alpha: float, diagonal: float, without: float) -> float:
    """The leave-one-out residual alpha/without; NaN where the others do not determine the unpenalised part."""
    return alpha / without if without > UNDETERMINED * diagonal else np.nan
