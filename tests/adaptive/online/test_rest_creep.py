"""Rests: what the constant takes up while a stage creeps goes over to the frame, slowly, and no further than that."""

from __future__ import annotations

from dataclasses import replace
from math import isnan

import numpy as np
import pytest

from adaptive.errors import ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.drift import RestCreep
from adaptive.online.learner import Learner
from adaptive.types import Sample
from sim.stage.presets import preset
from sim.stage.stage import Stage

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
    again = RestCreep.from_state(rest.state_dict())
    one, other = ([r.shift_um(1.002, 5.0, 8.0, 80.0, STEP_S, 0.1) for _ in range(20)] for r in (rest, again))
    assert one == other
    assert sum(one) < 0.0
    assert isnan(RestCreep.from_state({}).constant_V), "a state from before there was any"
    with pytest.raises(ModelFileError, match="rest"):
        RestCreep.from_state({"constant_V": 1.0, "steps": 3})


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
