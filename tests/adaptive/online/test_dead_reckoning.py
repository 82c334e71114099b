"""Dead reckoning knows where the stage is from the voltage alone, and cannot run off, whatever the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.track import (
    LOST_SHARE,
    OFF_LINE,
    SLOPES,
    Reckoning,
    answers,
    mean_slope,
)
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import FloatArray, Sample
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT = 1e-3
REST = (40.0, 0.0, 0.0)


def voltage(seconds: float) -> FloatArray:
    t = np.arange(round(seconds / DT)) * DT
    return np.minimum(t / 0.5, 1.0) * (4.0 + 1.2 * np.sin(2 * np.pi * 7.0 * t) + 0.8 * np.sin(2 * np.pi * 2.3 * t))


def begun(learner: Learner) -> Reckoning:
    track = learner.parts.intake.track
    assert track is not None
    motion, u_before_V, u_V, y_um = track.since_motion()
    return Reckoning.begin(learner.snapshot(), motion, u_before_V, u_V, y_um, track.memory)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_place_is_known_round_turning_points_and_for_a_second(model: LssvmInverse, sign: float) -> None:
    """After 20 samples within 0.05 µm in the mean, where a straight line is off by micrometres; after 1000, 0.3 µm."""
    u = voltage(4.5)
    stage = Stage(preset("rich", seed=4))
    y, _ = stage.run(stage.initial_state(), u)
    # A stage that voltage draws back is the same one, its voltages negated.
    features = replace(model.features)
    model = replace(model, features=features, beta=sign * model.beta, alpha=sign * model.alpha)
    learner = Learner.from_model(model)
    errors: dict[int, list[float]] = {20: [], 1000: []}
    straight = []
    for k in range(3400):
        if k > 1500 and k % 37 == 0:
            reckoning = begun(learner)
            for i in range(1000):
                place = reckoning.advance(sign * float(u[k + i]))
                if i + 1 in errors:
                    errors[i + 1].append(abs(place - y[k + i]))
            assert not reckoning.lost
            straight.append(abs(y[k - 1] + 20 * (y[k - 1] - y[k - 6]) / 5 - y[k + 19]))
        learner.handle(Sample(k, k * DT, sign * float(u[k]), float(y[k])))
    assert np.mean(errors[20]) < 0.05
    assert np.mean(errors[20]) < 0.03 * np.mean(straight)
    assert np.mean(errors[1000]) < 0.3


def gone_wrong(model: LssvmInverse, seed: int) -> LssvmInverse:
    """A model with coefficients drawn at random, of sizes from a tenth to a thousand times the identified."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-1.0, 3.0)
    beta = size * np.abs(model.beta) * rng.standard_normal(model.beta.size)
    return replace(model, beta=beta, alpha=size * rng.standard_normal(model.alpha.size) * np.abs(model.alpha))


@given(seed=st.integers(0, 10_000), steps=st.lists(st.floats(-2.0, 2.0), min_size=5, max_size=60))
def test_no_model_makes_it_run_off(model: LssvmInverse, seed: int, steps: list[float]) -> None:
    """The bound of the proof: between what the least and the largest slope make of the voltage, and near the line."""
    wrong = gone_wrong(model, seed)
    u = np.clip(4.0 + np.cumsum(steps), 0.0, 10.0)
    reckoning = Reckoning.begin(wrong, REST, 4.0, np.empty(0), np.empty(0), model.rest_memory(40.0))
    slope = mean_slope(wrong)
    before, way_V, last = 4.0, 0.0, 0.0
    for u_V in u:
        held = reckoning.y_um
        place = reckoning.advance(float(u_V))
        # In one sample: by the largest slope, by the motion under way.
        caused = np.sign(slope) * (u_V - before) / (SLOPES[0] * abs(slope))
        assert min(caused, 0.0) + min(last, 0.0) - 1e-9 <= place - held <= max(caused, 0.0) + max(last, 0.0) + 1e-9
        last = place - held
        way_V += abs(u_V - before)
        before = u_V
        assert abs(place - REST[0]) <= way_V / (SLOPES[0] * abs(slope)) + 1e-3 * reckoning.range_um + 1e-9
        assert abs(place - (REST[0] + (u_V - 4.0) / slope)) <= OFF_LINE * reckoning.range_um + 1e-9
    assert np.isfinite(reckoning.memory).all()


def test_it_says_when_it_is_lost(model: LssvmInverse) -> None:
    """A model that asks for the same voltage everywhere knows no place: what the band cuts off is uncertainty."""
    flat = replace(model, beta=0.0 * model.beta, alpha=0.0 * model.alpha)
    assert not answers(flat)
    assert answers(model)
    reckoning = Reckoning.begin(flat, REST, 4.0, np.empty(0), np.empty(0), model.rest_memory(40.0))
    for u_V in np.linspace(4.0, 6.0, 50):
        reckoning.advance(float(u_V))
    assert reckoning.lost
    assert reckoning.std_um > LOST_SHARE * reckoning.range_um


def test_uncertainty_grows_with_the_way_and_not_at_rest(model: LssvmInverse) -> None:
    reckoning = Reckoning.begin(model, REST, 4.0, np.empty(0), np.empty(0), model.rest_memory(40.0))
    there = model.evaluate_point(40.0, 0.0, 0.0, model.rest_memory(40.0))[0]
    seen = []
    for u_V in there + 0.5 * np.sin(np.arange(2000) * 0.02):
        reckoning.advance(float(u_V))
        seen.append(reckoning.std_um)
    assert np.all(np.diff(seen) >= 0.0)
    moved = reckoning.std_um
    for _ in range(500):
        reckoning.advance(float(u_V))
    assert reckoning.std_um - moved < 0.01


def test_state_goes_on_to_the_last_bit(model: LssvmInverse) -> None:
    one = Reckoning.begin(model, REST, 4.0, np.full(3, 4.0), np.full(2, 40.1), model.rest_memory(40.0))
    one.advance(4.1)
    two = load(Reckoning, save(one))
    assert [one.advance(u) for u in (4.2, 4.4, 4.3)] == [two.advance(u) for u in (4.2, 4.4, 4.3)]
    np.testing.assert_array_equal(one.memory, two.memory)
