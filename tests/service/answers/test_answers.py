"""Answers of an axis: the model, its stand-in, and the guard of the voltages."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import Feedforward, FloatArray
from dehyst.service.answers.fallback import Rules, answer_safely
from dehyst.service.answers.guard import Limits, check_domain, guard, limit_voltage
from dehyst.service.answers.which_model import domain_weight, trust_by_age
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.model import StandIn, decode_model, encode_model
from dehyst.service.protocol.query import (
    BLENDED,
    LIMITED_SLEW,
    LIMITED_VOLTAGE,
    NOT_FINITE_REPLACED,
    OUTSIDE_DOMAIN,
    STALE,
    STAND_IN,
    FeedforwardQuery,
)
from dehyst.service.server.axis import Axis
from tests.service.conftest import DT_S, make_models

# --- What leaves is safe whatever the model says, and outside its domain the answer passes smoothly to the baseline.

LIMITS = Limits(0.0, 10.0, 2000.0, -50.0, 150.0)
MODELS = make_models()
LSSVM = MODELS["lssvm_adaptive"]
assert isinstance(LSSVM, LssvmInverse)
LINE = StandIn("linear", MODELS["linear"], np.empty(0))


@dataclass(frozen=True)
class Says:
    """A model that says what it is told to, or raises."""

    u_V: tuple[float, ...]
    std_V: float = 0.1
    inside: bool = True
    raises: bool = False
    name: str = "says"
    dt_s: float = DT_S
    memory_size: int = 1

    def rest_memory(self, y_um: float) -> FloatArray:
        return np.zeros(1)

    def feedforward(self, y: FloatArray, v: FloatArray, a: FloatArray, memory: FloatArray) -> Feedforward:
        if self.raises:
            raise ZeroDivisionError("no")
        u = np.array(self.u_V)
        return Feedforward(u, np.full(u.size, self.std_V), np.full(u.size, self.inside), memory + 1.0)

    def track(self, y: FloatArray, v: FloatArray, a: FloatArray, u: FloatArray, memory: FloatArray) -> FloatArray:
        return memory

    def state_dict(self) -> dict[str, object]:
        return {}


def points(y: FloatArray, v: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    return y, np.full(y.size, v), np.zeros(y.size)


def test_outside_it_passes_smoothly_to_the_baseline_and_says_so() -> None:
    v = np.linspace(0.0, 80_000.0, 4001)  # learnt up to 20,000 µm/s, with margins 22,000
    y = np.full(v.size, 40.0)
    memory = LSSVM.rest_memory(40.0)
    at = (y, v, np.zeros(v.size))
    model = LSSVM.feedforward(*at, memory)
    line = LINE.model.feedforward(*at, LINE.memory)
    weight = domain_weight(LSSVM, model, at, 0.5)
    assert weight[v <= 22_000.0].min() == 1.0
    assert weight[v >= 44_001.0].max() == 0.0
    assert np.all(np.diff(weight) <= 0.0)
    assert np.abs(np.diff(weight)).max() < 2e-3  # no step anywhere, and none of the slope at the ends
    assert np.abs(np.diff(weight, 2)).max() < 1e-5
    got = answer_safely(LSSVM, memory, at, math.nan, Rules(replace(LIMITS, slew_V_per_s=1e9)), LINE)
    expected = np.where(weight == 1.0, model.u_V, line.u_V + weight * (model.u_V - line.u_V))
    np.testing.assert_array_equal(got.u_V, np.clip(expected, 0.0, 10.0))
    blended, alone = got.flags & BLENDED > 0, got.flags & STAND_IN > 0
    np.testing.assert_array_equal(blended, (weight > 0.0) & (weight < 1.0))
    np.testing.assert_array_equal(alone, weight == 0.0)
    assert (got.flags[blended | alone] & OUTSIDE_DOMAIN).all()
    assert got.stand_in == "linear"
    assert not got.fallback
    # Where they disagree and neither is sure of being right, the mixture is less sure than either.
    middle = int(np.argmin(np.abs(weight - 0.5)))
    gap = abs(float(model.u_V[middle] - line.u_V[middle]))
    assert got.std_V[middle] == pytest.approx(
        math.sqrt(0.5 * model.std_V[middle] ** 2 + 0.5 * line.std_V[middle] ** 2 + 0.25 * gap**2), rel=1e-2
    )


def test_less_trust_is_more_of_the_baseline_everywhere() -> None:
    y = np.array([40.0, 40.0])
    for trust, u_V in ((1.0, 5.0), (0.5, 5.0 - 0.5 * (5.0 - 39.0 / 11.0)), (0.0, 39.0 / 11.0)):
        got = answer_safely(Says((5.0, 5.0)), np.zeros(1), points(y), math.nan, Rules(LIMITS, trust=trust), LINE)
        assert got.u_V.tolist() == pytest.approx([u_V, u_V])
        assert got.fallback is (trust < 1.0)
    stale = answer_safely(Says((5.0, 5.0)), np.zeros(1), points(y), math.nan, Rules(LIMITS, stale=True), LINE)
    assert stale.u_V.tolist() == [5.0, 5.0]
    assert (stale.flags == STALE).all()
    assert trust_by_age(1.0, 2.0, 60.0) == (1.0, False)
    assert trust_by_age(3.0, 2.0, 60.0) == (1.0, True)
    assert trust_by_age(60.25, 2.0, 60.0) == (0.75, True)
    assert trust_by_age(1e6, 2.0, 60.0) == (0.0, True)
    assert trust_by_age(1e6, 0.0, 60.0) == (1.0, False)


wild = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=200, deadline=None)
@given(
    u=st.lists(wild, min_size=1, max_size=12),
    other=wild,
    std=wild,
    other_std=wild,
    trust=st.floats(0.0, 1.0),
    before=st.one_of(st.just(math.nan), st.floats(0.0, 10.0)),
    inside=st.booleans(),
    raises=st.booleans(),
)
def test_whatever_the_models_say_what_leaves_is_finite_within_limits_and_within_slew(
    u: list[float], other: float, std: float, other_std: float, trust: float, before: float, inside: bool, raises: bool
) -> None:
    n = len(u)
    stand_in = StandIn("other", Says((other,) * n, other_std), np.zeros(1))
    got = answer_safely(
        Says(tuple(u), std, inside, raises), np.zeros(1), points(np.full(n, 40.0)), before,
        Rules(LIMITS, trust=trust), stand_in,
    )  # fmt: skip
    assert np.isfinite(got.u_V).all()
    assert ((got.u_V >= 0.0) & (got.u_V <= 10.0)).all()
    steps = np.diff(got.u_V if math.isnan(before) else np.concatenate([[before], got.u_V]))
    assert (np.abs(steps) <= LIMITS.slew_V_per_s * DT_S * (1 + 1e-12)).all()
    assert np.isfinite(got.memory).all()
    # What is not the model's own is flagged, with what was done to it and who stood in.
    own = np.full(n, math.nan) if raises else np.array(u)
    assert got.flags[got.u_V != own].all()
    assert got.flags.size == got.std_V.size == n
    assert bool(got.stand_in) == bool((got.flags & (BLENDED | STAND_IN)).any())
    for u_V, flags, its_own in zip(got.u_V.tolist(), got.flags.tolist(), own.tolist(), strict=True):
        assert bool(flags & OUTSIDE_DOMAIN) == (raises or not inside)
        assert flags & NOT_FINITE_REPLACED or math.isfinite(its_own)
        if not flags & (BLENDED | STAND_IN | NOT_FINITE_REPLACED | LIMITED_VOLTAGE | LIMITED_SLEW):
            assert u_V == its_own
    # A deviation is none where nobody states one, and never negative where those who answered state none such.
    if not (std < 0.0 or other_std < 0.0):
        assert (np.isnan(got.std_V) | (got.std_V >= 0.0)).all()


@settings(max_examples=200, deadline=None)
@given(
    own_V=st.floats(0.0, 10.0), other_V=st.floats(0.0, 10.0), std=st.floats(1e-6, 1e3),
    other_std=st.floats(1e-6, 1e3), trust=st.floats(0.0, 1.0),
)  # fmt: skip
def test_a_mixture_is_never_surer_than_both_and_knows_how_far_they_are_apart(
    own_V: float, other_V: float, std: float, other_std: float, trust: float
) -> None:
    stand_in = StandIn("other", Says((other_V,), other_std), np.zeros(1))
    got = answer_safely(
        Says((own_V,), std), np.zeros(1), points(np.array([40.0])), math.nan, Rules(LIMITS, trust=trust), stand_in
    )
    least, most = min(std, other_std), max(std, other_std) + abs(own_V - other_V)
    assert least * (1 - 1e-9) <= got.std_V[0] <= most * (1 + 1e-9)


def test_a_snapshot_in_another_process_answers_to_the_same_bit_outside_the_domain_too() -> None:
    axis = Axis(
        AxisConfig("x", Path("x.npz"), LIMITS, served="lssvm_adaptive", learn=""),
        make_models(), None, LIMITS,
    )  # fmt: skip
    model, seq, memory = axis.model("lssvm_adaptive")
    data = encode_model("lssvm_adaptive", model, seq, memory, axis.safety("lssvm_adaptive"))
    message = decode_model(data)
    y, v = np.linspace(-20.0, 130.0, 60), np.linspace(-60_000.0, 60_000.0, 60)
    asked = axis.answer(FeedforwardQuery(y, v, np.zeros(60)))
    assert {BLENDED, STAND_IN} <= {int(f) & (BLENDED | STAND_IN) for f in asked.flags}
    safety = message.safety
    own = answer_safely(
        message.model, message.memory, (y, v, np.zeros(60)), math.nan,
        Rules(LIMITS, safety.blend_share, safety.trust), safety.stand_in, safety.blends,
    )  # fmt: skip
    np.testing.assert_array_equal(own.u_V, asked.u_V)
    np.testing.assert_array_equal(own.std_V, asked.std_V)
    np.testing.assert_array_equal(own.flags, asked.flags)
    assert asked.stand_in == own.stand_in == "linear"
    # One that is asked by name, to be compared, does not give way.
    assert (
        not axis.answer(FeedforwardQuery(y, v, np.zeros(60), model="linear")).flags.astype(int).tolist().count(BLENDED)
    )


# --- Whatever a model answers, what leaves is finite, within the limits and within the slew.

GUARD_LIMITS = Limits(-1.0, 9.0, 500.0, 0.0, 90.0)
GUARD_DT_S = 1e-3
GUARD_STEP_V = GUARD_LIMITS.slew_V_per_s * GUARD_DT_S


@settings(deadline=None)
@given(arrays(np.float64, st.integers(1, 40), elements=st.floats()), st.floats())
def test_what_leaves_is_safe_whatever_comes(u: np.ndarray, before: float) -> None:
    original = u.copy()
    safe, flags = guard(u, np.ones(u.size, dtype=np.bool_), GUARD_DT_S, GUARD_LIMITS, before)
    np.testing.assert_array_equal(u, original)
    assert np.isfinite(safe).all()
    course = np.concatenate(([before], safe)) if math.isfinite(before) else safe
    low, high = GUARD_LIMITS.u_min_V, GUARD_LIMITS.u_max_V
    # No step is larger than the slew limit; that of numbers as large as 1e300 V is at most their round-off.
    assert (np.abs(np.diff(course)) <= GUARD_STEP_V + np.spacing(np.abs(course[:-1]).max(initial=high))).all()
    # Once inside always inside; from outside inwards by a whole step, and never to the other side.
    outside = np.maximum(0.0, np.maximum(low - course, course - high))
    assert (outside[1:] <= np.maximum(0.0, outside[:-1] - GUARD_STEP_V) + np.spacing(np.abs(course[:-1]))).all()
    if not math.isfinite(before):
        assert not outside.any()
    # A point that carries no flag is the model's own.
    np.testing.assert_array_equal(safe[flags == 0], u[flags == 0])
    np.testing.assert_array_equal((flags & NOT_FINITE_REPLACED) > 0, ~np.isfinite(u))
    # What was limited once is not limited again: so a client checks an answer.
    again = guard(safe, np.ones(u.size, dtype=np.bool_), GUARD_DT_S, GUARD_LIMITS, before)[0]
    np.testing.assert_array_equal(again, safe)


@settings(deadline=None)
@given(arrays(np.float64, st.integers(1, 20), elements=st.floats()), st.floats(allow_infinity=False))
def test_the_points_of_a_trajectory_are_limited_as_each_point_is_alone(u: np.ndarray, before: float) -> None:
    safe, flags = guard(u, np.ones(u.size, dtype=np.bool_), GUARD_DT_S, GUARD_LIMITS, before)
    for wanted_V, got_V, bits in zip(u.tolist(), safe.tolist(), flags.tolist(), strict=True):
        low_V, high_V = GUARD_LIMITS.u_min_V, GUARD_LIMITS.u_max_V
        before, alone = limit_voltage(wanted_V, before, low_V, high_V, GUARD_STEP_V)
        assert (before, alone) == (got_V, bits)


def test_a_desired_point_beyond_the_stage_is_refused_by_its_index() -> None:
    check_domain(np.array([0.0, 90.0]), GUARD_LIMITS)
    with pytest.raises(InputError, match=r"y_um\[2\]: got 90.5 µm, expected 0 to 90 µm"):
        check_domain(np.array([1.0, 90.0, 90.5, 1.0]), GUARD_LIMITS)
    with pytest.raises(InputError, match=r"y_um\[0\]"):
        check_domain(np.array([math.nan]), GUARD_LIMITS)


@pytest.mark.parametrize(
    ("values", "field"),
    [((1.0, 1.0, 1.0), "u_max_V"), ((0.0, math.inf, 1.0), "u_max_V"), ((0.0, 1.0, 0.0), "slew"),
     ((0.0, 1.0, 1.0, 2.0, 1.0), "y_max_um"), ((math.nan, 1.0, 1.0), "u_max_V")],
)  # fmt: skip
def test_limits_that_limit_nothing_are_refused(values: tuple[float, ...], field: str) -> None:
    with pytest.raises(InputError, match=field):
        Limits(*values)


def test_who_does_not_blend_answers_as_itself_but_never_what_is_not_finite() -> None:
    y = np.array([40.0, 41.0, 42.0])
    outside = Says((4.0, 4.1, 4.2), inside=False)
    got = answer_safely(outside, np.zeros(1), points(y), math.nan, Rules(LIMITS, trust=0.0), LINE, blends=False)
    assert got.u_V.tolist() == [4.0, 4.1, 4.2]
    assert (got.flags == OUTSIDE_DOMAIN).all()
    broken = Says((4.0, math.nan, math.inf))
    got = answer_safely(broken, np.zeros(1), points(y), math.nan, Rules(LIMITS), LINE, blends=False)
    assert got.u_V.tolist() == pytest.approx([4.0, 40.0 / 11.0, 41.0 / 11.0])
    assert got.flags.tolist() == [0, NOT_FINITE_REPLACED | STAND_IN, NOT_FINITE_REPLACED | STAND_IN]
    assert got.fallback
    assert got.stand_in == "linear"


def test_a_model_that_raises_is_one_that_says_nothing() -> None:
    y = np.array([40.0, 41.0])
    got = answer_safely(Says((), raises=True), np.array([7.0]), points(y), math.nan, Rules(LIMITS), LINE)
    assert got.u_V.tolist() == pytest.approx([39.0 / 11.0, 40.0 / 11.0])
    assert got.memory.tolist() == [7.0]
    assert got.fallback
    # And with nobody to stand in, what was applied last.
    got = answer_safely(Says((), raises=True), np.array([7.0]), points(y), 3.0, Rules(LIMITS), None)
    assert got.u_V.tolist() == [3.0, 3.0]
    assert (got.flags & NOT_FINITE_REPLACED).all()
