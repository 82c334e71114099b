"""Runs on random stages that once ended in large errors or false troubles; each shows a rule at work."""

from __future__ import annotations

import pytest

from benchmarks.foreign import LARGE_S, run_one


@pytest.mark.parametrize(
    ("event", "seed"),
    [
        # The stage stands still, or goes on, while the voltage turns back by a tenth of the drive.
        ("number_stray", 40_000_162),
        # The gain falls while the stage is nearly at rest: its zero drifts faster than the voltage moves it.
        ("gain_fast", 15_000_092),
        # The zero jumps by no more than the model's doubt, and the stage rings by twice as much.
        ("zero_at_once", 15_000_094),
    ],
)
def test_no_large_error_and_no_trouble_with_an_intact_stage(event: str, seed: int) -> None:
    record = run_one(event, seed, after_s=4.0)
    assert "failed" not in record
    assert record["troubles"] == []
    assert record["adaptive"]["large_s"] <= LARGE_S
