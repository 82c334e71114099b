"""How ill-conditioned a window's kernel matrix is, without eigenvalues: what decides between its two forms."""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray

#: Relative error of alpha that the inverse form settles at, as a share of cond(R)²: measured from cond 3e3 to 8e7,
#: windows of 100 to 500 samples with near-duplicates (docs/solver.md), and taken with some margin.
INVERSE_ERROR_SHARE = 3e-18


def inverse_form_serves(bound: float, accuracy: float) -> bool:
    """True where the inverse form keeps the relative error of alpha below ``accuracy`` at this condition number."""
    return INVERSE_ERROR_SHARE * bound * bound <= accuracy


def largest_eigenvalue(R: FloatArray, iterations: int = 12) -> float:
    """Of a symmetric matrix with positive elements (N, N), by power iteration from the vector of ones.

    Such a matrix's leading eigenvector has one sign (Perron), so that the start is never orthogonal to it;
    the Rayleigh quotient is then good to some per cent within a dozen steps.
    """
    v = np.ones(R.shape[0])
    value = 0.0
    for _ in range(iterations):
        w = R @ v
        value = float(v @ w / (v @ v))
        v = w / np.linalg.norm(w)
    return value


def condition_bound(R: FloatArray, gamma: float, weights: FloatArray) -> float:
    """Upper bound of cond(R), R = Omega + diag(1/(gamma w)): largest eigenvalue over the least noise variance.

    Omega is positive semidefinite, so no eigenvalue of R lies below the least 1/(gamma w_i); for kernels wider
    than the samples' spacing the bound is met closely. O(N²).
    """
    return largest_eigenvalue(R) * gamma * float(np.max(weights)) if R.size else 1.0
