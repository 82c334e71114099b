"""The least-squares support vector machine and its direct solver, the oracle for the recursive window.

The dual system (2.27), with a noise weight w_i for each sample:

    y = b + K alpha,      [ 0   1'                          ] [  b  ]   [0]
                          [ 1   Omega + diag(1/(gamma w_i)) ] [alpha] = [y]

With R the lower right block and P = R^-1: S = P 1, Sy = P y, b = 1'Sy/(1'S) (2.29), alpha = Sy - b S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from dehyst.adaptive import kernels, lapack
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray


def check_gamma(gamma: float) -> float:
    """Gamma as a float; raises InputError unless it is positive and finite."""
    if not (np.isfinite(gamma) and gamma > 0):
        raise InputError(f"gamma: got {gamma!r}, expected a positive finite number (the chapter starts from 100)")
    return float(gamma)


@dataclass(frozen=True, slots=True)
class LssvmModel:
    """An immutable LSSVM, everything a prediction needs (2.32). All dimensionless.

    Attributes
    ----------
    X : (N, d) support vectors.  alpha : (N,) dual weights.  bias : b.  widths : (d,) kernel widths sigma.
    scale : variance of the kernel process, 1/mu of (2.33); that of the noise of a sample of weight 1 is scale/gamma.
    """

    X: FloatArray
    alpha: FloatArray
    bias: float
    widths: FloatArray
    scale: float

    def predict(self, X: FloatArray) -> FloatArray:
        """Mean at the points ``X`` (M, d): (M,). Raises InputError on another number of features."""
        if X.ndim != 2 or X.shape[1] != self.X.shape[1]:
            raise InputError(f"X: got shape {X.shape}, expected (M, {self.X.shape[1]}), one row a point")
        return np.asarray(kernels.gram(X, self.X, self.widths) @ self.alpha + self.bias, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LssvmFit:
    """A model with what it was solved from: L (N, N), lower Cholesky factor of R, S (N, 1) = P 1, G (1, 1) = 1'P 1."""

    model: LssvmModel
    L: FloatArray
    S: FloatArray
    G: FloatArray

    def leave_one_out(self) -> FloatArray:
        """y_i minus the prediction of the model trained without sample i, exact: alpha_i / (P_ii - S_i²/G), (N,)."""
        P = self.L.copy()
        lapack.inverse_from_cholesky(P)
        diagonal = np.diag(P) - np.sum(self.S * np.linalg.solve(self.G, self.S.T).T, axis=1)
        return np.asarray(self.model.alpha / diagonal, dtype=np.float64)


@lapack.one_thread
def fit(X: FloatArray, y: FloatArray, widths: object, gamma: float, weights: FloatArray | None = None) -> LssvmFit:
    """Solve (2.27) by one Cholesky factorisation.

    Parameters
    ----------
    X : (N, d) normalised features.  y : (N,) normalised targets.
    widths : kernel width sigma, one for all or (d,).  gamma : regularisation, > 0.
    weights : (N,) positive noise weights, all 1 if not given; a doubtful sample has less than 1.

    Raises
    ------
    InputError : shapes, non-finite samples, weights or hyper-parameters out of range.
    NumericsError : R is singular in double precision.
    """
    X, y = np.ascontiguousarray(X, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if X.ndim != 2 or y.shape != (X.shape[0],):
        raise InputError(f"X, y: got shapes {X.shape} and {y.shape}, expected (N, d) and (N,)")
    n, dimension = X.shape
    if n < 2:
        raise InputError(f"X: got {n} samples, expected at least 2")
    if not (np.all(np.isfinite(X)) and np.all(np.isfinite(y))):
        raise InputError("X, y: got values that are not finite, expected finite samples; drop those rows")
    sigma, gamma = kernels.as_widths(widths, dimension), check_gamma(gamma)
    w = np.ones(n) if weights is None else np.ascontiguousarray(weights, dtype=np.float64)
    if w.shape != (n,) or not np.all(np.isfinite(w)) or not np.all(w > 0):
        raise InputError(f"weights: got shape {w.shape}, expected ({n},) positive finite numbers, 1 for a plain sample")
    L = kernels.gram(X, None, sigma)
    L[np.diag_indices(n)] += 1.0 / (gamma * w)
    lapack.cholesky_lower(L)
    L = np.tril(L)
    half = solve_triangular(L, np.column_stack([np.ones(n), y]), lower=True, check_finite=False)
    both = solve_triangular(L, half, lower=True, trans=1, check_finite=False)
    q, r = np.linalg.qr(half[:, :-1])
    bias = solve_triangular(r, q.T @ half[:, -1], lower=False)
    alpha = solve_triangular(L, half[:, -1] - half[:, :-1] @ bias, lower=True, trans=1, check_finite=False)
    model = LssvmModel(X.copy(), alpha, float(bias[0]), sigma, max(float(y @ alpha), 0.0) / (n - 1))
    return LssvmFit(model, L, np.ascontiguousarray(both[:, :-1]), r.T @ r)
