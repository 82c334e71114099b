"""The fixed-lag smoother is exact, causal, and equals a two-sided Butterworth response."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.smoothing import (
    FixedLagSmoother,
    SmootherConfig,
    backward_difference,
    smooth_recording,
    zero_phase_lowpass,
)

DT = 1e-3


def sine(hz: float, n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    t, w = np.arange(n) * DT, 2 * np.pi * hz
    y = 40 + 30 * np.sin(w * t)
    return y, np.column_stack([y, 30 * w * np.cos(w * t), -30 * w * w * np.sin(w * t)])


@pytest.mark.parametrize(("lag", "order"), [(0, 3), (9, 4), (16, 4), (12, 3)])
def test_equals_rauch_tung_striebel(lag: int, order: int) -> None:
    smoother = FixedLagSmoother(SmootherConfig(DT, 80.0, lag, order))
    y = sine(10.0, 60)[0] + 5e-3 * np.random.default_rng(0).standard_normal(60)
    oracle = KalmanFilter(order, 1)
    oracle.F, oracle.Q, oracle.R = smoother.transition.copy(), smoother.process_noise.copy(), np.eye(1)
    oracle.H, oracle.P = np.eye(order)[:1], smoother.prior.copy()
    oracle.x = np.zeros((order, 1))
    oracle.x[0] = y[0]
    means, covariances = [], []
    for k, value in enumerate(y):
        if k:
            oracle.predict()
        oracle.update(value)
        means.append(oracle.x.copy())
        covariances.append(oracle.P.copy())
    expected = oracle.rts_smoother(np.array(means), np.array(covariances))[0][-1 - lag, :3, 0]
    got = smoother.run(y)[-1] / smoother.scale
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10)


def test_follows_motion_better_than_the_raw_reading() -> None:
    y, truth = sine(10.0)
    noisy = y + 5e-3 * np.random.default_rng(1).standard_normal(y.size)
    smoother = FixedLagSmoother(SmootherConfig(DT, 80.0, 16))
    error = smoother.run(noisy)[300:] - truth[300 - 16 : -16]
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert rms[0] < 0.0025
    assert rms[1] < 2.0


def test_response_is_the_two_sided_butterworth_of_its_order() -> None:
    for hz in (20.0, 60.0, 100.0):
        y, _ = sine(hz)
        got = smooth_recording(y, SmootherConfig(DT, 60.0, 60))[500:-500, 0] - 40
        gain = np.sqrt(2 * np.mean(got**2)) / 30
        # The formula is of continuous time; sampling bends it a little near the cut-off.
        assert gain == pytest.approx(1 / (1 + (hz / 60.0) ** 8), abs=0.03)


def test_recording_is_aligned_and_has_no_end_effects_on_a_ramp() -> None:
    y = np.linspace(0.0, 10.0, 400)
    got = smooth_recording(y, SmootherConfig.for_rate(DT))
    np.testing.assert_allclose(got[:, 0], y, atol=1e-6)
    np.testing.assert_allclose(got[5:-5, 1], 10.0 / 399 / DT, rtol=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.floats(-100, 100), st.floats(0.1, 10))
def test_linear(offset: float, factor: float) -> None:
    smoother = FixedLagSmoother(SmootherConfig.for_rate(DT))
    y = sine(9.0, 120)[0]
    expected = smoother.run(y) * factor + np.array([offset, 0, 0])
    np.testing.assert_allclose(
        smoother.run(y * factor + offset) / smoother.scale, expected / smoother.scale, rtol=0, atol=1e-9
    )


def test_zero_phase_lowpass_and_backward_difference() -> None:
    y, _ = sine(5.0)
    np.testing.assert_allclose(zero_phase_lowpass(y, DT)[200:-200], y[200:-200], atol=0.02)
    low = zero_phase_lowpass(sine(200.0)[0], DT)[200:-200]
    assert np.ptp(low) < 1.0
    np.testing.assert_array_equal(zero_phase_lowpass(y, 0.02), y)
    v = backward_difference(np.array([0.0, 1.0, 3.0]), 0.5)
    np.testing.assert_array_equal(v, [2.0, 2.0, 4.0])


@pytest.mark.parametrize(
    "bad",
    [{"dt_s": 0.0}, {"dt_s": DT, "cutoff_hz": 600.0}, {"dt_s": DT, "lag": -1}, {"dt_s": DT, "order": 2}],
)
def test_bad_configuration_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=list(bad)[-1]):
        SmootherConfig(**bad)  # type: ignore[arg-type]


def test_bad_samples_are_named() -> None:
    with pytest.raises(InputError, match="y_um"):
        smooth_recording(np.array([0.0, np.nan, 1.0]), SmootherConfig.for_rate(DT))
