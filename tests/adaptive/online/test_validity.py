"""The judgement to the digit: what an error changes, and the two decisions that must not chatter.

With a step of ``SHORT_S`` the short-term mean square is the square of the last error; numbers are powers of two, so
that nothing is rounded.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.learner import FALLBACK_RATIO, SHORT_S, Delay, Judgement
from dehyst.adaptive.state import restore, save

ENTER_V, LEAVE_V = 0.25, 1.0
BETWEEN_V = 0.5


def judgement(valid: bool = True, rms_V: float = 0.125) -> Judgement:
    V2 = rms_V * rms_V
    return Judgement(V2, V2, V2, V2, valid=valid)


def after(j: Judgement, error_V: float, enter_V: float = ENTER_V, leave_V: float = LEAVE_V) -> bool:
    """Whether it is valid after one error that is the whole short term."""
    j.take(error_V, 0.0, SHORT_S)
    assert math.sqrt(j.short_V2) == abs(error_V)
    return j.decide(enter_V, leave_V)


# ---- validity


def test_it_is_left_above_the_one_and_entered_below_the_other() -> None:
    j = judgement()
    said = [after(j, error_V) for error_V in (0.75, 1.125, 0.75, 0.3125, 0.1875, 0.3125, 0.75, 1.125)]
    assert said == [True, False, False, False, True, True, True, False]


def test_thresholds_that_lie_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(InputError, match="enter <= leave"):
        LearnerConfig(valid_enter=0.012, valid_leave=0.004)


# ---- fallback


def test_the_frozen_model_must_win_clearly_to_be_taken_and_lose_to_be_left() -> None:
    floor_V, frozen_V = 0.0625, 1.0
    assert FALLBACK_RATIO == 1.3  # it is taken beyond 1.3625 V
    j = judgement()
    said = []
    for learnt_V in (1.25, 1.34375, 1.375, 1.25, 1.0, 0.875, 1.25):
        j.take(learnt_V, frozen_V, SHORT_S)
        said.append(j.choose(floor_V, 0.5))
    # At 1.25 either is kept, and at 1.0, where they are equal, the one that is served.
    assert said == [False, False, True, True, True, False, False]


def test_how_long_it_has_fallen_back_is_counted_from_the_last_time() -> None:
    j = judgement()
    told = []
    for learnt_V in (2.0, 2.0, 2.0, 0.5, 2.0):
        j.take(learnt_V, 1.0, SHORT_S)
        j.choose(0.0, 0.25)
        told.append(j.fallen_s)
    assert told == [0.25, 0.5, 0.75, 0.0, 0.25]


# ---- what an error changes


def test_inside_counts_by_what_was_stated_before_the_error_was_known() -> None:
    j = judgement(rms_V=1.0)
    told = []
    for error_V in (0.0, 0.5, 2.0, 1.5):
        j.take(error_V, 0.0, SHORT_S)
        told.append(j.inside)
    # Of the first nothing had been stated; the third is outside, and for it the fourth is within what is stated then.
    assert told == [0, 1, 1, 2]


# ---- the model as it was


def test_the_delay_gives_back_what_was_so_many_steps_ago() -> None:
    delay = Delay(2)
    given = [np.array([float(k), 1.0]) for k in range(6)]
    assert [float(delay.push(vector)[0]) for vector in given] == [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]
    again = Delay(2)
    restore(again, save(delay))
    delay.shift(10.0)
    assert float(delay.push(np.array([6.0, 1.0]))[0]) == 14.0
    assert float(again.push(np.array([6.0, 1.0]))[0]) == 4.0
