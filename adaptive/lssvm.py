"""The least-squares support vector machine and its direct solver, the oracle for the recursive window.

The dual system (2.27), generalised to a **partially linear** form and to per-sample noise weights w_i:

    y = H beta + K alpha,      [ 0   H'                          ] [beta ]   [0]
                               [ H   Omega + diag(1/(gamma w_i)) ] [alpha] = [y]

H = [1] is the chapter (p = 1, beta = b). H = [1, some features] adds an unpenalised linear part beside the
kernel, so that the model continues along a straight line where the kernel has no samples. With R the lower
right block and P = R^-1: S = P H, Sy = P y, beta = (H'S)^-1 H'Sy (2.29), alpha = Sy - S beta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from dehyst.adaptive import kernels, lapack
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray, StateDict


def design(X: FloatArray, linear: tuple[int, ...]) -> FloatArray:
    """H of the points ``X`` (N, d): a column of ones, then the features named in ``linear``: (N, p)."""
    H = np.ones((X.shape[0], 1 + len(linear)))
    for c, j in enumerate(linear):
        H[:, 1 + c] = X[:, j]
    return H


def check_linear(linear: tuple[int, ...], dimension: int) -> tuple[int, ...]:
    """The columns of the linear part, checked against the number of features. Raises InputError."""
    columns = tuple(int(j) for j in linear)
    if len(set(columns)) != len(columns) or any(not 0 <= j < dimension for j in columns):
        raise InputError(f"linear: got {linear!r}, expected distinct feature numbers from 0 to {dimension - 1}")
    return columns


def check_gamma(gamma: float) -> float:
    """Gamma as a float; raises InputError unless it is positive and finite."""
    if not (np.isfinite(gamma) and gamma > 0):
        raise InputError(f"gamma: got {gamma!r}, expected a positive finite number (the chapter starts from 100)")
    return float(gamma)


@dataclass(frozen=True, slots=True)
class LssvmModel:
    """An immutable LSSVM, everything a prediction needs; (2.32) with a linear part. All dimensionless.

    Attributes
    ----------
    X : (N, d) support vectors.  alpha : (N,) dual weights.  beta : (p,) bias, then slopes of the linear part.
    widths : (d,) kernel widths sigma.  gamma : regularisation, mu-to-zeta ratio of (2.33).
    weights : (N,) noise weights; the noise variance of sample i is noise_variance / w_i.
    linear : features that enter the linear part.
    scale : variance of the kernel process, 1/mu of (2.33); the noise variance is scale / gamma.
    """

    X: FloatArray
    alpha: FloatArray
    beta: FloatArray
    widths: FloatArray
    gamma: float
    weights: FloatArray
    linear: tuple[int, ...] = ()
    scale: float = 1.0

    @property
    def noise_variance(self) -> float:
        """Variance of the noise of a sample of weight 1: 1/zeta."""
        return self.scale / self.gamma

    def predict(self, X: FloatArray) -> FloatArray:
        """Mean at the points ``X`` (M, d): (M,). Raises InputError on another number of features."""
        if X.ndim != 2 or X.shape[1] != self.X.shape[1]:
            raise InputError(f"X: got shape {X.shape}, expected (M, {self.X.shape[1]}), one row a point")
        mean = kernels.gram(X, self.X, self.widths) @ self.alpha + design(X, self.linear) @ self.beta
        return np.asarray(mean, dtype=np.float64)

    def state_dict(self) -> StateDict:
        """Arrays and scalars; ``from_state`` builds an equal model."""
        return {
            "X": self.X.copy(),
            "alpha": self.alpha.copy(),
            "beta": self.beta.copy(),
            "widths": self.widths.copy(),
            "gamma": self.gamma,
            "weights": self.weights.copy(),
            "linear": list(self.linear),
            "scale": self.scale,
        }

    @classmethod
    def from_state(cls, state: StateDict) -> LssvmModel:
        arrays = {
            name: np.ascontiguousarray(state[name], dtype=np.float64)
            for name in ("X", "alpha", "beta", "widths", "weights")
        }
        linear = tuple(int(j) for j in state["linear"])
        return cls(**arrays, gamma=float(state["gamma"]), linear=linear, scale=float(state["scale"]))


@dataclass(frozen=True, slots=True)
class LssvmFit:
    """A model with the factor that it was solved from, for variance and leave-one-out.

    Attributes
    ----------
    model : the solution.  y : (N,) targets.
    L : (N, N) lower Cholesky factor of R.  S : (N, p) = P H.  Sy : (N,) = P y.  G : (p, p) = H' P H.
    """

    model: LssvmModel
    y: FloatArray
    L: FloatArray
    S: FloatArray
    Sy: FloatArray
    G: FloatArray

    def inverse(self) -> FloatArray:
        """P = R^-1, (N, N), symmetric to the last bit."""
        P = self.L.copy()
        lapack.inverse_from_cholesky(P)
        lapack.mirror_lower(P)
        return P

    def variance(self, X: FloatArray, include_noise: bool = False) -> FloatArray:
        """Variance at the points ``X`` (M, d): (M,), of the function, or with the noise of a sample of weight 1.

        Of the Gaussian posterior of (2.33) with a flat prior on beta:
        scale * (1 - k'P k + u' G^-1 u), u = h - S'k.
        """
        model = self.model
        k = kernels.gram(model.X, X, model.widths)
        half = solve_triangular(self.L, k, lower=True, check_finite=False)
        u = design(X, model.linear).T - self.S.T @ k
        latent = 1.0 - np.sum(half * half, axis=0) + np.sum(u * np.linalg.solve(self.G, u), axis=0)
        noise = model.noise_variance if include_noise else 0.0
        return np.asarray(model.scale * np.maximum(latent, 0.0) + noise, dtype=np.float64)

    def leave_one_out(self) -> FloatArray:
        """y_i minus the prediction of the model trained without sample i, exact: alpha_i / (Pc)_ii, (N,)."""
        diagonal = np.diag(self.inverse()) - np.sum(self.S * np.linalg.solve(self.G, self.S.T).T, axis=1)
        return np.asarray(self.model.alpha / diagonal, dtype=np.float64)


@lapack.one_thread
def fit(
    X: FloatArray,
    y: FloatArray,
    widths: object,
    gamma: float,
    weights: FloatArray | None = None,
    linear: tuple[int, ...] = (),
) -> LssvmFit:
    """Solve (2.27) in its generalised form by one Cholesky factorisation.

    Parameters
    ----------
    X : (N, d) normalised features.  y : (N,) normalised targets.
    widths : kernel width sigma, one for all or (d,).  gamma : regularisation, > 0.
    weights : (N,) positive noise weights, all 1 if not given; a doubtful sample has less than 1.
    linear : features that enter the unpenalised linear part beside the kernel.

    Raises
    ------
    InputError : shapes, non-finite samples, weights or hyper-parameters out of range.
    NumericsError : R or H'PH is singular in double precision.
    """
    X, y = np.ascontiguousarray(X, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if X.ndim != 2 or y.shape != (X.shape[0],):
        raise InputError(f"X, y: got shapes {X.shape} and {y.shape}, expected (N, d) and (N,)")
    n, dimension = X.shape
    linear = check_linear(linear, dimension)
    if n <= 1 + len(linear):
        raise InputError(f"X: got {n} samples, expected more than the {1 + len(linear)} unpenalised coefficients")
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
    H = design(X, linear)
    half = solve_triangular(L, np.column_stack([H, y]), lower=True, check_finite=False)
    both = solve_triangular(L, half, lower=True, trans=1, check_finite=False)
    S, Sy = np.ascontiguousarray(both[:, :-1]), np.ascontiguousarray(both[:, -1])
    # From the half-solved columns by QR: forming H'PH first would square the condition of the linear part.
    q, r = np.linalg.qr(half[:, :-1])
    if np.min(np.abs(np.diag(r))) < 1e-13 * np.max(np.abs(np.diag(r))):
        raise NumericsError(
            "linear part: its columns do not differ on these samples; leave constant features out of it"
        )
    beta = solve_triangular(r, q.T @ half[:, -1], lower=False)
    alpha = solve_triangular(L, half[:, -1] - half[:, :-1] @ beta, lower=True, trans=1, check_finite=False)
    scale = max(float(y @ alpha), 0.0) / (n - H.shape[1])
    model = LssvmModel(X.copy(), alpha, beta, sigma, gamma, w.copy(), linear, scale)
    return LssvmFit(model, y.copy(), L, S, Sy, r.T @ r)
