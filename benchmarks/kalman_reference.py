"""The compiled Kalman filter of the learner against its reference, ``filterpy.kalman.KalmanFilter``.

Both filters take the same random-walk predictions and scalar measurements. The comparison shows that the compiled
algebra in ``adaptive.online.drift`` computes the same estimate, and what one update costs in each.
"""

from __future__ import annotations

import time

import numpy as np
from filterpy.kalman import KalmanFilter

from adaptive.online.drift import joseph, walk
from adaptive.types import FloatArray

#: Coefficients of the learner's linear part with the default features.
COEFFICIENTS = 63


def bench_kalman(updates: int, coefficients: int = COEFFICIENTS, seed: int = 0) -> dict[str, float]:
    """Errors of the compiled filter after ``updates`` steps, and µs per update (predict and correct) of both.

    ``estimate_error`` is the largest difference of the estimates relative to the largest coefficient,
    ``covariance_error`` that of the covariances relative to the largest variance.
    """
    rng = np.random.default_rng(seed)
    p, noise, gain_variance = coefficients, 1e-2, 1e-6
    x, P, walks = rng.standard_normal(p), np.eye(p), 1e-6 * rng.uniform(0.1, 1.0, p)
    truth, rows = x + 0.1 * rng.standard_normal(p), rng.standard_normal((updates, p))
    targets = rows @ truth + np.sqrt(noise) * rng.standard_normal(updates)
    reference = KalmanFilter(dim_x=p, dim_z=1)
    reference.x, reference.P = x.reshape(-1, 1).copy(), P.copy()
    start = time.perf_counter()
    for row, target in zip(rows, targets, strict=True):
        _reference_step(reference, row, float(target), noise, walks, gain_variance)
    reference_us = 1e6 * (time.perf_counter() - start) / updates
    scratch = np.empty(p), np.empty(p)
    walk(x.copy(), P.copy(), walks, gain_variance)  # load the compiled code before it is timed
    joseph(x.copy(), P.copy(), rows[0], float(targets[0]), noise, *scratch)
    start = time.perf_counter()
    for row, target in zip(rows, targets, strict=True):
        walk(x, P, walks, gain_variance)
        joseph(x, P, row, float(target), noise, *scratch)
    compiled_us = 1e6 * (time.perf_counter() - start) / updates
    return {
        "coefficients": float(p),
        "updates": float(updates),
        "estimate_error": float(np.abs(x - reference.x[:, 0]).max() / np.abs(x).max()),
        "covariance_error": float(np.abs(P - reference.P).max() / np.diag(P).max()),
        "reference_us": reference_us,
        "compiled_us": compiled_us,
    }


def _reference_step(
    reference: KalmanFilter, row: FloatArray, target: float, noise: float, walks: FloatArray, gain_variance: float
) -> None:
    x = reference.x[:, 0]
    reference.predict(F=np.eye(x.size), Q=np.diag(walks) + gain_variance * np.outer(x, x))
    reference.update(np.array([[target]]), R=noise, H=row[None, :])
    # Rounding leaves a small asymmetry, which the recursion would keep.
    reference.P = 0.5 * (reference.P + reference.P.T)
