"""Noise weights: doubtful and old samples count less, in the filter and in the window, and only where asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adaptive.errors import InputError
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.drift import DriftConfig, DriftFilter
from adaptive.online.kernel_window import ResidualWindow, WeightConfig
from adaptive.online.learner import Learner
from adaptive.types import Sample
from sim.signals.voltages import training_input
from sim.stage.presets import preset
from sim.stage.stage import Stage

DT = 1e-3
Recording = tuple[np.ndarray, np.ndarray]


def test_all_count_alike_unless_asked() -> None:
    w = WeightConfig()
    assert w.of(True, True, 5.0) == 1.0
    assert w.faded(1.0, 1e6) == 1.0


def test_what_is_doubtful_counts_less() -> None:
    w = WeightConfig(near_bad=0.1, on_probation=0.5, acceleration=2.0, half_life_s=10.0)
    assert w.of(False, False, 0.0) == 1.0
    assert w.of(True, False, 0.0) == pytest.approx(0.1)
    assert w.of(True, True, 0.5) == pytest.approx(0.1 * 0.5 / 2.0)
    assert w.faded(0.5, 20.0) == pytest.approx(0.125)
    assert w.faded(1.0, 1e9) == pytest.approx(1e-3)


@pytest.mark.parametrize(
    "bad",
    [{"near_bad": 0.0}, {"on_probation": 1.5}, {"acceleration": -1.0}, {"half_life_s": float("nan")},
     {"before_change": 0.0}],
)  # fmt: skip
def test_bad_configuration_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        WeightConfig(**bad)


@pytest.mark.parametrize("moving", [True, False])
def test_the_filter_heeds_them(moving: bool) -> None:
    moves = []
    for weight in (1.0, 0.01):
        kf = DriftFilter(DriftConfig(), np.zeros(7), 1e-4 * np.eye(7), 2e-3, 8.0)
        kf.update(np.ones(7), 0.05, moving, weight)
        moves.append(float(kf.beta[0]))
    assert 0.0 < moves[1] < 0.5 * moves[0]


def run(model: LssvmInverse, recording: Recording, weights: WeightConfig) -> Learner:
    u, y = recording[0], recording[1].copy()
    y[1500:1503] += 5.0
    learner = Learner.from_model(model, LearnerConfig(weights=weights))
    for k in range(2500):
        learner.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
    return learner


def test_the_window_holds_them_and_the_state_keeps_them(model: LssvmInverse, recording: Recording) -> None:
    weights = WeightConfig(near_bad=0.2, half_life_s=1.0)
    learner = run(model, recording, weights)
    held = learner.window_data().weights
    assert held.min() < 0.5
    np.testing.assert_array_equal(run(model, recording, WeightConfig()).window_data().weights, 1.0)
    again = Learner.from_state(learner.state_dict())
    assert again.config.weights == weights
    for k in range(2500, 2700):
        sample = Sample(k, k * DT, float(recording[0][k]), float(recording[1][k]))
        assert again.handle(sample) == learner.handle(sample)
    np.testing.assert_array_equal(again.window_data().weights, learner.window_data().weights)
    np.testing.assert_array_equal(again.snapshot().alpha, learner.snapshot().alpha)


def test_fading_starts_from_the_weight_that_a_sample_came_with(model: LssvmInverse) -> None:
    """A doubtful sample stays doubtful as it ages, through new hyper-parameters and through a state file."""
    weights, step_s = WeightConfig(half_life_s=1.0), 0.1
    window = ResidualWindow(10, model)
    d = model.features.kernel_size
    for k in range(10):
        window.learn(np.full(d, 50.0 * k), 0.01 * k, 0.2 if k == 3 else 1.0)
    again = ResidualWindow(10, model)
    again.restore(window.state_dict())
    for held in (window, window.with_hyperparameters(window.hyper), again):
        before = held.data()
        # One slot a call, that of the clock: a new sample comes between two calls, always in the same place.
        for _ in range(12):
            held.learn(np.full(d, 0.0), 0.0)
            held.fade(weights, step_s)
        after = held.data()
        place = int(np.flatnonzero(before.weights == 0.2)[0])
        np.testing.assert_array_equal(after.kernel[place], before.kernel[place])
        # It was looked at once, at some age between the two; never as an ordinary sample of that age.
        most, least = (0.2 * 0.5 ** (step_s * age[place]) for age in (before.age, after.age))
        assert least <= after.weights[place] < most
        others = [i for i in range(1, 10) if i != place]
        assert np.all(after.weights[others] > 2.0 * after.weights[place])


def filled(model: LssvmInverse, n: int = 10) -> ResidualWindow:
    """A window of samples too far apart to be each other's neighbours."""
    window = ResidualWindow(n, model)
    for k in range(n):
        window.learn(np.full(model.features.kernel_size, 50.0 * k), 0.01 * k, 0.02 if k == 3 else 1.0)
    return window


def test_what_is_from_before_a_change_is_let_go_one_a_step(model: LssvmInverse) -> None:
    window = filled(model)
    window.let_go(0.05)
    np.testing.assert_array_equal(window.data().weights, [1.0] * 3 + [0.02] + [1.0] * 6)
    window.expect_change()
    window.learn(np.full(model.features.kernel_size, 50.0 * 6), 1.0)
    window.let_go(0.05)
    assert np.count_nonzero(window.data().weights == 0.05) == 1
    again = ResidualWindow(10, model)
    again.restore(window.state_dict())
    other = window.with_hyperparameters(window.hyper)
    for held in (window, again, other):
        for _ in range(20):
            held.let_go(0.05)
        # The one that counted less already, and the one that has come since, are as they were.
        np.testing.assert_array_equal(held.data().weights, [0.05] * 3 + [0.02] + [0.05] * 2 + [1.0] + [0.05] * 3)


def test_where_nothing_has_changed_nothing_more_is_let_go(model: LssvmInverse) -> None:
    window = filled(model)
    window.expect_change()
    window.let_go(0.05)
    window.keep()
    for _ in range(20):
        window.let_go(0.05)
    assert np.count_nonzero(window.data().weights == 0.05) == 1


@pytest.mark.parametrize("before_change", [0.05, 1.0])
def test_a_change_that_is_found_lets_go_of_the_window(model: LssvmInverse, before_change: float) -> None:
    """A gain that drops by 6 %: within two seconds all that is left from before counts a twentieth."""
    at, n = 2000, 4500
    config = replace(preset("rich", seed=3), changes=((at * DT, {"gain_drift.gain": -0.06}),))
    u = training_input(DT, 10.0)[1][:n]
    stage = Stage(config)
    y, _ = stage.run(stage.initial_state(), u)
    learner = Learner.from_model(model, LearnerConfig(weights=WeightConfig(before_change=before_change)))
    for k in range(n):
        if k == at:
            held = learner.window_data()
            np.testing.assert_array_equal(held.weights, 1.0)
        learner.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
    held = learner.window_data()
    old = held.age > (n - at) / LearnerConfig().learn_every
    assert old.any()
    np.testing.assert_array_equal(held.weights[old], before_change)
    np.testing.assert_array_equal(held.weights[held.age < 100], 1.0)
