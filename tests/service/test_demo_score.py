"""What the demonstration says of a run: of one that the machine could not keep up with, that it tells nothing else."""

from __future__ import annotations

import pytest

from service.demo.score import MOST_LATE, clock_missed


@pytest.mark.parametrize("late", [0, 1, round(60_000 * MOST_LATE)])
def test_a_machine_that_keeps_up_is_not_worth_a_word(late: int) -> None:
    assert clock_missed({"count": 60_000, "late": late, "bare_late": 5000}) == ""
    assert clock_missed({"count": 0, "late": 0, "bare_late": 0}) == ""


def test_a_machine_that_does_not_is_told_of_with_what_to_do() -> None:
    told = clock_missed({"count": 60_000, "late": 30_714, "bare_late": 0})
    assert "51 % of the ticks" in told
    assert "--fast" in told
    assert clock_missed({"count": 60_000, "late": round(60_000 * MOST_LATE) + 1, "bare_late": 0})
