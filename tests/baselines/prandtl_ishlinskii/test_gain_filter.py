"""Gain and offset of a frame: the Kalman filter of two random walks, and nothing taken that is not finite."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from baselines.prandtl_ishlinskii.online import GainFilter


def test_it_is_the_kalman_filter_of_two_random_walks() -> None:
    rng = np.random.default_rng(5)
    made = GainFilter.start(0.02, 0.5, 0.01)
    x, P, Q = np.array([1.0, 0.0]), made.covariance.copy(), np.diag(made.walk)
    for k in range(300):
        model = 30.0 + 25.0 * np.sin(0.1 * k)
        y = 0.94 * model + 0.7 + 0.05 * rng.standard_normal()
        made.update(y, model, 0.01)
        # Textbook form, with the information of the sample added to that of the state.
        P = P + Q
        h = np.array([model, 1.0])
        P = np.linalg.inv(np.linalg.inv(P) + np.outer(h, h) / 0.01)
        x = x + P @ h / 0.01 * (y - float(h @ x))
        np.testing.assert_allclose([made.gain, made.offset_um], x, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(made.covariance, P, rtol=1e-6)
    assert made.gain == pytest.approx(0.94, abs=0.01)
    assert made.to_model(0.94 * 40.0 + 0.7) == pytest.approx(40.0, abs=0.3)


def test_it_is_the_librarys_filter_step_by_step() -> None:
    rng = np.random.default_rng(6)
    made = GainFilter.start(0.02, 0.5, 0.01)
    library = KalmanFilter(dim_x=2, dim_z=1)
    library.x, library.P, library.Q = np.array([[1.0], [0.0]]), made.covariance.copy(), np.diag(made.walk)
    for _ in range(500):
        model = float(rng.uniform(0.0, 60.0))
        y = 1.1 * model - 0.4 + 0.05 * float(rng.standard_normal())
        made.update(y, model, 0.01)
        library.predict()
        library.update(np.array([[y]]), R=0.01, H=np.array([[model, 1.0]]))
        np.testing.assert_allclose([made.gain, made.offset_um], library.x[:, 0], rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(made.covariance, library.P, rtol=1e-8, atol=1e-15)


@pytest.mark.parametrize("pair", [(np.nan, 1.0), (1.0, np.inf), (np.inf, 1.0)])
def test_what_would_not_stay_finite_changes_nothing(pair: tuple[float, float]) -> None:
    made = GainFilter.start(0.02, 0.5, 0.01)
    made.update(9.0, 10.0, 0.01)
    before = made.state_dict()
    made.update(*pair, 0.01)
    after = made.state_dict()
    assert (after["gain"], after["offset_um"]) == (before["gain"], before["offset_um"])
    np.testing.assert_array_equal(after["covariance"], before["covariance"])


def test_a_restored_one_goes_on_to_the_last_bit() -> None:
    made, again = GainFilter.start(0.02, 0.5, 0.01), GainFilter.start(0.02, 0.5, 0.01)
    for k in range(20):
        made.update(9.0 + k, 10.0 + k, 0.01)
    again.restore(made.state_dict())
    for one in (made, again):
        one.update(31.0, 30.0, 0.01)
    assert (made.gain, made.offset_um) == (again.gain, again.offset_um)
