"""The stage's clock: set for good it ends nothing, wrong for some samples it is refused; and it is kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.state import restore, save
from dehyst.adaptive.types import InverseModel
from dehyst.service.intake.sequence import RESYNC_AFTER, SET_AFTER, SampleClock
from dehyst.service.protocol.samples import SampleBatch
from tests.service.server.test_axis import make_axis, recording

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
    restore(two, save(one))
    assert run(one, 28, 30, 3.0) == run(two, 28, 30, 3.0)
    with pytest.raises(ModelFileError, match="t_last_s: got nothing"):
        restore(two, {"sets": 1})
    assert save(two) == save(one)


ABSURD = [1e300, -1e18, 2.0**62, 1e10, math.inf, -math.inf, math.nan]


@pytest.mark.parametrize("t_s", ABSURD)
@pytest.mark.parametrize("at", [0, 1, 50])
def test_a_time_that_no_clock_shows_is_none_and_poisons_nothing(t_s: float, at: int) -> None:
    clock = SampleClock(DT_S)
    run(clock, 0, at)
    assert math.isnan(clock.take(at, t_s, False))
    assert not clock.in_doubt
    assert run(clock, at + 1, 50) == [k * DT_S for k in range(at + 1, at + 51)]
    assert clock.sets == 0
    for k in range(at + 51, at + 551):
        clock.take(k, t_s, False)
    assert run(clock, at + 551, 50) == [k * DT_S for k in range(at + 551, at + 601)]


def test_a_first_time_that_is_wrong_is_put_right_however_far_it_is_off() -> None:
    clock = SampleClock(DT_S)
    first_s = clock.take(0, -8e9, False)
    seen = run(clock, 1, 50)
    assert clock.sets == 1
    np.testing.assert_allclose(np.diff(seen[SET_AFTER - 1 :]), DT_S, atol=3e-6)
    assert seen[SET_AFTER - 1] == first_s + SET_AFTER * DT_S


def test_a_count_that_begins_with_a_sample_without_a_time_is_not_a_clock_that_was_set() -> None:
    clock = SampleClock(DT_S)
    run(clock, 0, 10)
    assert math.isnan(clock.take(1010, math.nan, True))
    two = SampleClock(DT_S)
    restore(two, save(clock))
    for one in (clock, two):
        assert one.take(1011, 77.0, False) == pytest.approx(1.011)
        assert one.take(1012, 77.001, False) == pytest.approx(1.012)
        assert one.sets == 0


def test_numbers_are_kept_exactly_and_a_poisoned_state_is_refused() -> None:
    one, two = SampleClock(DT_S), SampleClock(DT_S)
    for k in range(40):
        one.take(2**60 + k, k * DT_S, False)
    restore(two, save(one))
    assert two.take(2**60 + 40, 0.04, False) == one.take(2**60 + 40, 0.04, False) == 0.04
    assert save(two)["number_last"] == 2**60 + 40
    # A first time of 1e300 would never go away again.
    for name in ("t_last_s", "t_offset_s"):
        for time_s in (1e300, math.nan):
            with pytest.raises(ModelFileError, match=name):
                restore(two, {**save(one), name: time_s})


def test_a_learner_that_refuses_what_is_in_order_forgets_its_own_count() -> None:
    clock = SampleClock(DT_S)
    verdicts = ["timing", "out_of_order", "not_finite", "duplicate"] * RESYNC_AFTER
    heard = verdicts[: [clock.must_resync(verdict) for verdict in verdicts].index(True) + 1]
    assert len(heard) - heard.count("not_finite") == RESYNC_AFTER
    for _ in range(3):
        assert not any([clock.must_resync("timing") for _ in range(RESYNC_AFTER - 1)])
        assert not clock.must_resync("learnt")


@pytest.mark.parametrize("t_s", [*ABSURD, -7.0, 1e6])
@pytest.mark.parametrize("at", [0, 700])
def test_an_axis_learns_on_at_once_after_a_single_absurd_time(
    models: dict[str, InverseModel], t_s: float, at: int
) -> None:
    axis = make_axis(models)
    batch = recording(1500)
    batch.t_s[at] = t_s
    verdicts = axis.handle(batch)
    assert verdicts[at] in ("timing", "not_finite", "settling")
    # Only a first time that is wrong, and could be one, takes others to be put right.
    wrong = SET_AFTER if verdicts[at] == "settling" else 0
    assert not {"timing", "not_finite"} & set(verdicts[at + 1 + wrong :])
    assert verdicts[-500:].count("learnt") > 200


def test_what_learns_takes_up_its_count_and_time_from_a_good_sample_alone(models: dict[str, InverseModel]) -> None:
    """A sample that is late, or has a wrong time, was taken as the first one, and all that followed refused for it."""
    for late in (False, True):
        axis = make_axis(models)
        axis.handle(recording(1000))
        batch = recording(1000, first=1000)
        axis.handle(SampleBatch(batch.seq, batch.t_s - 500.0, batch.u_V, batch.y_um))
        assert isinstance(axis.learner, Learner)
        axis.learner.resync()
        batch = recording(1001, first=1999)
        t_s = batch.t_s - 500.0
        if not late:
            batch, t_s = SampleBatch(*(c[1:] for c in (batch.seq, batch.t_s, batch.u_V, batch.y_um))), t_s[1:]
            t_s[0] = 123.0
        verdicts = axis.handle(SampleBatch(batch.seq, t_s, batch.u_V, batch.y_um))
        assert verdicts[0] == ("duplicate" if late else "timing")
        assert not {"timing", "out_of_order"} & set(verdicts[1:])
        assert verdicts.count("learnt") > 300


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
    again.restore(axis.state_dict())
    more = recording(500, first=4000)
    batch = SampleBatch(more.seq, more.t_s + off_s, more.u_V, more.y_um)
    assert again.handle(batch) == axis.handle(batch)
