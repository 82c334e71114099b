"""Three levels of Bayesian inference for the LSSVM, (2.33)-(2.36), with gradients and without eigenvectors.

Level 1 gives beta and alpha, level 2 gamma, level 3 the kernel widths. In the notation of `adaptive.lssvm`, with
D = 1/gamma, Pc = P - S S'/G with G = 1'S, alpha = Pc y and 2 J1 = y'alpha:

    E_D = ½ sum e_i²,  e_i = alpha_i/gamma;   E_W = J1 - gamma E_D;   N - Geff = tr(Pc D)
    mu = (Geff - 1)/(2 E_W),  zeta = (N - Geff)/(2 E_D)
    J2 = log|R| + log(G/N) + (N - 1) log J1                       (minus twice the log evidence, up to a constant)
    J3 = J2 + log(Geff - 1) + log(N - Geff)

One evaluation with all gradients costs one factorisation, one inverse and, for level 3, one matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive import features, lssvm
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class EvidenceSamples:
    """The samples that hyper-parameters are inferred from; made by `evidence_samples`."""

    X: FloatArray
    y: FloatArray

    @property
    def size(self) -> int:
        """N."""
        return int(self.y.size)

    @property
    def dimension(self) -> int:
        """d."""
        return int(self.X.shape[1])

    def subset(self, rows: NDArray[np.int64]) -> EvidenceSamples:
        """Some of the rows."""
        return EvidenceSamples(self.X[rows], self.y[rows])


def evidence_samples(X: FloatArray, y: FloatArray) -> EvidenceSamples:
    """Check and collect normalised samples; arguments as those of `lssvm.fit`. Raises InputError."""
    X, y = np.ascontiguousarray(X, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if X.ndim != 2 or y.shape != (X.shape[0],):
        raise InputError(f"X, y: got shapes {X.shape} and {y.shape}, expected (N, d) and (N,)")
    if y.size < 4:
        raise InputError(f"X: got {y.size} samples, expected at least 4 to infer hyper-parameters from")
    if not (np.all(np.isfinite(X)) and np.all(np.isfinite(y))):
        raise InputError("X, y: got values that are not finite; drop those rows")
    if np.ptp(y) == 0:
        raise InputError("y: all targets are equal, nothing can be inferred from them; excite the stage")
    return EvidenceSamples(X, y)


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of one pair of gamma and widths; names as in the formulas at the top.

    Attributes
    ----------
    gamma : regularisation.  widths : (d,).
    E_W, E_D, effective, mu, zeta, J2, J3 : see the top; ``effective`` is Geff.
    J2_gradient : (1 + d,) by log gamma, then by each log width.
    J3_gradient : (d,) of J3 by each log width *along the optimum of J2 in gamma*; NaN where not asked for.
    J2_curvature : second derivative of J2 by log gamma; NaN where not asked for.
    """

    gamma: float
    widths: FloatArray
    E_W: float
    E_D: float
    effective: float
    mu: float
    zeta: float
    J2: float
    J3: float
    J2_gradient: FloatArray
    J3_gradient: FloatArray
    J2_curvature: float


@lssvm.one_thread
def evaluate(data: EvidenceSamples, gamma: float, widths: FloatArray, third_level: bool = False) -> Evidence:
    """Evidence at one pair of gamma and widths (d,), with its gradients.

    Raises
    ------
    NumericsError : R is singular in double precision at these hyper-parameters.
    """
    n = data.size
    K = features.gram(data.X, None, widths)
    noise = np.full(n, 1.0 / gamma)
    P = K.copy()
    P[np.diag_indices(n)] += noise
    lssvm.cholesky_lower(P)
    log_det = 2.0 * float(np.sum(np.log(np.diag(P))))
    lssvm.inverse_from_cholesky(P)
    Pc = np.tril(P, -1)
    Pc += Pc.T
    Pc[np.diag_indices(n)] = np.diag(P)
    ones = np.ones((n, 1))
    S = Pc @ ones
    G = ones.T @ S
    Pc -= S @ np.linalg.solve(G, S.T)
    alpha = Pc @ data.y
    twice_J1 = float(data.y @ alpha)
    fit = float(np.sum(noise * alpha * alpha))  # 2 gamma E_D
    E_D = 0.5 * fit / gamma
    E_W = 0.5 * (twice_J1 - fit)
    left = float(np.diag(Pc) @ noise)  # N - Geff
    effective = n - left
    J2 = log_det + log(abs(G[0, 0])) - log(n) + (n - 1) * np.log(0.5 * twice_J1)
    J3 = J2 + np.log(max(effective - 1.0, 1e-300)) + np.log(max(left, 1e-300))
    share = (n - 1) / twice_J1
    by_gamma = -left + share * fit
    widths_gradient = _by_widths(data.X, widths, K, Pc - share * np.outer(alpha, alpha))
    third, curvature = np.full(data.dimension, np.nan), np.nan
    if third_level:
        half = Pc * np.sqrt(noise)
        M = half @ half.T  # Pc D Pc
        v = Pc @ (noise * alpha)
        along_M = _by_widths(data.X, widths, K, M)
        along_alpha = _by_widths(data.X, widths, K, np.outer(alpha, alpha))
        along_v = _by_widths(data.X, widths, K, 0.5 * (np.outer(v, alpha) + np.outer(alpha, v)))
        left_by_gamma = float(np.diag(M) @ noise) - left
        fit_by_gamma = 2.0 * float(v @ (noise * alpha)) - fit
        curvature = -left_by_gamma + share * (fit_by_gamma - fit * fit / twice_J1)
        mixed = along_M + share * (-2.0 * along_v + fit * along_alpha / twice_J1)
        by_left = 1.0 / left - 1.0 / (effective - 1.0)
        shift = -mixed / curvature  # d log gamma / d log width along the optimum of J2
        third = widths_gradient - by_left * along_M + (by_gamma + by_left * left_by_gamma) * shift
    return Evidence(
        gamma,
        widths.copy(),
        E_W,
        E_D,
        effective,
        (effective - 1.0) / (2.0 * E_W),
        left / (2.0 * E_D),
        float(J2),
        float(J3),
        np.concatenate([[by_gamma], widths_gradient]),
        third,
        float(curvature),
    )


def _by_widths(X: FloatArray, widths: FloatArray, K: FloatArray, Q: FloatArray) -> FloatArray:
    """sum(Q * dOmega/dlog sigma_j) for each feature j, (d,), with dOmega = 2 K (x_j - x_j')²/sigma_j².

    With T = Q * K the sum of T_ab (x_a - x_b)² is 2 (sum_a (T1)_a x_a² - x'Tx): products with vectors only.
    """
    T = Q * K
    centred = (X - X.mean(axis=0)) / widths
    rows = T.sum(axis=1)
    return np.asarray(4.0 * (rows @ (centred * centred) - np.sum(centred * (T @ centred), axis=0)), dtype=np.float64)
