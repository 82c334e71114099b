"""The stage's clock: set for good it ends nothing, wrong for some samples it is refused; and it is kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.types import InverseModel
from dehyst.service.intake.sequence import SET_AFTER, SampleClock
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


ABSURD = [1e300, -1e18, 2.0**62, 1e10, math.inf, -math.inf, math.nan]


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
