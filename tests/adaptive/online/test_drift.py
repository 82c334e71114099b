"""The drift of the linear part: the filter, its algebra beside filterpy, and creep at rest."""

from __future__ import annotations

from dataclasses import replace
from math import isnan

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import drift
from dehyst.adaptive.online import drift as drift_step
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import DriftConfig, DriftFilter, RestCreep
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.state import load, restore, save
from dehyst.adaptive.types import Sample
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- The drift filter finds a gain, an offset and a lag fast, and does not wind up at rest.

P, STEP = 10, 2e-3
TRUE = np.array([3.5, 3.5, 0.1, 0.03, 0.05, 0.0, 0.2, 0.1, 0.05, 0.02])


class Updated(DriftFilter):
    """A filter with its update, which is a function that compiled code calls."""

    def update(self, basis: np.ndarray, target_V: float, moving: bool) -> str:
        own = self.config, self.state, self._x, self._P, *self.variances, self.span_V, self.step_s
        return drift.update(*own, basis, target_V, moving, np.empty(basis.size), np.empty(basis.size))


def made(config: DriftConfig | None = None) -> DriftFilter:
    return Updated(config or DriftConfig(), TRUE, 1e-6 * np.eye(P), STEP, 8.0)


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
    assert errors[50:].mean() < 0.07 * before
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
    two = made()
    restore(two, save(one), {"p": TRUE.size})
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
        Updated(DriftConfig(), TRUE, np.eye(3), STEP, 8.0)


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
        moving = not 600 <= k < 700
        with monkeypatch.context() as patched:
            patched.setattr(
                drift, "take_in", lambda x, P, h, e, v, noise, k, row, z=target: by_filterpy(x, P, h, z, noise, k, row)
            )
            outcome = reference.update(row, target, moving)
        assert compiled.update(row, target, moving) == outcome
        outcomes.add(outcome)
    assert {"burst", "updated"} <= outcomes
    np.testing.assert_allclose(reference.beta, compiled.beta, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(reference.covariance, compiled.covariance, rtol=0.0, atol=1e-8)


# --- The compiled algebra of the drift filter is that of filterpy's Kalman filter, step by step and over many of them.

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
    config = DriftConfig(alike_s=0.0, gate_sigma=1e6, burst_ratio=1e9)
    made = Updated(config, truth, 1e-4 * np.eye(p), 1e-3, SPAN_V)
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


# --- Rests: what the constant takes up while a stage creeps goes over to the frame, slowly, and no further than that.

DT = 1e-3
STEP_S = 2e-3


def after(rest: RestCreep, steps: int, gained_V: float, creep_s: float = 0.1) -> float:
    """By how much the frame has moved, µm, after so many steps with a constant that has gained so much."""
    rest.shift_um(1.0, 5.0, 8.0, 80.0, STEP_S, creep_s)
    return sum(rest.shift_um(1.0 + gained_V, 5.0, 8.0, 80.0, STEP_S, creep_s) for _ in range(steps))


def test_a_stage_that_needs_more_voltage_has_crept_back() -> None:
    # 1 mV more at 10 µm/V are 10 nm; every tenth step takes a fifth of what is left to the frame.
    assert after(RestCreep(), 9, 1e-3) == pytest.approx(-0.2 * 0.01)
    assert after(RestCreep(), 19, 1e-3) == pytest.approx(-0.4 * 0.01)


def test_it_moves_no_faster_than_a_stage_creeps() -> None:
    moved_um = after(RestCreep(), 499, 5.0)
    assert moved_um == pytest.approx(-0.02 * 80.0, rel=1e-9), "one second at 2 % of the range"


def test_nothing_moves_where_it_is_switched_off_or_before_anything_was_gained() -> None:
    assert after(RestCreep(), 100, 1e-3, creep_s=0.0) == 0.0
    assert after(RestCreep(), 100, 0.0) == 0.0


def test_a_voltage_that_goes_on_holds_no_stage_in_place() -> None:
    stuck, still = RestCreep(), RestCreep()
    # 8 V in 4 s under a reading that does not change, and a hundredth of that.
    moved = [sum(r.shift_um(1.0 + 0.01 * k, 2.0 + v * k, 8.0, 80.0, STEP_S, 0.1) for k in range(400))
             for r, v in ((stuck, 4e-3), (still, 4e-5))]  # fmt: skip
    assert moved[0] == 0.0
    assert moved[1] < -0.5


def test_a_new_rest_begins_from_the_constant_that_it_finds() -> None:
    rest = RestCreep()
    after(rest, 50, 1e-3)
    rest.leave()
    assert isnan(rest.constant_V)
    assert [rest.shift_um(7.0, 5.0, 8.0, 80.0, STEP_S, 0.1) for _ in range(40)] == [0.0] * 40


def test_its_state_goes_on_and_damage_is_named() -> None:
    rest = RestCreep()
    after(rest, 13, 1e-3)
    again = load(RestCreep, save(rest))
    one, other = ([r.shift_um(1.002, 5.0, 8.0, 80.0, STEP_S, 0.1) for _ in range(20)] for r in (rest, again))
    assert one == other
    assert sum(one) < 0.0
    with pytest.raises(ModelFileError, match="u_V: got nothing"):
        load(RestCreep, {"constant_V": 1.0, "steps": 3})


def rested(model: LssvmInverse, config: LearnerConfig, hold_s: float) -> tuple[float, Learner]:
    """Mean |error|, µm, in the first half second of strokes after a hold, and the learner that steered them."""
    config = replace(config, serving_age_s=0.02)
    stage, learner = Stage(preset("rich", seed=21)), Learner(model, config)
    state, memory = stage.initial_state(), learner.memory()
    n_before, n_hold, n_after = 6000, round(hold_s / DT), 500
    t = np.arange(n_before + n_hold + n_after) * DT
    phase = 2.0 * np.pi * 0.8
    stop = (n_before + n_hold) * DT
    y = 42.0 + 30.0 * np.sin(phase * t)
    level = float(42.0 + 30.0 * np.sin(phase * n_before * DT))
    y[n_before : n_before + n_hold] = level
    late = t[n_before + n_hold :] - stop
    y[n_before + n_hold :] = level + 15.0 * (1.0 - np.cos(2.0 * phase * late)) * (-1.0 if level > 42.0 else 1.0)
    v = np.gradient(y, DT)
    v[n_before - 1 : n_before + 2] = v[n_before + n_hold - 2 : n_before + n_hold + 1] = 0.0
    a = np.zeros_like(y)
    error = np.zeros(y.size)
    for first in range(0, y.size, 20):
        part = slice(first, first + 20)
        answer = learner.snapshot().feedforward(y[part], v[part], a[part], memory)
        memory = answer.memory
        u = np.clip(answer.u_V, -2.0, 10.0)
        read, _ = stage.run(state, u)
        error[part] = read - y[part]
        for k in range(20):
            learner.handle(Sample(first + k, (first + k) * DT, float(u[k]), float(read[k])))
    return float(np.abs(error[n_before + n_hold :]).mean()), learner


def test_after_a_long_hold_the_frame_knows_of_the_creep(model: LssvmInverse) -> None:
    with_um, learner = rested(model, LearnerConfig(), 12.0)
    without_um, other = rested(model, LearnerConfig(creep_s=0.0), 12.0)
    assert other.features.offset_um == 0.0
    assert 0.05 < abs(learner.features.offset_um) < 2.0
    assert with_um < 1.05 * without_um
    state = learner.state_dict()
    again = Learner.from_state(state)
    assert again.features.offset_um == learner.features.offset_um


def test_the_noise_of_a_measurement_follows_from_the_innovations() -> None:
    """A model whose shape is wrong by a tenth of the span refuses few measurements, and is not led astray by them."""
    rng = np.random.default_rng(4)
    basis, wrong_V = rows(4000, 7), np.repeat(0.8 * rng.standard_normal(400), 10)

    def fed(alike_s: float) -> tuple[int, float]:
        f, refused = made(DriftConfig(alike_s=alike_s)), []
        for row, by_V in zip(basis, wrong_V, strict=True):
            refused.append(f.update(row, float(row @ TRUE) + by_V, True) == "outlier")
        return sum(refused[2000:]), float(np.abs(basis @ (f.beta - TRUE)).mean())

    refused, moved_V = fed(DriftConfig().alike_s)
    fixed_refused, fixed_moved_V = fed(0.0)
    assert refused == 0 < 500 < fixed_refused
    assert moved_V < 0.3 * fixed_moved_V
