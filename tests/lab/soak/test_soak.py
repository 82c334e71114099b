"""The soak's parts: plans, references, intervals, faults of a stage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.lab.commands.soak import seconds
from dehyst.lab.soak.controller import ControlTask
from dehyst.lab.soak.fault_plan import FAULT_KINDS, TAIL_S, WARM_S, make_plan, select_kinds
from dehyst.lab.soak.observed import Intervals
from dehyst.service.stage_node.faults import decode_fault

# ---- the plan


@given(seed=st.integers(0, 2**31), duration_s=st.floats(15.0, 4000.0))
@settings(max_examples=30, deadline=None)
def test_faults_follow_one_another_with_time_to_recover(seed: int, duration_s: float) -> None:
    plan = make_plan(duration_s, seed, tuple(FAULT_KINDS))
    assert plan == make_plan(duration_s, seed, tuple(FAULT_KINDS))
    last = WARM_S
    for fault in plan.faults:
        assert fault.at_s >= last
        low, high = FAULT_KINDS[fault.kind].duration_s
        assert low <= fault.duration_s <= high + 1e-3
        last = fault.window_s[1]
    assert not plan.faults or last <= duration_s - TAIL_S
    assert set(plan.left_out) | {fault.kind for fault in plan.faults} == set(FAULT_KINDS)


def test_unknown_kinds_and_odd_durations_are_refused() -> None:
    with pytest.raises(InputError, match="--faults: got 'fire', expected none, or some of: kill_primary"):
        select_kinds(["nan", "fire"])
    assert select_kinds([]) == tuple(FAULT_KINDS)
    asked = {"90s": 90.0, "30m": 1800.0, "2h": 7200.0, "3d": 259_200.0, "45": 45.0}
    assert {text: seconds(text) for text in asked} == asked
    for text in ("3s", "abc", "10x", "1e9h", ""):
        with pytest.raises(InputError, match="--duration: got"):
            seconds(text)


# ---- which numbers were seen


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 12)), max_size=25), st.sets(st.integers(0, 70)))
def test_intervals_are_a_set_of_integers(parts: list[tuple[int, int]], others: set[int]) -> None:
    found, expected = Intervals(), set()
    for start, n in parts:
        found.add(start, start + n)
        expected |= set(range(start, start + n))
    assert {k for a, b in found.spans for k in range(a, b)} == expected
    assert len(found) == len(expected)
    assert all(b < c for (_, b), (c, _) in zip(found.spans, found.spans[1:], strict=False))
    other = Intervals()
    other.add_all(np.array(sorted(others, reverse=True), dtype=np.int64))
    assert {k for a, b in other.spans for k in range(a, b)} == others
    assert {k for a, b in found.minus(other).spans for k in range(a, b)} == expected - others


# ---- faults of a stage


@pytest.mark.parametrize(
    ("payload", "named"),
    [
        (b"\xff", "payload"),
        (b"[1]", "payload"),
        (b'{"fault": "fire"}', "fault"),
        (b'{"fault": "nan"}', "duration_s"),
        (b'{"fault": "nan", "duration_s": -1}', "duration_s"),
        (b'{"fault": "nan", "duration_s": 1, "value": "x"}', "value"),
        (b'{"fault": "change"}', "values"),
        (b'{"fault": "change", "values": {"a": true}}', "values.a"),
    ],
)
def test_a_malformed_fault_names_its_field(payload: bytes, named: str) -> None:
    with pytest.raises(InputError, match=f"^{named}: got"):
        decode_fault(payload)


@pytest.mark.parametrize(
    ("u_V", "before_V", "allowed"),
    [
        ([1.0, 2.0], 0.0, True), ([1.0, 2.0], math.nan, True), ([2.0, 3.0], 0.0, False), ([1.0, 3.0], 0.0, False),
        ([-0.1], 0.0, False), ([10.0, 10.1], 10.0, False), ([1.0, math.nan], 0.0, False), ([math.inf], 10.0, False),
    ],
)  # fmt: skip
def test_an_answer_keeps_limits_slew_and_numbers(u_V: list[float], before_V: float, allowed: bool) -> None:
    task = ControlTask(1e-3, 4.0, 80.0, 1, u_min_V=0.0, u_max_V=10.0, slew_V_per_s=1000.0)
    assert task.allows(np.array(u_V), before_V) is allowed
