"""The soak's parts: plans, references, intervals, faults of a stage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.lab.commands.soak import seconds
from dehyst.lab.soak.controller import PERIOD_S, ControlTask, SoakReference
from dehyst.lab.soak.fault_plan import FAULT_KINDS, TAIL_S, WARM_S, make_plan, select_kinds
from dehyst.lab.soak.observed import Intervals
from dehyst.service.stage_node.faults import Fault, Injector, decode_fault

CONTROL = ControlTask(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)


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


# ---- the reference


def test_reference_repeats_and_its_derivatives_belong_together() -> None:
    reference = SoakReference(1e-3, 4.0, 80.0, 3)
    for at in (0, 31_000, round(PERIOD_S / 1e-3) - 300):
        y, v, a = reference.rows(at, 1200)
        assert y.min() >= 4.0 - 1e-9
        assert y.max() <= 80.0 + 1e-9
        np.testing.assert_allclose(np.gradient(y, 1e-3)[1:-1], v[1:-1], atol=0.5)
        np.testing.assert_allclose(np.gradient(v, 1e-3)[1:-1], a[1:-1], atol=60.0)
    np.testing.assert_array_equal(reference.rows(5, 100), reference.rows(5 + round(PERIOD_S / 1e-3), 100))


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


def rows(first: int, n: int) -> Any:
    seq = np.arange(first, first + n, dtype=np.int64)
    return seq, seq * 1e-3, np.full(n, 1.0), seq * 0.1


def test_readings_lie_for_as_long_as_they_are_told_to() -> None:
    injector = Injector(1e-3, lambda _: None)
    said = {}
    for kind, value in (("nan", 0.0), ("freeze", 0.0), ("saturate", 2.5), ("offset", 7.0)):
        injector.add(Fault(kind, 0.01, value))
        said[kind] = np.array([injector.reading(k, 0.1 * k) for k in range(100, 120)])
        for k in range(120, 122):
            assert injector.reading(k, 5.0) == 5.0, kind
        injector = Injector(1e-3, lambda _: None)
        injector.reading(99, 9.9)
    honest = 0.1 * np.arange(100, 120)
    assert np.isnan(said["nan"][:10]).all()
    np.testing.assert_array_equal(said["nan"][10:], honest[10:])
    np.testing.assert_array_equal(said["freeze"], [*[9.9] * 10, *honest[10:]])
    np.testing.assert_array_equal(said["saturate"], [*[2.5] * 10, *honest[10:]])
    np.testing.assert_allclose(said["offset"], [*(honest[:10] + 7.0), *honest[10:]])
    injector.add(Fault("spike", 0.1, 30.0))
    spiky = np.array([injector.reading(k, 0.0) for k in range(200, 400)])
    assert np.count_nonzero(spiky == 30.0) == 4
    assert injector.counts["spike"] == 4


def test_deliveries_are_withheld_repeated_and_exchanged() -> None:
    def sent(kind: str, value: float = 0.0) -> tuple[list[int], list[float], Injector]:
        injector = Injector(1e-3, lambda _: None)
        injector.add(Fault(kind, 0.012, value))
        injector.reading(4, 0.0)
        messages = [m for first in range(0, 30, 5) for m in injector.deliver(rows(first, 5))] + injector.flush()
        return (
            [int(k) for m in messages for k in m[0]],
            [float(t) for m in messages for t in m[1]],
            injector,
        )

    every = list(range(30))
    seq, _, injector = sent("gap")
    assert seq == [k for k in every if not 4 <= k < 16]
    assert injector.counts["gap"] == 12
    seq, _, _ = sent("duplicate")
    assert sorted(set(seq)) == every
    assert len(seq) == 30 + 20, "the four messages that the fault touches"
    seq, _, _ = sent("reorder")
    assert sorted(seq) == every
    assert seq != every
    seq, t_s, _ = sent("clock", -3600.0)
    assert seq == every
    assert [k for k, t in zip(seq, t_s, strict=True) if t < 0.0] == list(range(4, 16))


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
