"""The drift filter finds a gain, an offset and a lag fast, and does not wind up at rest."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from adaptive.errors import InputError
from adaptive.online import drift
from adaptive.online.config import LearnerConfig
from adaptive.online.drift import DriftConfig, DriftFilter

P, STEP = 10, 2e-3
TRUE = np.array([3.5, 3.5, 0.1, 0.03, 0.05, 0.0, 0.2, 0.1, 0.05, 0.02])


def made(config: DriftConfig | None = None) -> DriftFilter:
    return DriftFilter(config or DriftConfig(), TRUE, 1e-6 * np.eye(P), STEP, 8.0)


def rows(n: int, seed: int = 0) -> np.ndarray:
    """Smooth inputs, as motion gives them."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * STEP
    columns = [np.sin(2 * np.pi * f * t + p) for f, p in zip(rng.uniform(0.5, 8, P), rng.uniform(0, 6, P), strict=True)]
    basis = np.array(columns).T
    basis[:, 0] = 1.0
    return basis


def feed(f: DriftFilter, basis: np.ndarray, truth: np.ndarray, noise: float = 1e-4, moving: bool = True) -> np.ndarray:
    rng = np.random.default_rng(9)
    errors = []
    for row in basis:
        errors.append(float(row @ (truth - f.beta)))
        f.update(row, float(row @ truth) + noise * rng.standard_normal(), moving)
    return np.array(errors)


@pytest.mark.parametrize("change", ["gain", "offset", "lag"])
def test_finds_a_change_within_a_tenth_of_a_second(change: str) -> None:
    f = made()
    feed(f, rows(500), TRUE)
    truth = TRUE.copy()
    if change == "gain":
        truth = truth * 1.06
    elif change == "offset":
        truth[0] += 0.2
    else:
        truth[2] += 0.05
    errors = np.abs(feed(f, rows(500, 3), truth))
    before = np.abs(rows(500, 3) @ (truth - TRUE)).mean()
    assert errors[50:].mean() < 0.06 * before
    assert errors[250:].mean() < 0.02 * before


def test_a_sudden_change_is_detected_once_and_noise_is_not() -> None:
    f = made()
    feed(f, rows(1500), TRUE)
    assert f.state.bursts == 0
    feed(f, rows(300, 3), 1.05 * TRUE)
    assert f.state.bursts == 1


def test_a_lone_outlier_is_refused_and_a_persistent_one_believed() -> None:
    f = made()
    basis = rows(20)
    feed(f, rows(300), TRUE)
    before = f.beta
    assert f.update(basis[0], float(basis[0] @ TRUE) + 2.0, True) == "outlier"
    np.testing.assert_array_equal(f.beta, before)
    assert f.update(basis[1], float(basis[1] @ TRUE), True) == "updated"
    got = [f.update(row, float(row @ TRUE) + 2.0, True) for row in basis[2:12]]
    assert got[: f.config.gate_persistence] == ["outlier"] * f.config.gate_persistence
    assert "outlier" not in got[f.config.gate_persistence :][:1]


def test_rest_opens_nothing_but_the_constant() -> None:
    f = made()
    feed(f, rows(500), TRUE)
    before = np.diag(f.covariance)
    still = np.tile(rows(1), (20_000, 1))
    feed(f, still, TRUE, moving=False)
    after = np.diag(f.covariance)
    assert np.all(after[1:] <= before[1:] * (1 + 1e-9))
    np.testing.assert_allclose(f.beta, TRUE, atol=5e-3)


def test_state_round_trip_goes_on_to_the_last_bit() -> None:
    one = made()
    feed(one, rows(100), 1.02 * TRUE)
    two = DriftFilter.from_state(one.config, STEP, 8.0, one.state_dict())
    for f in (one, two):
        feed(f, rows(50, 5), 1.02 * TRUE)
    np.testing.assert_array_equal(one.beta, two.beta)
    np.testing.assert_array_equal(one.covariance, two.covariance)
    assert one.state == two.state


def test_bad_configuration_is_named() -> None:
    with pytest.raises(InputError, match="noise"):
        DriftConfig(noise=0.0)
    with pytest.raises(InputError, match="gain_walk"):
        DriftConfig(gain_walk=-1.0)
    with pytest.raises(InputError, match="covariance"):
        DriftFilter(DriftConfig(), TRUE, np.eye(3), STEP, 8.0)


def by_filterpy(
    x: np.ndarray, P: np.ndarray, h: np.ndarray, z: float, noise: float, k: np.ndarray, row: np.ndarray
) -> None:
    """`joseph` by filterpy."""
    reference = KalmanFilter(dim_x=x.size, dim_z=1)
    reference.x, reference.P = x[:, None].copy(), P.copy()
    reference.update(np.array([[z]]), R=noise, H=h[None, :])
    x[:] = reference.x[:, 0]
    P[:] = 0.5 * (reference.P + reference.P.T)


def test_the_compiled_filter_agrees_with_filterpy_through_changes_and_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    reference, compiled = made(), made()
    outcomes = set()
    for k, row in enumerate(rows(900)):
        truth = TRUE * (0.94 if k > 300 else 1.0)
        target = float(row @ truth) + 1e-4 * np.sin(37.0 * k)
        moving, weight = not 600 <= k < 700, 1.0 if k % 5 else 0.3
        with monkeypatch.context() as patched:
            patched.setattr(
                drift, "take_in", lambda x, P, h, e, v, noise, k, row, z=target: by_filterpy(x, P, h, z, noise, k, row)
            )
            outcome = reference.update(row, target, moving, weight)
        assert compiled.update(row, target, moving, weight) == outcome
        outcomes.add(outcome)
    assert {"burst", "updated"} <= outcomes
    np.testing.assert_allclose(reference.beta, compiled.beta, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(reference.covariance, compiled.covariance, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("table", "key"), [("solver", "backend"), ("drift", "algebra")])
def test_a_state_from_before_a_setting_was_removed_is_read(table: str, key: str) -> None:
    state = LearnerConfig().state_dict()
    assert state[f"{table}.{key}"] == "compiled"
    assert LearnerConfig.from_state(state) == LearnerConfig()
