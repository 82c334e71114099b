"""An inverse LSSVM fitted to the inputs of a recording: linear part, support vectors, hyper-parameters.

The linear part has a Gaussian prior, so that a short recording can't drive its coefficients wild; the kernel learns
what is left of it, on spread-out rows, with regularisation and widths of the best evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive import evidence, lssvm
from adaptive.features import FeatureMap
from adaptive.identification_config import IdentifyConfig
from adaptive.inference import InferenceConfig, infer
from adaptive.types import FloatArray

#: Prior standard deviations of the linear part as shares of the voltage range.
PRIOR_FREE, PRIOR_MOTION, PRIOR_POWER, PRIOR_PLAY, PRIOR_PRODUCT, PRIOR_ARC, PRIOR_SLOW = (
    10.0, 0.3, 0.1, 0.05, 0.01, 0.03, 0.03,
)  # fmt: skip
#: A model's error lasts about this long, s: so many samples of a recording count as one.
CORRELATION_S = 0.02
#: Smallest model error that the prior of the linear part reckons with, as a share of the voltage range.
ERROR_FLOOR = 5e-4
#: Rows that hyper-parameters are inferred from, and where they are searched: above a gamma of 1e5 only digits are
#: lost, below a width of 0.3 the kernel knows nothing between its samples.
EVIDENCE_ROWS = 240
SEARCH = InferenceConfig(
    starts=((100.0, 1.0), (100.0, 4.0)), gamma_range=(1.0, 1e5), width_range=(0.3, 12.0), iterations=20
)


def prior_deviations(features: FeatureMap, u_range_V: float) -> FloatArray:
    """(p,) prior standard deviations of the linear part, V per normalised input."""
    plays = len(features.thresholds_um)
    shares = [PRIOR_FREE, PRIOR_FREE, PRIOR_MOTION, PRIOR_MOTION, PRIOR_POWER, PRIOR_POWER]
    shares += [PRIOR_PLAY] * plays + [PRIOR_PRODUCT] * (plays * features.asymmetric)
    shares += [PRIOR_ARC] * len(features.arc_lengths_um) + [PRIOR_SLOW] * len(features.time_constants_s)
    return u_range_V * np.array(shares)


@dataclass(frozen=True, slots=True)
class Fit:
    """What a fit found: linear part with its covariance, support vectors with their weights, variances in V²."""

    beta: FloatArray
    covariance: FloatArray
    support: FloatArray
    alpha: FloatArray
    noise_variance: float
    kernel_variance: float


def _linear(
    features: FeatureMap, basis: FloatArray, target: FloatArray, u_range_V: float, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean (p,) and covariance (p, p) of the linear part; its noise level from its own residual."""
    precision = np.diag(prior_deviations(features, u_range_V) ** -2.0)
    gram, moment = basis.T @ basis, basis.T @ target
    repeats = max(1.0, CORRELATION_S / dt_s)
    variance = (0.01 * u_range_V) ** 2
    beta: FloatArray = np.zeros(basis.shape[1])
    information = precision
    for _ in range(4):
        information = precision + gram / (variance * repeats)
        beta = np.asarray(np.linalg.solve(information, moment / (variance * repeats)), dtype=np.float64)
        variance = max(float(np.mean((target - basis @ beta) ** 2)), (ERROR_FLOOR * u_range_V) ** 2)
    covariance = np.linalg.inv(information)
    return np.asarray(beta, dtype=np.float64), np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)


def select(kernel: FloatArray, widths: FloatArray, n: int) -> NDArray[np.int64]:
    """Indices of n spread-out rows: farthest-point sampling in scaled kernel inputs (m, d), deterministic."""
    m = kernel.shape[0]
    if n >= m:
        return np.arange(m)
    scaled = kernel / widths
    chosen = np.empty(n, dtype=np.int64)
    # Half evenly in time, so that density follows the recording; the rest where the space is still empty.
    chosen[: n // 2] = np.linspace(0, m - 1, n // 2).astype(np.int64)
    distance = np.full(m, np.inf)
    for k in range(n):
        if k >= n // 2:
            chosen[k] = int(np.argmax(distance))
        difference = scaled - scaled[chosen[k]]
        np.minimum(distance, np.einsum("ij,ij->i", difference, difference), out=distance)
    return np.unique(chosen)


def tune(
    features: FeatureMap,
    basis: FloatArray,
    kernel: FloatArray,
    u_V: FloatArray,
    dt_s: float,
    config: IdentifyConfig,
) -> tuple[float, FloatArray]:
    """(gamma, widths (d,)) by the evidence on what the kernel has to learn."""
    target = u_V
    if features.linear:
        beta, _ = _linear(features, basis, u_V, float(np.ptp(u_V)), dt_s)
        target = u_V - basis @ beta
    rows = select(kernel, np.ones(kernel.shape[1]), config.n)
    return evidence_search(kernel[rows], target[rows])


def fit_model(
    features: FeatureMap,
    basis: FloatArray,
    kernel: FloatArray,
    u: FloatArray,
    dt_s: float,
    config: IdentifyConfig,
    gamma: float,
    widths: FloatArray,
) -> Fit:
    """The model of basis (n, p), kernel inputs (n, d) and voltages (n,) with these hyper-parameters."""
    u_range = float(np.ptp(u))
    rows = select(kernel, widths, config.n)
    if not features.linear:
        fit = lssvm.fit(kernel[rows], u[rows], widths, gamma)
        return Fit(
            fit.model.beta,
            np.empty((0, 0)),
            fit.model.X,
            fit.model.alpha,
            float(np.mean(fit.leave_one_out() ** 2)),
            fit.model.scale,
        )
    beta, covariance = _linear(features, basis, u, u_range, dt_s)
    fit = lssvm.fit(kernel[rows], u[rows] - basis[rows] @ beta, widths, gamma)
    beta = beta.copy()
    beta[0] += fit.model.beta[0]
    return Fit(
        beta, covariance, fit.model.X, fit.model.alpha, float(np.mean(fit.leave_one_out() ** 2)), fit.model.scale
    )


def evidence_search(kernel: FloatArray, target: FloatArray) -> tuple[float, FloatArray]:
    """(gamma, widths (d,)) of the best evidence for kernel inputs (n, d) and targets (n,), on ``EVIDENCE_ROWS`` rows.

    Targets are normalised, so that the search is the same whatever the voltage.
    """
    step = max(1, -(-target.size // EVIDENCE_ROWS))
    spread = float(np.std(target)) or 1.0
    data = evidence.problem(kernel[::step], (target[::step] - float(np.mean(target))) / spread)
    best = infer(data, SEARCH).best
    return float(best.gamma), np.array(best.widths, dtype=np.float64)
