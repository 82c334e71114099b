"""The stage's clock: set for good it ends nothing, wrong for some samples it is refused; and it is kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive.types import InverseModel
from service.axis_state import axis_state, restore_axis
from service.clock import SET_AFTER, SampleClock
from service.wire import SampleBatch
from tests.service.test_axis import make_axis, recording

DT_S = 1e-3


def run(clock: SampleClock, first: int, n: int, off_s: float = 0.0) -> list[float]:
    return [clock.take(k, k * DT_S + off_s, False) for k in range(first, first + n)]


@settings(deadline=None, max_examples=50)
@given(st.floats(-1e9, 1e9).filter(lambda s: abs(s) > 1e-2), st.integers(2, 50))
def test_a_clock_that_is_set_for_good_goes_on_after_some_samples(off_s: float, before: int) -> None:
    clock = SampleClock(DT_S)
    run(clock, 0, before)
    seen = run(clock, before, 100, off_s)
    wanted = DT_S * np.arange(before, before + 100)
    assert all(abs(s - w) > 0.5 * DT_S for s, w in zip(seen[: SET_AFTER - 1], wanted, strict=False))
    np.testing.assert_allclose(seen[SET_AFTER - 1 :], wanted[SET_AFTER - 1 :], atol=1e-6)
    assert clock.sets == 1


def test_times_that_are_wrong_here_and_there_stay_wrong_and_the_others_right() -> None:
    clock = SampleClock(DT_S)
    for k in range(400):
        wrong = k % 3 == 1
        seen = clock.take(k, k * DT_S + 5.0 * wrong * (1 + k % 7), False)
        assert (abs(seen - k * DT_S) < 1e-9) == (not wrong)
    assert clock.sets == 0
    assert math.isnan(clock.take(400, math.nan, False))
    assert clock.take(401, 0.401, False) == 0.401


def test_a_stage_that_counts_anew_goes_on_at_once_and_lost_samples_are_time() -> None:
    clock = SampleClock(DT_S)
    run(clock, 0, 10)
    assert clock.take(500, 0.5, False) == 0.5
    assert clock.take(510, 77.0, True) == pytest.approx(0.51)
    assert clock.take(511, 77.001, False) == pytest.approx(0.511)
    assert clock.sets == 0


def test_it_goes_on_from_its_state_and_refuses_a_damaged_one() -> None:
    one, two = SampleClock(DT_S), SampleClock(DT_S)
    run(one, 0, 20)
    run(one, 20, 8, 3.0)
    two.restore(one.state_dict())
    assert run(one, 28, 30, 3.0) == run(two, 28, 30, 3.0)
    with pytest.raises(KeyError):
        two.restore({"sets": 1})
    assert two.state_dict() == one.state_dict()


@pytest.mark.parametrize("off_s", [-3600.0, 0.25])
def test_an_axis_goes_on_learning_when_the_clock_of_its_stage_was_set(
    models: dict[str, InverseModel], off_s: float
) -> None:
    """Without that every sample from then on was refused for its time, for good."""
    axis = make_axis(models)
    axis.handle(recording(2000))
    later = recording(2000, first=2000)
    verdicts = axis.handle(SampleBatch(later.seq, later.t_s + off_s, later.u_V, later.y_um))
    # Its own sample fits where the time goes on by the numbers again.
    assert verdicts[: SET_AFTER - 1] == ["timing"] * (SET_AFTER - 1)
    assert "timing" not in verdicts[SET_AFTER:]
    assert verdicts.count("learnt") > 700
    assert [e["event"] for e in axis.take_events()] == ["stage_clock_set"]
    again = make_axis(models)
    restore_axis(again, axis_state(axis))
    more = recording(500, first=4000)
    batch = SampleBatch(more.seq, more.t_s + off_s, more.u_V, more.y_um)
    assert again.handle(batch) == axis.handle(batch)
