"""Runs on random stages that once ended in large errors or false troubles; each shows a rule at work."""

from __future__ import annotations

import pytest

from benchmarks.foreign import LARGE_S, NAMED_S, run_one
from dehyst.lab.rehearsal import Event, RehearsalConfig, identify
from dehyst.lab.rehearsal.rehearsal import _Course
from tests.foreign.plants import random_plant


@pytest.mark.parametrize(
    ("event", "seed", "preset"),
    [
        # The stage stands still, or goes on, while the voltage turns back by a tenth of the drive.
        ("number_stray", 40_000_162, "as_drawn"),
        # The zero jumps by no more than the model's doubt, and the stage rings by twice as much.
        ("zero_at_once", 15_000_094, "random"),
        # The identified model is wrong from the first motion on: what was never right judges no sensor.
        ("none", 70_000_170, "as_drawn"),
        ("lag_fast", 70_000_121, "random"),
        # The zero drifts by 8 % of the range in 0.2 s beside a slow motion, which looks like another gain.
        ("zero_fast", 70_000_415, "random"),
    ],
)
def test_no_large_error_and_no_trouble_with_an_intact_stage(event: str, seed: int, preset: str) -> None:
    record = run_one(event, seed, after_s=4.0, as_drawn=preset == "as_drawn")
    assert "failed" not in record
    assert record["troubles"] == []
    assert record["adaptive"]["large_s"] <= LARGE_S


def test_a_right_model_that_lies_at_its_bound_on_one_branch_is_served() -> None:
    """A Duhem stage that never rests: ``model_bad`` from 0.4 s on, while a model was looked at going up only."""
    factory = random_plant(90_000_004, as_drawn=True)
    low_V, high_V = factory.traits.excite_V
    config = RehearsalConfig(excite_low_V=low_V, excite_high_V=high_V, block=20, snapshot_every=20)
    nothing = Event("none", "none", 4.0)
    course = _Course.prepared(factory, identify(factory, config), config, nothing, 5.0, 90_000_004)
    assert course.run_adaptive(course.new_plant())[0].troubles == ("",)


@pytest.mark.parametrize(
    ("event", "seed"),
    [
        # What was learnt from the fault is taken back, and the place is reckoned again without it.
        ("stuck_noise", 70_000_196),
        # The readings are out of range: the place goes on without them.
        ("sensor_gain", 70_000_407),
        # The readings of another stage seem to confirm a jump that was taken back.
        ("foreign", 60_600_239),
        # They move like this stage's for one window, two seconds after they were named.
        ("foreign", 80_000_339),
        # Nothing that a reading shows that may stand still is learnt.
        ("stuck_noise", 80_000_096),
    ],
)
def test_a_sensor_fault_is_named_and_costs_no_more_than_the_frozen_model(event: str, seed: int) -> None:
    record = run_one(event, seed, after_s=4.0)
    assert "failed" not in record
    assert record["sensor_excess"] <= 1.0
    assert record["named_s"] <= NAMED_S
