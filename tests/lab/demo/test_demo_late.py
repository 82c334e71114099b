"""The demonstration on a machine that does not keep up: it says so, and is late no longer than it must be."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dehyst.lab.demo.controller import blocks_now
from dehyst.lab.demo.plan import make_plan
from dehyst.lab.demo.result import MOST_LATE, clock_missed


def test_a_machine_that_does_not_is_told_of_with_what_to_do() -> None:
    told = clock_missed({"count": 60_000, "late": 30_714})
    assert "51 % of the ticks" in told
    assert "--fast" in told
    assert clock_missed({"count": 60_000, "late": round(60_000 * MOST_LATE) + 1})


@given(st.integers(0, 2399), st.integers(0, 12_000))
def test_a_controller_that_is_late_goes_on_where_one_in_time_would_be(block: int, seen: int) -> None:
    plan = make_plan(12.0, 20)
    size, last = plan.block, plan.ticks // plan.block
    fresh, stop = blocks_now(plan, block, seen)
    assert block <= fresh < stop <= last
    if seen <= block * size:
        assert (fresh, stop) == (block, block + 1)
        return
    assert fresh > block or fresh == last - 1
    assert fresh * size >= seen or fresh == last - 1, "what is due already is not asked for"
    assert stop * size > seen + plan.lead or stop == last, "and all that a controller in time has asked for is"
    assert plan.as_of(fresh) < seen, "by what the stage has told"
