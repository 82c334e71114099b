"""Runs on random stages that once ended in large errors or false troubles; each shows a rule at work."""

from __future__ import annotations

import pytest

from benchmarks.foreign import LARGE_S, NAMED_S, run_one


@pytest.mark.parametrize(
    ("event", "seed"),
    [
        # The stage stands still, or goes on, while the voltage turns back by a tenth of the drive.
        ("number_stray", 40_000_162),
        # The gain falls while the stage is nearly at rest: its zero drifts faster than the voltage moves it.
        ("gain_fast", 15_000_092),
        # The zero jumps by no more than the model's doubt, and the stage rings by twice as much.
        ("zero_at_once", 15_000_094),
        # The identified model is wrong from the first motion on: what was never right judges no sensor.
        ("none", 70_000_170),
        ("lag_fast", 70_000_121),
        # The zero drifts by 8 % of the range in 0.2 s beside a slow motion, which looks like another gain.
        ("zero_fast", 70_000_415),
        ("zero_fast", 70_000_445),
    ],
)
def test_no_large_error_and_no_trouble_with_an_intact_stage(event: str, seed: int) -> None:
    record = run_one(event, seed, after_s=4.0)
    assert "failed" not in record
    assert record["troubles"] == []
    assert record["adaptive"]["large_s"] <= LARGE_S


@pytest.mark.parametrize(
    ("event", "seed"),
    [
        # What was learnt from the fault is taken back, and the place is reckoned again without it.
        ("stuck_noise", 70_000_196),
        # The readings are out of range: the place goes on without them.
        ("sensor_gain", 70_000_407),
        # The readings of another stage seem to confirm a jump that was taken back.
        ("foreign", 60_600_239),
    ],
)
def test_a_sensor_fault_is_named_and_costs_no_more_than_the_frozen_model(event: str, seed: int) -> None:
    record = run_one(event, seed, after_s=4.0)
    assert "failed" not in record
    assert record["sensor_excess"] <= 1.0
    assert record["named_s"] <= NAMED_S
