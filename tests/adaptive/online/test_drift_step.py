"""The compiled algebra of the drift filter is that of filterpy's Kalman filter, step by step and over many of them."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive.online import drift as drift_step
from adaptive.online.drift import DriftConfig, DriftFilter

SPAN_V = 8.0


def positive(rng: np.random.Generator, p: int) -> np.ndarray:
    """A covariance with deviations over three decades."""
    root = rng.standard_normal((p, p)) * 10.0 ** rng.uniform(-3.0, 0.0, p)
    return np.asarray(root @ root.T)


def library(x: np.ndarray, P: np.ndarray) -> KalmanFilter:
    kf = KalmanFilter(dim_x=x.size, dim_z=1)
    kf.x, kf.P = x.reshape(-1, 1).copy(), P.copy()
    return kf


@settings(max_examples=60, deadline=None)
@given(p=st.integers(1, 30), seed=st.integers(0, 2**32 - 1), noise=st.floats(1e-8, 1e2))
def test_one_step_is_the_librarys(p: int, seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    x, P, h, z = rng.standard_normal(p), positive(rng, p), rng.standard_normal(p), float(rng.standard_normal())
    walks, along = 1e-4 * rng.uniform(size=p), 1e-3
    kf = library(x, P)
    kf.predict(F=np.eye(p), Q=np.diag(walks) + along * np.outer(x, x))
    kf.update(z, R=noise, H=h.reshape(1, -1))
    drift_step.walk(x, P, walks, along)
    drift_step.joseph(x, P, h, z, noise, np.empty(p), np.empty(p))
    scale = np.abs(P).max()
    np.testing.assert_allclose(x, kf.x[:, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, kf.P, rtol=0.0, atol=1e-9 * scale)
    assert np.array_equal(P, P.T)


@settings(max_examples=30, deadline=None)
@given(p=st.integers(1, 20), seed=st.integers(0, 2**32 - 1))
def test_at_rest_it_is_josephs_form_with_one_gain(p: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P, h, z, noise = rng.standard_normal(p), positive(rng, p), rng.standard_normal(p), 0.3, 0.01
    gain = np.zeros((p, 1))
    gain[0] = (P @ h)[0] / (h @ P @ h + noise)
    keep = np.eye(p) - gain @ h.reshape(1, -1)
    expected_x, expected_P = x + gain[:, 0] * (z - h @ x), keep @ P @ keep.T + noise * gain @ gain.T
    drift_step.update_constant(x, P, h, z, noise, np.empty(p))
    np.testing.assert_allclose(x, expected_x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(P, expected_P, rtol=0.0, atol=1e-10 * max(1.0, float(np.abs(P).max())))
    assert np.array_equal(P, P.T)


def test_ten_thousand_steps_stay_with_the_library_and_positive() -> None:
    p, n = 12, 10_000
    rng = np.random.default_rng(5)
    truth = rng.standard_normal(p)
    config = DriftConfig(gate_sigma=1e6, burst_ratio=1e9)
    made = DriftFilter(config, truth, 1e-4 * np.eye(p), 1e-3, SPAN_V)
    kf = library(truth, 1e-4 * np.eye(p))
    phase = np.cumsum(rng.uniform(0.001, 0.02, (n, p)), axis=0)
    noise = (config.noise * SPAN_V) ** 2
    walks = np.full(p, config.shape_walk)
    walks[0], walks[2:4] = config.offset_walk, config.motion_walk
    Q = np.diag((walks * SPAN_V) ** 2 * 1e-3)
    for k in range(n):
        h = np.sin(phase[k])
        z = float(h @ truth) * (1.0 if k < n // 2 else 1.03)
        made.update(h, z, True)
        kf.predict(F=np.eye(p), Q=Q + config.gain_walk**2 * 1e-3 * kf.x @ kf.x.T)
        kf.update(z, R=noise, H=h.reshape(1, -1))
        kf.P = 0.5 * (kf.P + kf.P.T)
    assert made.beta == pytest.approx(kf.x[:, 0], rel=1e-7, abs=1e-7)
    assert made.covariance == pytest.approx(kf.P, rel=1e-6, abs=1e-12)
    assert np.linalg.eigvalsh(made.covariance).min() > 0.0
