"""The operators and models of Prandtl and Ishlinskii, and the filter of gain and offset."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import save
from dehyst.baselines.common import Domain
from dehyst.baselines.prandtl_ishlinskii import operators
from dehyst.baselines.prandtl_ishlinskii.model import (
    MpiInverse,
    MpiParameters,
    inverse_thresholds,
    inverse_weights,
)
from dehyst.baselines.prandtl_ishlinskii.online import GainFilter
from dehyst.baselines.prandtl_ishlinskii.operators import (
    dead_zone,
    dead_zone_sum,
    play_run,
    ramps,
    slopes_to_weights,
)

# --- Play and dead-zone operators, PI and MPI models and their inverses: exactness.

WIDE = Domain(-1e6, 1e6, 1e9)
seeds = st.integers(0, 2**32 - 1)


def test_documented_walks() -> None:
    result = doctest.testmod(operators)
    assert result.attempted >= 8
    assert result.failed == 0


def random_mpi(rng: np.random.Generator, n: int, m: int) -> MpiParameters:
    """Random weights of either sign with positive partial sums, random offsets."""
    r = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 1.0, n))])
    d = np.concatenate([[0.0], np.cumsum(rng.uniform(1.0, 15.0, m))])
    w_h = np.diff(rng.uniform(2.0, 20.0, n + 1), prepend=0.0)
    w_s = np.diff(rng.uniform(0.3, 3.0, m + 1), prepend=0.0)
    c, y_ref = rng.normal(0.0, 10.0, 2)
    return MpiParameters(tuple(r), tuple(w_h), tuple(d), tuple(w_s), float(c), float(y_ref))


def test_pi_follows_the_equations_step_by_step() -> None:
    rng = np.random.default_rng(3)
    u, r, w = rng.uniform(0, 8, 50), np.array([0.0, 0.5, 2.0]), np.array([5.0, 3.0, 1.0])
    state = [0.0, 0.0, 0.0]
    expected = []
    for value in u:  # (2.4), (2.7) in their own words
        state = [max(value - r[i], min(value + r[i], state[i])) for i in range(3)]
        expected.append(sum(w[i] * state[i] for i in range(3)))
    np.testing.assert_allclose(MpiParameters(tuple(r), tuple(w)).simulate(u, 1.0), expected, rtol=1e-14)


def test_dead_zones_against_the_definition() -> None:
    y = np.linspace(-5.0, 20.0, 101)
    d, w = np.array([0.0, 3.0, 7.0]), np.array([1.0, -0.5, 2.0])
    expected = y - 0.5 * np.maximum(y - 3.0, 0.0) + 2.0 * np.maximum(y - 7.0, 0.0)
    np.testing.assert_allclose(dead_zone(y, d) @ w, expected, atol=1e-13)
    np.testing.assert_allclose([dead_zone_sum(v, d, w) for v in y], expected, atol=1e-13)
    slopes = np.cumsum(w)
    np.testing.assert_allclose(ramps(y, d) @ slopes, expected, atol=1e-13)
    np.testing.assert_allclose(slopes_to_weights(slopes), w)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(0, 14), m=st.integers(0, 8))
def test_inverse_of_forward_is_the_identity(seed: int, n: int, m: int) -> None:
    """Random walks with minor loops, random weights, random initial states reached by a random past."""
    rng = np.random.default_rng(seed)
    model = random_mpi(rng, n, m)
    past = rng.uniform(-9.0, 9.0, 7)
    state = model.start(float(past[0]))
    play_run(past, model.r_, state)
    turns = rng.uniform(-9.0, 9.0, 30)
    u = np.interp(np.linspace(0, 29, 400), np.arange(30), turns)
    y = model.simulate(u, 1e-3, state)
    inverse = MpiInverse(model, 1e-3, WIDE)
    zero = np.zeros(u.size)
    answer = inverse.feedforward(y, zero, zero, state)
    scale = float(np.sum(np.abs(model.w_h_)) / np.min(np.cumsum(model.w_h_)))
    assert np.max(np.abs(answer.u_V - u)) < 1e-12 * scale
    # The memory after is that of the forward model, and what track makes of the voltages.
    after = state.copy()
    play_run(u, model.r_, after)
    np.testing.assert_allclose(answer.memory, after, atol=1e-11 * scale)
    np.testing.assert_allclose(inverse.track(y, zero, zero, u, state), after, atol=0)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(0, 14), m=st.integers(0, 8))
def test_inverting_twice_gives_the_model_back(seed: int, n: int, m: int) -> None:
    model = random_mpi(np.random.default_rng(seed), n, m)
    for w, r in ((model.w_h_, model.r_), (model.w_s_, model.d_)):
        twice_w, twice_r = (
            inverse_weights(inverse_weights(w)),
            inverse_thresholds(inverse_weights(w), inverse_thresholds(w, r)),
        )
        np.testing.assert_allclose(twice_w, w, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(twice_r, r, rtol=1e-9, atol=1e-9)


def test_tables_2_2_and_2_3_agree() -> None:
    """The chapter's own numbers: (2.12)-(2.18) take Table 2.2 to Table 2.3."""
    r = 0.6036 * np.arange(13)
    w_h = np.array([0.0677, 0.0228, 6.5979e-6, 0.0196, 0.0037, 4.0252e-6, 1.0681e-6, 6.7711e-8, 6.1372e-8, 3.8439e-8])
    w_h = np.concatenate([w_h, [2.9690e-8, 8.4374e-9, 0.0]])
    np.testing.assert_allclose(inverse_weights(w_h)[[0, 1, 3, 4]], [14.7797, -3.7195, -1.9672, -0.2980], rtol=1.4e-2)
    expected = [0.0, 0.0408, 0.0954, 0.1500, 0.2164, 0.2850, 0.3537]
    np.testing.assert_allclose(inverse_thresholds(w_h, r)[:7], expected, atol=3e-4)
    w_s, d = np.array([99.9999, -1.0010e-5, -3.3798e-5]), np.array([0.0, 0.1276, 0.2552])
    np.testing.assert_allclose(inverse_weights(w_s), [0.0100, 1.0010e-9, 3.3798e-9], rtol=1e-3)
    np.testing.assert_allclose(inverse_thresholds(w_s, d), [0.0, 12.7581, 25.5163], rtol=2e-4)


def test_wiping_out_and_congruency() -> None:
    model = random_mpi(np.random.default_rng(5), 8, 0)
    walk = np.array([0.0, 6.0, 2.0, 4.0, 2.0, 6.0, 1.0])
    short = np.array([0.0, 6.0, 1.0])
    assert model.simulate(walk, 1.0)[-1] == pytest.approx(model.simulate(short, 1.0)[-1], abs=1e-12)
    first = model.simulate(np.array([0.0, 6.0, 2.0, 4.0, 2.0]), 1.0)
    second = model.simulate(np.array([0.0, 8.0, 2.0, 4.0, 2.0]), 1.0)
    assert first[3] - first[4] == pytest.approx(second[3] - second[4], abs=1e-12)


def test_lag_is_led_by_the_inverse() -> None:
    model = MpiParameters((0.0, 0.4), (8.0, 3.0), y_ref_um=2.0, lag_s=5e-3)
    t = np.arange(4000) * 1e-3
    y, v = 40 - 30 * np.cos(2 * np.pi * t), 60 * np.pi * np.sin(2 * np.pi * t)
    inverse = MpiInverse(model, 1e-3, WIDE)
    u = inverse.feedforward(y, v, 0 * v, inverse.rest_memory(10.0)).u_V
    assert np.max(np.abs(model.simulate(u, 1e-3) - y)) < 2e-3
    without = MpiInverse(MpiParameters((0.0, 0.4), (8.0, 3.0), y_ref_um=2.0), 1e-3, WIDE)
    late = without.feedforward(y, v, 0 * v, without.rest_memory(10.0)).u_V
    assert np.max(np.abs(model.simulate(late, 1e-3) - y)) > 0.5


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"r_V": (0.0, 1.0), "w_h": (1.0,)}, "w_h"),
        ({"r_V": (0.1, 1.0), "w_h": (1.0, 1.0)}, "r_V"),
        ({"r_V": (0.0, 1.0), "w_h": (1.0, -1.5)}, "w_h"),
        ({"r_V": (0.0,), "w_h": (1.0,), "d_um": (0.0, 2.0), "w_s": (1.0, -1.0)}, "w_s"),
        ({"r_V": (0.0,), "w_h": (1.0,), "c_um": float("nan")}, "c_um"),
    ],
)
def test_models_without_an_inverse_are_refused(arguments: dict[str, object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        MpiParameters(**arguments)  # type: ignore[arg-type]


# --- Gain and offset of a frame: the Kalman filter of two random walks, and nothing taken that is not finite.


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
    before = save(made)
    made.update(*pair, 0.01)
    after = save(made)
    assert (after["gain"], after["offset_um"]) == (before["gain"], before["offset_um"])
    np.testing.assert_array_equal(after["covariance"], before["covariance"])
