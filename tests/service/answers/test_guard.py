"""Whatever a model answers, what leaves is finite, within the limits and within the slew."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from adaptive.errors import InputError
from service.answers.guard import Limits, check_domain, guard
from service.protocol.query import LIMITED_SLEW, LIMITED_VOLTAGE, NOT_FINITE_REPLACED, OUTSIDE_DOMAIN

LIMITS = Limits(-1.0, 9.0, 500.0, 0.0, 90.0)
DT_S = 1e-3
STEP_V = LIMITS.slew_V_per_s * DT_S


@settings(deadline=None)
@given(arrays(np.float64, st.integers(1, 40), elements=st.floats()), st.floats())
def test_what_leaves_is_safe_whatever_comes(u: np.ndarray, before: float) -> None:
    original = u.copy()
    safe, flags = guard(u, np.ones(u.size, dtype=np.bool_), DT_S, LIMITS, before)
    np.testing.assert_array_equal(u, original)
    assert np.isfinite(safe).all()
    assert (safe >= LIMITS.u_min_V).all()
    assert (safe <= LIMITS.u_max_V).all()
    assert (np.abs(np.diff(safe)) <= STEP_V * (1 + 1e-12)).all()
    if math.isfinite(before):
        inside = min(max(before, LIMITS.u_min_V), LIMITS.u_max_V)
        assert abs(safe[0] - inside) <= STEP_V * (1 + 1e-12)
    # A point that carries no flag is the model's own.
    np.testing.assert_array_equal(safe[flags == 0], u[flags == 0])
    np.testing.assert_array_equal((flags & NOT_FINITE_REPLACED) > 0, ~np.isfinite(u))


def test_each_flag_says_what_was_done() -> None:
    u = np.array([12.0, 8.9, 8.8, math.nan, 4.0])
    inside = np.array([True, False, True, True, True])
    safe, flags = guard(u, inside, DT_S, LIMITS)
    assert flags.tolist() == [LIMITED_VOLTAGE, OUTSIDE_DOMAIN, 0, NOT_FINITE_REPLACED, LIMITED_SLEW]
    np.testing.assert_allclose(safe, [9.0, 8.9, 8.8, 8.8, 8.8 - STEP_V])


def test_a_desired_point_beyond_the_stage_is_refused_by_its_index() -> None:
    check_domain(np.array([0.0, 90.0]), LIMITS)
    with pytest.raises(InputError, match=r"y_um\[2\]: got 90.5 µm, expected 0 to 90 µm"):
        check_domain(np.array([1.0, 90.0, 90.5, 1.0]), LIMITS)
    with pytest.raises(InputError, match=r"y_um\[0\]"):
        check_domain(np.array([math.nan]), LIMITS)


@pytest.mark.parametrize(
    ("values", "field"),
    [((1.0, 1.0, 1.0), "u_max_V"), ((0.0, math.inf, 1.0), "u_max_V"), ((0.0, 1.0, 0.0), "slew"),
     ((0.0, 1.0, 1.0, 2.0, 1.0), "y_max_um"), ((math.nan, 1.0, 1.0), "u_max_V")],
)  # fmt: skip
def test_limits_that_limit_nothing_are_refused(values: tuple[float, ...], field: str) -> None:
    with pytest.raises(InputError, match=field):
        Limits(*values)


def test_limits_travel_as_json() -> None:
    open_ended = Limits(0.0, 1.0, math.inf)
    assert Limits.from_json(open_ended.to_json()) == open_ended
    assert Limits.from_json(LIMITS.to_json()) == LIMITS
    with pytest.raises(InputError, match="limits"):
        Limits.from_json({"u_min_V": 0.0})
