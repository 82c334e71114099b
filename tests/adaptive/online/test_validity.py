"""The judgement to the digit: what an error changes, and the two decisions that must not chatter.

With a step of ``SHORT_S`` the short-term mean square is the square of the last error; numbers are powers of two, so
that nothing is rounded.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import FALLBACK_RATIO, LONG_S, SHORT_S, Judgement
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import Sample

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


@pytest.mark.parametrize("valid", [True, False])
@pytest.mark.parametrize("error_V", [ENTER_V, BETWEEN_V, -BETWEEN_V, LEAVE_V])
def test_between_the_thresholds_and_at_them_either_state_is_kept(valid: bool, error_V: float) -> None:
    j = judgement(valid)
    for _ in range(5):
        assert after(j, error_V) is valid
    assert j.valid is valid


def test_it_is_left_above_the_one_and_entered_below_the_other() -> None:
    j = judgement()
    said = [after(j, error_V) for error_V in (0.75, 1.125, 0.75, 0.3125, 0.1875, 0.3125, 0.75, 1.125)]
    assert said == [True, False, False, False, True, True, True, False]


def test_one_threshold_would_chatter_where_two_do_not() -> None:
    """What the hysteresis is for: errors to and fro about a level change nothing; with one threshold, each time."""
    errors_V = [BETWEEN_V * factor for factor in (0.875, 1.125) * 6]

    def changes(enter_V: float, leave_V: float) -> int:
        j, states = judgement(), [True]
        states += [after(j, error_V, enter_V, leave_V) for error_V in errors_V]
        return sum(a is not b for a, b in itertools.pairwise(states))

    assert changes(ENTER_V, LEAVE_V) == 0
    assert changes(BETWEEN_V, BETWEEN_V) == len(errors_V) - 1


def test_a_single_error_does_not_decide_alone() -> None:
    """One wild error among small ones, at the filter's rate: a fiftieth of its square enters the short term."""
    j = judgement(rms_V=0.0)
    j.take(2.0, 0.0, SHORT_S / 50.0)
    assert j.short_V2 == pytest.approx(4.0 / 50.0, rel=1e-12)
    assert j.decide(ENTER_V, LEAVE_V) is True


def taught(model: LssvmInverse, samples: tuple[np.ndarray, np.ndarray], n: int) -> tuple[Learner, list[Sample]]:
    """A learner after ``n`` samples, and those that come next."""
    learner, (u_V, y_um) = Learner.from_model(model), samples
    rows = [Sample(k, k * 1e-3, float(u), float(y)) for k, (u, y) in enumerate(zip(u_V, y_um, strict=True))]
    for sample in rows[:n]:
        learner.handle(sample)
    return learner, rows[n:]


@pytest.mark.parametrize("valid", [True, False])
def test_the_learner_judges_by_both_of_its_thresholds(
    model: LssvmInverse, all_strokes: tuple[np.ndarray, np.ndarray], valid: bool
) -> None:
    """Shares of the voltage span; its defaults lie apart, and what lies between keeps either state."""
    learner, rest = taught(model, all_strokes, 1000)
    coming = iter(rest)
    c, judgement = learner.config, learner.parts.judgement
    assert c.valid_leave >= 2.0 * c.valid_enter

    def said(share: float, before: bool) -> bool:
        # One error, small beside it, enters with a fiftieth: the rms is a hundredth less.
        judgement.valid, judgement.short_V2 = before, (1.01 * share * model.span_V) ** 2
        judged = judgement.judged
        while judgement.judged == judged:
            learner.handle(next(coming))
        assert math.sqrt(judgement.short_V2) == pytest.approx(share * model.span_V, rel=0.01)
        return judgement.valid

    between = math.sqrt(c.valid_enter * c.valid_leave), 1.02 * c.valid_enter, 0.98 * c.valid_leave
    assert [said(share, valid) for share in between] == [valid] * 3
    assert said(0.98 * c.valid_enter, before=False) is True
    assert said(1.02 * c.valid_leave, before=True) is False


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


def test_means_follow_with_their_time_constants_and_doubt_fades() -> None:
    j = Judgement(1.0, 2.0, 3.0, 4.0, doubt_V2=8.0)
    step_s = 0.05
    j.take(0.5, 2.0, step_s)
    assert j.error_V == 0.5
    assert j.judged == 1
    assert j.long_V2 == pytest.approx(1.0 + (0.25 - 1.0) * step_s / LONG_S, rel=1e-15)
    assert j.short_V2 == pytest.approx(2.0 + (0.25 - 2.0) * step_s / SHORT_S, rel=1e-15)
    assert j.frozen_V2 == pytest.approx(3.0 + (4.0 - 3.0) * step_s / LONG_S, rel=1e-15)
    assert j.frozen_short_V2 == 4.0
    assert j.doubt_V2 == pytest.approx(8.0 * (1.0 - step_s / SHORT_S), rel=1e-15)


def test_a_step_longer_than_the_time_constants_is_taken_whole_and_no_more() -> None:
    j = judgement()
    j.doubt_V2 = 1.0
    j.take(2.0, 4.0, 10.0)
    assert (j.long_V2, j.short_V2, j.frozen_V2, j.frozen_short_V2, j.doubt_V2) == (4.0, 4.0, 16.0, 16.0, 0.0)


def test_the_stated_variance_is_the_worse_of_both_terms_and_doubt() -> None:
    assert Judgement(4.0, 1.0, 0.0, 0.0, doubt_V2=0.5).variance_V2 == 4.5
    assert Judgement(1.0, 4.0, 0.0, 0.0, doubt_V2=0.5).variance_V2 == 4.5


def test_inside_counts_by_what_was_stated_before_the_error_was_known() -> None:
    j = judgement(rms_V=1.0)
    told = []
    for error_V in (0.0, 0.5, 2.0, 1.5):
        j.take(error_V, 0.0, SHORT_S)
        told.append(j.inside)
    # Of the first nothing had been stated; the third is outside, and for it the fourth is within what is stated then.
    assert told == [0, 1, 1, 2]


def test_a_state_comes_back_whole() -> None:
    j = Judgement(1.0, 2.0, 3.0, 4.0, 0.5, 7, 3, False, True, 0.25, 0.125)
    assert load(Judgement, save(j)) == j


# ---- the model as it was


def test_an_error_is_that_of_the_linear_part_as_old_as_an_answer_is(
    model: LssvmInverse, all_strokes: tuple[np.ndarray, np.ndarray]
) -> None:
    learner, rest = taught(model, all_strokes, 1000)
    parts, step_s = learner.parts, learner.config.filter_every * model.dt_s
    age, before = round(learner.config.serving_age_s / step_s), list[np.ndarray]()
    for sample in rest[:400]:
        beta, updates = parts.filter.beta, parts.delayed
        learner.handle(sample)
        if parts.delayed == updates:
            continue
        before.append(beta)
        if len(before) > age:
            kernel_V = parts.share.share * parts.sample["kernel_V"].item()
            served_V = float(parts.home.row.basis @ before[-1 - age]) + kernel_V
            # The share has moved on with this sample, where it is not 1.
            error_V = parts.intake.track.smooth_V - served_V
            assert parts.judgement.error_V == pytest.approx(error_V, abs=2e-4 * model.span_V)
            assert not np.array_equal(before[-1], before[-1 - age])
    assert len(before) > 2 * age
