"""The soak's parts: plans, references, intervals, faults of a stage, and a judge that finds what is wrong."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive.errors import InputError
from service.commands.soak import seconds
from service.soak.catalogue import KINDS
from service.soak.intervals import Intervals
from service.soak.judge import TRACKING_PCT
from service.soak.ledger import Happened, Ledger, Row, flat, probe_of
from service.soak.monitor import Track
from service.soak.plan import TAIL_S, WARM_S, known_kinds, make_plan
from service.soak.processor import Others
from service.soak.reference import PERIOD_S, SoakReference
from service.soak.run import _excused
from service.soak.settling import settle
from service.soak.setup import Control
from service.stage_faults import Fault, Injector, decode_fault
from service.wire import SampleBatch
from tests.service.soaked import broken, healthy, verdict

CONTROL = Control(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)


# ---- the plan


@given(seed=st.integers(0, 2**31), duration_s=st.floats(15.0, 4000.0))
@settings(max_examples=30, deadline=None)
def test_faults_follow_one_another_with_time_to_recover(seed: int, duration_s: float) -> None:
    plan = make_plan(duration_s, seed, tuple(KINDS))
    assert plan == make_plan(duration_s, seed, tuple(KINDS))
    last = WARM_S
    for fault in plan.faults:
        assert fault.at_s >= last
        low, high = KINDS[fault.kind].duration_s
        assert low <= fault.duration_s <= high + 1e-3
        last = fault.window_s[1]
    assert not plan.faults or last <= duration_s - TAIL_S
    assert set(plan.left_out) | {fault.kind for fault in plan.faults} == set(KINDS)


def test_what_ends_a_service_comes_early_in_a_long_run() -> None:
    plan = make_plan(1800.0, 1, tuple(KINDS))
    assert not plan.left_out
    ends = [fault.at_s for fault in plan.faults if KINDS[fault.kind].ends_service]
    assert len(ends) >= 4
    assert max(ends) <= 0.4 * 1800.0
    assert make_plan(1800.0, 2, tuple(KINDS)).faults != plan.faults
    gains = [fault.value for fault in plan.faults if fault.kind == "gain"]
    assert gains[0] < 0.0 == gains[1], "there and back again"


def test_unknown_kinds_and_odd_durations_are_refused() -> None:
    with pytest.raises(InputError, match="--faults: got 'fire', expected none, or some of: kill_primary"):
        known_kinds(["nan", "fire"])
    assert known_kinds([]) == tuple(KINDS)
    assert [seconds(text) for text in ("90s", "30m", "2h", "45")] == [90.0, 1800.0, 7200.0, 45.0]
    for text in ("3s", "abc", "10x", "1e9h", ""):
        with pytest.raises(InputError, match="--duration: got"):
            seconds(text)


# ---- the reference


@given(first=st.integers(0, 300_000), start=st.integers(1000, 200_000), ticks=st.integers(1500, 6000))
@settings(max_examples=25, deadline=None)
def test_reference_repeats_rests_and_its_derivatives_belong_together(first: int, start: int, ticks: int) -> None:
    reference = SoakReference(1e-3, 4.0, 80.0, 3, [(start, ticks)])
    for at in (first, start - 200, start + ticks - 500, round(PERIOD_S / 1e-3) - 300):
        y, v, a = reference.rows(at, 1200)
        assert y.min() >= 4.0 - 1e-9
        assert y.max() <= 80.0 + 1e-9
        np.testing.assert_allclose(np.gradient(y, 1e-3)[1:-1], v[1:-1], atol=0.5)
        np.testing.assert_allclose(np.gradient(v, 1e-3)[1:-1], a[1:-1], atol=60.0)
    rest = reference.rows(start + 650, ticks - 1300)
    np.testing.assert_allclose(rest[0], 42.0, atol=1e-9)
    plain = SoakReference(1e-3, 4.0, 80.0, 3)
    np.testing.assert_array_equal(plain.rows(5, 100), plain.rows(5 + round(PERIOD_S / 1e-3), 100))


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
    assert {k for a, b in found.minus(other) for k in range(a, b)} == expected - others


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


def test_a_change_is_made_once_and_a_bad_one_is_counted() -> None:
    changes: list[dict[str, float]] = []

    def apply(values: dict[str, float]) -> None:
        if "nothing" in values:
            raise InputError("nothing: unknown")
        changes.append(values)

    injector = Injector(1e-3, apply)
    injector.receive(b'{"fault": "change", "values": {"gain_drift.gain": -0.05}}')
    injector.receive(b'{"fault": "change", "values": {"nothing": 1}}')
    for k in range(5):
        injector.reading(k, 0.0)
    assert changes == [{"gain_drift.gain": -0.05}]
    assert injector.counts["refused"] == 1
    assert "unknown" in injector.error


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


# ---- the track and the judge


def batch(first: int, u_V: list[float], y_um: list[float]) -> SampleBatch:
    seq = np.arange(first, first + len(u_V), dtype=np.int64)
    return SampleBatch(seq, seq * 1e-3, np.array(u_V), np.array(y_um))


def test_track_measures_errors_steps_and_holds() -> None:
    now = 0.0
    track = Track(CONTROL, lambda: now)
    track.want(0, np.array([1.0, 2.0, 3.0, 4.0]))
    track.command(0, np.array([0.0, 1.0, 1.5]))
    track.take(batch(0, [0.0, 1.0], [1.5, 2.0]))
    track.take(batch(2, [1.5, 1.5], [math.nan, 3.0]))
    track.take(batch(2, [9.0], [3.0]))
    now = 1.5
    track.take(batch(6, [11.0, math.nan], [0.0, 0.0]))
    first, second = track.seconds
    assert (first.samples, first.judged, first.held, track.repeated) == (5, 4, 2, 1)
    assert first.error_sum_um == pytest.approx(0.5 + 0.0 + 1.0 + 0.0)
    assert first.step_max_V == pytest.approx(1.0), "neither the repeated sample nor the gap makes a step"
    assert second.beyond_V == pytest.approx(1.0)
    assert second.not_finite == 1
    assert track.seen.spans == [(0, 4), (6, 8)]


def test_a_healthy_run_holds_and_has_the_promised_form() -> None:
    found = verdict(healthy())
    assert broken(found) == set()
    assert found["verdict"] == "held"
    assert list(found) == [
        "verdict", "duration_s", "faults", "invariants", "latency", "memory_slope_kb_per_hour", "samples"
    ]  # fmt: skip
    assert list(found["latency"]) == ["p50_us", "p99_us", "p999_us", "echo_p50_us", "echo_p99_us"]
    assert found["faults"]["gap"]["told_by"] == ["samples.lost"]
    assert found["faults"]["gap"]["worst_recovery_s"] == pytest.approx(0.9, abs=1.0)
    assert found["invariants"]["tracking"]["worst"] == pytest.approx(100 * 0.03 / 76.0, rel=1e-3)
    json.dumps(found, allow_nan=False)


def spoil(ledger: Ledger, what: str) -> None:
    second = ledger.seconds[30]
    if what == "voltages_finite":
        second.not_finite = 1
    elif what == "voltages_within_limits":
        second.beyond_V = 0.01
    elif what == "voltages_within_slew":
        second.step_max_V = 4.1
    elif what == "answers_safe":
        ledger.probes[5].unsafe = 1
    elif what == "queries_answered":
        ledger.probes[30].silent_s = 0.4
    elif what == "answered_again":
        ledger.probes[11].silent_s = 2.0
    elif what == "recovers_by_itself":
        for late in ledger.seconds[12:25]:
            late.error_sum_um = 1000.0
    elif what == "faults_told":
        for _, _, counters in ledger.counters:
            counters["samples.received"] += counters["samples.lost"]
            counters["samples.gates.learnt"] = counters["samples.received"]
            counters["samples.lost"] = 0.0
    elif what == "samples_accounted":
        ledger.counters[30][2]["samples.gates.learnt"] -= 100.0
    elif what == "processes_alive":
        ledger.ended.append((3.0, "viewer"))
    elif what == "tracking":
        for late in ledger.seconds[20:]:
            late.error_sum_um = 1000.0 * 2.0 * TRACKING_PCT / 100.0 * 76.0
    elif what == "memory":
        t = np.arange(0.0, 900.0, 1.0)
        ledger.memory["a"] = [(float(s), 200_000.0 + 60.0 * s, 17) for s in t]


@pytest.mark.parametrize(
    "what",
    ["voltages_finite", "voltages_within_limits", "voltages_within_slew", "answers_safe", "queries_answered",
     "answered_again", "recovers_by_itself", "faults_told", "samples_accounted", "processes_alive", "tracking",
     "memory"],
)  # fmt: skip
def test_every_invariant_is_broken_by_what_it_is_there_for(what: str) -> None:
    ledger = healthy()
    spoil(ledger, what)
    found = verdict(ledger)
    assert what in broken(found)
    assert found["verdict"] == "broken"


def late_machine(ledger: Ledger, late_s: float, others: float = 0.0) -> Ledger:
    ledger.bare = [(k + 0.95, late_s) for k in range(int(ledger.duration_s))]
    ledger.others = [(k + 0.95, others) for k in range(int(ledger.duration_s))]
    return ledger


@pytest.mark.parametrize(("late_s", "silent_s", "held"), [(0.001, 0.3, False), (0.02, 0.3, True), (0.02, 0.5, False)])
def test_a_time_is_judged_beside_that_of_the_bare_loop(late_s: float, silent_s: float, held: bool) -> None:
    ledger = late_machine(healthy(), late_s)
    ledger.probes[30].silent_s = silent_s
    assert verdict(ledger)["invariants"]["queries_answered"]["held"] is held


@pytest.mark.parametrize(("late_s", "others"), [(0.2, 0.0), (0.001, 0.9)])
def test_what_a_machine_that_stood_still_shows_is_not_judged(late_s: float, others: float) -> None:
    ledger = late_machine(healthy(), late_s, others)
    ledger.probes[30].silent_s = 5.0
    for second in ledger.seconds[12:]:
        second.error_sum_um = 1000.0
        second.held = 1
    found = verdict(ledger)
    assert [name for name, said in found["invariants"].items() if said["held"] is None] == [
        "queries_answered",
        "answered_again",
        "recovers_by_itself",
    ]
    assert "not judged" in found["invariants"]["queries_answered"]["text"]
    assert found["verdict"] == "held"
    # What is not about time is judged as ever.
    ledger.seconds[30].beyond_V = 0.01
    assert verdict(ledger)["verdict"] == "broken"


def test_a_fault_whose_time_the_run_did_not_have_is_not_judged() -> None:
    ledger = healthy()
    for second in ledger.seconds[36:]:
        second.error_sum_um = 1000.0
    ledger.faults.append(Happened("gap", 36.0, 38.5))
    found = verdict(ledger)
    assert found["invariants"]["recovers_by_itself"]["held"] is True
    assert "1 of 2 faults not judged" in found["invariants"]["recovers_by_itself"]["text"]
    ledger = healthy()
    for second in ledger.seconds[32:]:
        second.error_sum_um = 1000.0
    ledger.faults.append(Happened("gap", 32.0, 33.0))
    assert "recovers_by_itself" in broken(verdict(ledger))


def test_a_silence_belongs_to_the_fault_that_made_it() -> None:
    ledger = healthy()
    ledger.faults.append(Happened("restart_router", 16.0, 16.3))
    ledger.probes[16].silent_s = 2.7
    settle(ledger)
    assert [fault.silent_s for fault in ledger.faults] == [0.02, 2.7]


def test_a_plan_of_which_nothing_happened_proves_nothing() -> None:
    ledger = healthy()
    ledger.faults = []
    ledger.planned = 3
    assert "faults_happened" in broken(verdict(ledger))


def test_the_processors_share_of_others_is_what_nobody_of_ones_own_took() -> None:
    others = Others()
    assert others.share({1: 0.0}) is None, "a moment ago"
    time.sleep(0.25)
    assert others.share({1: 0.0}) is None, "the first look only begins"
    time.sleep(0.25)
    assert others.share({1: 1e6}) == 0.0, "all of it was one's own"
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        pass
    share = others.share({1: 1e6})
    assert share is not None
    assert 0.0 < share <= 1.0, "this very loop is none of them"


def test_a_lost_record_breaks_the_run() -> None:
    assert broken(verdict(healthy(), missing=1)) == {"no_record_lost"}


def test_what_was_seen_just_before_the_router_went_proves_nothing() -> None:
    """The second in which 640 samples never came has fewer samples than numbers; all its numbers are excused."""
    ledger = healthy()
    first = 0
    for k, second in enumerate(ledger.seconds):
        first += 1640 if k == 10 else 1000
        second.seq = first - 1
    ledger.faults = [Happened("restart_router", 10.4, 10.5)]
    ((start, stop),) = _excused(ledger).spans
    # From what was not written yet before the fault to the end of the time in which all must be well again.
    assert start == 9_000
    assert stop == 10_000 + 1640 + 1000 * (math.floor(10.5 + KINDS["restart_router"].recover_s) - 10)
    ledger.faults = [Happened("gap", 10.4, 10.5)]
    assert len(_excused(ledger)) == 0


def test_status_is_flattened() -> None:
    told = {"seq": 5, "samples": {"received": 6, "gates": {"learnt": 4}}, "recorder": None, "stage": "x"}
    assert flat(told) == {"samples.received": 6.0, "samples.gates.learnt": 4.0, "seq": 5.0, "serves": 1.0}


def test_packed_counters_are_those_that_were_given() -> None:
    rows = [Row({"a": 1.0, "b": 2.0}), Row({"a": 3.0, "b": 4.0}), Row({"c": 5.0})]
    assert [dict(row) for row in rows] == [{"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 4.0}, {"c": 5.0}]
    assert rows[2].get("a", 0.0) == 0.0
    probe = probe_of({"service_us": [1.5], "echo_us": [], "failed": 0, "unsafe": 0, "silent_s": 0.1, "age_s": 0.0,
                      "error": ""}, 3.0)  # fmt: skip
    assert (list(probe.service_us), len(probe.echo_us), probe.t_s) == ([1.5], 0, 3.0)


def test_control_goes_through_its_file(tmp_path: Path) -> None:
    CONTROL.write(tmp_path / "c.json")
    assert Control(**json.loads((tmp_path / "c.json").read_text())) == CONTROL
    assert replace(CONTROL, seed=4) != CONTROL
