"""The verdict of a soak: invariants, and the interim verdict of a run that has died."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lab.soak.controller import ControlTask
from lab.soak.fault_plan import FAULT_KINDS, make_plan
from lab.soak.session import unrecordable
from lab.soak.verdict import outcome
from lab.soak.verdict.interim import EVERY_S, InterimJudge
from lab.soak.verdict.invariants import TRACKING_PCT, recorded
from lab.soak.verdict.observations import (
    Counters,
    FaultRecord,
    Observations,
    SampleTracker,
    assess_recovery,
    flatten_status,
    query_second,
)
from lab.soak.verdict.outcome import report, verdict_line
from service.protocol.samples import SampleBatch
from service.storage import output as storage_output
from service.storage.recorder import Recorder, RecorderConfig
from tests.lab.soak.soaked import broken, healthy, verdict

# --- The judge of a soak, and the track that it judges from: every invariant is broken by what it is there for.

CONTROL = ControlTask(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)


def batch(first: int, u_V: list[float], y_um: list[float]) -> SampleBatch:
    seq = np.arange(first, first + len(u_V), dtype=np.int64)
    return SampleBatch(seq, seq * 1e-3, np.array(u_V), np.array(y_um))


def test_track_measures_errors_steps_and_holds() -> None:
    now = 0.0
    track = SampleTracker(CONTROL, lambda: now)
    track.want(0, np.array([1.0, 2.0, 3.0, 4.0]))
    track.command(0, np.array([0.0, 1.0, 1.5]))
    for samples in (
        batch(0, [0.0, 1.0], [1.5, 2.0]),
        batch(2, [1.5, 1.5], [math.nan, 3.0]),
    ):
        track.take(samples)
        track.take_sound(samples)
    track.take(batch(2, [9.0], [3.0]))
    now = 1.5
    track.take(batch(6, [11.0, math.nan], [0.0, 0.0]))
    first, second = track.seconds
    assert (first.samples, first.judged, first.held, track.repeated) == (5, 3, 2, 1)
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
        "verdict", "not_judged", "duration_s", "faults", "invariants", "latency", "memory_slope_kb_per_hour", "samples"
    ]  # fmt: skip
    assert list(found["latency"]) == ["p50_us", "p99_us", "p999_us", "echo_p50_us", "echo_p99_us"]
    assert found["faults"]["gap"]["told_by"] == ["samples.lost"]
    assert found["faults"]["gap"]["worst_recovery_s"] == pytest.approx(0.9, abs=1.0)
    assert found["invariants"]["tracking"]["worst"] == pytest.approx(100 * 0.03 / 76.0, rel=1e-3)
    json.dumps(found, allow_nan=False)


def spoil(observed: Observations, what: str) -> None:
    second = observed.seconds[30]
    if what == "voltages_finite":
        second.not_finite = 1
    elif what == "voltages_within_limits":
        second.beyond_V = 0.01
    elif what == "voltages_within_slew":
        second.step_max_V = 4.1
    elif what == "answers_safe":
        observed.query_seconds[5].unsafe = 1
    elif what == "queries_answered":
        observed.query_seconds[30].silent_s = 0.4
    elif what == "follower_age":
        observed.query_seconds[30].ages_s = [0.3]
    elif what == "answered_again":
        observed.query_seconds[11].silent_s = 2.0
    elif what == "recovers_by_itself":
        for late in observed.seconds[12:25]:
            late.error_sum_um = 1000.0
    elif what == "faults_told":
        for _, _, counters in observed.counters:
            counters["samples.received"] += counters["samples.lost"]
            counters["samples.gates.learnt"] = counters["samples.received"]
            counters["samples.lost"] = 0.0
    elif what == "samples_accounted":
        observed.counters[30][2]["samples.gates.learnt"] -= 100.0
    elif what == "processes_alive":
        observed.ended.append((3.0, "viewer"))
    elif what == "tracking":
        for late in observed.seconds[20:]:
            late.error_sum_um = 1000.0 * 2.0 * TRACKING_PCT / 100.0 * 76.0
    elif what == "memory":
        t = np.arange(0.0, 900.0, 1.0)
        observed.memory["a"] = [(float(s), 200_000.0 + 60.0 * s, 17) for s in t]


def test_samples_that_were_thinned_are_accounted_for() -> None:
    observed = healthy()
    for _, _, counters in observed.counters[30:]:
        counters["samples.gates.learnt"] -= 5000.0
        counters["samples.received"] += 2000.0
        counters["samples.thinned"] = 5000.0
        counters["samples.dropped"] = 2000.0
    for _, _, counters in observed.counters[33:]:
        # Those that waited before them have been handled: only now their numbers have been passed.
        counters["samples.left_out"] = 7000.0
        counters["seq"] += 2000.0
    for _, _, counters in observed.counters[30:33]:
        counters["seq"] -= 5000.0
    assert "samples_accounted" not in broken(verdict(observed))
    observed.counters[-1][2]["samples.thinned"] = 0.0
    assert "samples_accounted" in broken(verdict(observed))


def test_samples_that_were_recorded_aside_are_in_a_recording(tmp_path: Path) -> None:
    """Those that were thinned or dropped counted as lost records: 106,013 of them on a busy machine."""
    k = np.arange(1000)
    with Recorder(RecorderConfig(tmp_path)) as recorder:
        recorder.put(k[:400], k[:400] * 1e-3, k[:400] * 0.1, k[:400] * 0.1, "learnt")
        recorder.put_aside(k[400:], k[400:] * 1e-3, k[400:] * 0.1, k[400:] * 0.1, "thinned")
    found, rows = recorded([tmp_path])
    assert (len(found), rows) == (1000, 1000)


@pytest.mark.parametrize(
    "what",
    ["voltages_finite", "voltages_within_limits", "voltages_within_slew", "answers_safe", "queries_answered",
     "answered_again", "follower_age", "recovers_by_itself", "faults_told", "samples_accounted",
     "processes_alive", "tracking", "memory"],
)  # fmt: skip
def test_every_invariant_is_broken_by_what_it_is_there_for(what: str) -> None:
    observed = healthy()
    spoil(observed, what)
    found = verdict(observed)
    assert what in broken(found)
    assert found["verdict"] == "broken"


def late_machine(observed: Observations, late_s: float, others: float = 0.0) -> Observations:
    observed.loop_delays = [(k + 0.95, late_s) for k in range(int(observed.duration_s))]
    observed.other_load = [(k + 0.95, others) for k in range(int(observed.duration_s))]
    return observed


def test_a_fault_of_which_there_was_no_time_to_tell_is_not_judged() -> None:
    for duration_s, held in ((17.9, True), (18.1, False)):
        observed = healthy()
        spoil(observed, "faults_told")
        observed.duration_s = duration_s
        told = verdict(observed)["invariants"]["faults_told"]
        assert told["held"] is held
        assert ("1 of 1 not judged: the run was over" in told["text"]) is held


@pytest.mark.parametrize(("late_s", "held"), [(0.001, False), (0.02, True)])
def test_on_a_busy_machine_a_fault_is_told_of_later(late_s: float, held: bool) -> None:
    observed = late_machine(healthy(), late_s)
    for _, _, counters in observed.counters[:20]:
        lost, counters["samples.lost"] = counters["samples.lost"], 0.0
        counters["samples.received"] += lost
        counters["samples.gates.learnt"] = counters["samples.received"]
    assert verdict(observed)["invariants"]["faults_told"]["held"] is held


@pytest.mark.parametrize(("late_s", "silent_s", "held"), [(0.001, 0.3, False), (0.02, 0.3, True), (0.02, 0.5, False)])
def test_a_time_is_judged_beside_that_of_the_bare_loop(late_s: float, silent_s: float, held: bool) -> None:
    observed = late_machine(healthy(), late_s)
    observed.query_seconds[30].silent_s = silent_s
    assert verdict(observed)["invariants"]["queries_answered"]["held"] is held


@pytest.mark.parametrize(("late_s", "others"), [(0.2, 0.0), (0.001, 0.9)])
def test_what_a_machine_that_stood_still_shows_is_not_judged(late_s: float, others: float) -> None:
    observed = late_machine(healthy(), late_s, others)
    observed.query_seconds[30].silent_s = 5.0
    for second in observed.seconds[12:]:
        second.error_sum_um = 1000.0
        second.held = 1
    found = verdict(observed)
    assert [name for name, said in found["invariants"].items() if said["held"] is None] == [
        "queries_answered",
        "answered_again",
        "follower_age",
        "recovers_by_itself",
        "memory",
        "memory_resident",
    ]
    assert found["not_judged"] == [name for name, said in found["invariants"].items() if said["held"] is None]
    assert "not judged" in found["invariants"]["queries_answered"]["text"]
    assert found["verdict"] == "held"
    # What is not about time is judged as ever.
    observed.seconds[30].beyond_V = 0.01
    assert verdict(observed)["verdict"] == "broken"


def test_a_snapshot_that_is_followed_may_be_old_during_a_fault_and_as_late_as_the_machine() -> None:
    observed = healthy()
    for probe in observed.query_seconds[11:14]:
        probe.ages_s = [5.0]
    observed = late_machine(observed, 0.01)
    for probe in observed.query_seconds[20:]:
        probe.ages_s = [0.12]
    found = verdict(observed)["invariants"]["follower_age"]
    assert (found["held"], found["worst"], found["limit"]) == (True, pytest.approx(0.04), 0.05)
    # One look in a hundred may be worse.
    observed = late_machine(healthy(240), 0.0)
    observed.query_seconds[200].ages_s = [0.4, 0.01]
    assert verdict(observed)["invariants"]["follower_age"]["held"] is True
    for probe in observed.query_seconds[200:210]:
        probe.ages_s = [0.4, 0.01]
    assert verdict(observed)["invariants"]["follower_age"]["worst"] == pytest.approx(0.4)
    assert "follower_age" in broken(verdict(observed))
    # A second that began before the run, when no samples came yet, says nothing of it.
    early = late_machine(healthy(), 0.0)
    early.query_seconds[0].ages_s = [0.6] * 100
    assert verdict(early)["invariants"]["follower_age"]["held"] is True
    early.query_seconds[2].ages_s = [0.6] * 100
    assert "follower_age" in broken(verdict(early))
    # Where others have the processor a learner waits for it, though a loop that only wakes up does not.
    assert "follower_age" in verdict(late_machine(observed, 0.001, 0.3))["not_judged"]


def test_what_a_run_does_not_tell_is_named_with_the_reason() -> None:
    found = verdict(healthy())
    assert (found["verdict"], found["not_judged"]) == ("held", ["memory", "memory_resident"])
    assert found["invariants"]["memory"]["held"] is None
    assert verdict_line(found) == "held; not judged: memory (too short a run), memory_resident (too short a run)"
    observed = healthy()
    observed.seconds[30].sent_step_V = 9.0
    for second in observed.seconds:
        second.held = 1
    line = verdict_line(verdict(observed))
    assert line.startswith("broken; not judged: tracking (no such second), memory (too short a run)")
    plan = make_plan(40.0, 1, ("gap",))
    assert report(verdict(observed), observed, plan, [], False).startswith(f"# Soak: {line}\n")
    assert verdict_line({"verdict": "held", "not_judged": [], "invariants": {}}) == "held"
    # Where every second is one of a fault nobody can say how soon queries are answered without one.
    observed.faults = [FaultRecord("gain", 0.0, 30.0)]
    assert {"queries_answered", "follower_age"} <= set(verdict(observed)["not_judged"])


@given(
    starts=st.lists(
        st.tuples(st.floats(0.0, 30.0), st.floats(0.0, 20.0), st.sampled_from(sorted(FAULT_KINDS))), max_size=8
    ),
    t_s=st.floats(-5.0, 400.0),
)
@example(starts=[(5.0, 0.0, "gain"), (0.5, 0.1, "bad_queries")], t_s=14.0)
def test_a_time_is_quiet_where_no_fault_is_near(starts: list[tuple[float, float, str]], t_s: float) -> None:
    observed, at_s = healthy(), 0.0
    observed.faults = []
    for pause_s, lasts_s, kind in starts:
        observed.faults.append(FaultRecord(kind, at_s + pause_s, at_s + pause_s + lasts_s))
        at_s += pause_s + lasts_s
    windows = [fault.window_s for fault in observed.faults]
    assert observed.quiet(t_s) is not any(begin - 1.0 <= t_s <= end for begin, end in windows)


def test_a_fault_whose_time_the_run_did_not_have_is_not_judged() -> None:
    observed = healthy()
    for second in observed.seconds[36:]:
        second.error_sum_um = 1000.0
    observed.faults.append(FaultRecord("gap", 36.0, 38.5))
    found = verdict(observed)
    assert found["invariants"]["recovers_by_itself"]["held"] is True
    assert "1 of 2 faults not judged" in found["invariants"]["recovers_by_itself"]["text"]
    observed = healthy()
    for second in observed.seconds[32:]:
        second.error_sum_um = 1000.0
    observed.faults.append(FaultRecord("gap", 32.0, 33.0))
    assert "recovers_by_itself" in broken(verdict(observed))


def test_a_silence_belongs_to_the_fault_that_made_it() -> None:
    observed = healthy()
    observed.faults.append(FaultRecord("restart_router", 16.0, 16.3))
    observed.query_seconds[16].silent_s = 2.7
    assess_recovery(observed)
    assert [fault.silent_s for fault in observed.faults] == [0.02, 2.7]


def test_a_plan_of_which_nothing_happened_proves_nothing() -> None:
    observed = healthy()
    observed.faults = []
    observed.planned = 3
    assert "faults_happened" in broken(verdict(observed))


def test_a_lost_record_breaks_the_run() -> None:
    assert broken(verdict(healthy(), missing=1)) == {"no_record_lost"}


def test_what_was_seen_just_before_the_router_went_proves_nothing() -> None:
    """The second in which 640 samples never came has fewer samples than numbers; all its numbers are excused."""
    observed = healthy()
    first = 0
    for k, second in enumerate(observed.seconds):
        first += 1640 if k == 10 else 1000
        second.seq = first - 1
    observed.faults = [FaultRecord("restart_router", 10.4, 10.5)]
    ((start, stop),) = unrecordable(observed).spans
    # From what was not written yet before the fault to the end of the time in which all must be well again.
    assert start == 9_000
    assert stop == 10_000 + 1640 + 1000 * (math.floor(10.5 + FAULT_KINDS["restart_router"].recover_s) - 10)
    observed.faults = [FaultRecord("gap", 10.4, 10.5)]
    assert len(unrecordable(observed)) == 0


def test_status_is_flattened() -> None:
    told = {"seq": 5, "samples": {"received": 6, "gates": {"learnt": 4}}, "recorder": None, "stage": "x"}
    assert flatten_status(told) == {"samples.received": 6.0, "samples.gates.learnt": 4.0, "seq": 5.0, "serves": 1.0}


def test_packed_counters_are_those_that_were_given() -> None:
    rows = [Counters({"a": 1.0, "b": 2.0}), Counters({"a": 3.0, "b": 4.0}), Counters({"c": 5.0})]
    assert [dict(row) for row in rows] == [{"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 4.0}, {"c": 5.0}]
    assert rows[2].get("a", 0.0) == 0.0
    line = {"service_us": [1.5], "echo_us": [], "failed": 0, "unsafe": 0, "silent_s": 0.1, "ages_s": [0.5], "error": ""}
    probe = query_second(line, 3.0)
    assert (list(probe.service_us), len(probe.echo_us), probe.t_s) == ([1.5], 0, 3.0)


# --- A soak is judged while it runs: each minute by itself, what cannot be told yet left out, and the files whole.


class Run:
    """A healthy run that is told to an `Interim` second by second, as a soak does."""

    def __init__(self, folder: Path, duration_s: int = 200, tracking_pct: float | None = TRACKING_PCT) -> None:
        self.whole = healthy(duration_s)
        self.seen = replace(self.whole, seconds=[], query_seconds=[], counters=[], faults=[])
        self.path = folder / "soak.json"
        self.said: list[str] = []
        self.interim = InterimJudge(self.seen, self.path, self.said.append, tracking_pct)

    def until(self, end_s: int) -> dict[str, Any]:
        """What ``soak.json`` holds after the seconds to ``end_s``; {} where there is none."""
        for k in range(len(self.seen.seconds), end_s):
            self.seen.seconds.append(self.whole.seconds[k])
            self.seen.query_seconds.append(self.whole.query_seconds[k])
            self.seen.counters.append(self.whole.counters[k])
            # A fault is there when it begins, and ended when it is over.
            self.seen.faults = [f if f.end_s <= k else replace(f, end_s=float("nan"))
                                for f in self.whole.faults if f.begin_s <= k]  # fmt: skip
            self.interim.due(k + 1.0, lambda: {"seen": 1})
        return dict(json.loads(self.path.read_text())) if self.path.exists() else {}


def test_every_minute_there_is_a_file_of_the_promised_form(tmp_path: Path) -> None:
    run = Run(tmp_path)
    assert run.until(59) == {}
    found = run.until(61)
    end = verdict(healthy(200))
    assert list(found) == list(end)
    assert set(found["invariants"]) == set(end["invariants"])
    assert found["verdict"] == "running"
    assert found["duration_s"] == 60.0
    assert found["faults"]["gap"] == end["faults"]["gap"]
    assert set(found["not_judged"]) == {
        "faults_happened", "no_record_lost", "memory", "memory_resident", "follower_age"
    }  # fmt: skip
    assert found["samples"] == {"seen": 1, "without_their_voltage_in_time": 0}
    assert run.until(125)["duration_s"] == 120.0
    assert run.said == []
    assert [path.name for path in tmp_path.iterdir()] == ["soak.json"], "nothing half written is left"


def test_a_stretch_at_a_time_tells_what_the_whole_does(tmp_path: Path) -> None:
    run = Run(tmp_path, 250)
    run.whole.faults += [FaultRecord("gap", 70.2, 71.0), FaultRecord("gap", 118.0, 119.0)]
    for k in (71, 118, 119):
        run.whole.seconds[k].error_sum_um *= 50.0
    run.whole.seconds[130].held = 3
    run.whole.query_seconds[130].silent_s = 0.11
    run.whole.seconds[190].error_sum_um *= 1.5
    for _, _, counters in run.whole.counters[70:]:
        counters["samples.lost"] += 5.0
        counters["samples.received"] -= 5.0
        counters["samples.gates.learnt"] -= 5.0
    for _, _, counters in run.whole.counters[118:]:
        counters["samples.lost"] += 5.0
        counters["samples.received"] -= 5.0
        counters["samples.gates.learnt"] -= 5.0
    found = run.until(250)
    end = verdict(replace(run.whole, seconds=run.whole.seconds[:236], query_seconds=run.whole.query_seconds[:236]))
    assert found["faults"] == end["faults"]
    for name, one in found["invariants"].items():
        if name not in found["not_judged"]:
            assert one["held"] is end["invariants"][name]["held"] is True, name
            assert one["worst"] == pytest.approx(end["invariants"][name]["worst"], abs=1e-6), name


def spoil_second(observed: Observations, name: str) -> None:
    if name == "voltages_finite":
        observed.seconds[80].sent_not_finite = 1
    elif name == "voltages_within_slew":
        observed.seconds[80].sent_step_V = 5.0
    elif name == "voltages_within_limits":
        observed.seconds[80].sent_beyond_V = 0.5
    elif name == "answers_safe":
        observed.query_seconds[80].unsafe = 1
    elif name == "queries_answered":
        observed.query_seconds[80].silent_s = 1.0
    elif name == "follower_age":
        for probe in observed.query_seconds[66:]:
            probe.ages_s = [0.2, 0.01]
    elif name == "tracking":
        for second in observed.seconds[66:]:
            second.error_sum_um *= 20.0
    elif name == "samples_accounted":
        observed.counters[80][2]["samples.gates.learnt"] -= 100.0
    elif name == "processes_alive":
        observed.ended.append((80.0, "viewer"))
    elif name == "faults_told":
        observed.faults.append(FaultRecord("gap", 75.0, 76.0))
    elif name == "recovers_by_itself":
        observed.faults.append(FaultRecord("payload", 75.0, 75.1))
        for second in observed.seconds[75:88]:
            second.error_sum_um = 300.0
    elif name == "answered_again":
        observed.faults.append(FaultRecord("payload", 75.0, 75.1))
        observed.query_seconds[76].silent_s = 3.0


@pytest.mark.parametrize(
    "name",
    ["voltages_finite", "voltages_within_slew", "voltages_within_limits", "answers_safe", "queries_answered",
     "follower_age", "tracking", "samples_accounted", "processes_alive", "faults_told", "recovers_by_itself",
     "answered_again"],
)  # fmt: skip
def test_the_first_breach_is_told_when_it_shows_and_is_not_forgotten(tmp_path: Path, name: str) -> None:
    run = Run(tmp_path, 260)
    if name == "processes_alive":
        assert run.until(61)["verdict"] == "running"
    spoil_second(run.whole, name)
    found = run.until(125)
    assert found["verdict"] == "broken so far"
    assert found["invariants"][name]["held"] is False
    (line,) = run.said
    assert line.startswith(f"  (!) {name}: first seen broken at 120 s: ")
    assert f"{name}: first seen broken at 120 s" in run.seen.notes, "and the report will say so"
    found = run.until(255)
    assert (found["duration_s"], found["verdict"]) == (240.0, "broken so far")
    assert len(run.said) == 1


def test_a_slow_start_is_no_alarm(tmp_path: Path) -> None:
    """A share of a hundredth is not told by the few looks of the first minute."""
    run = Run(tmp_path, 200)
    run.whole.query_seconds[2].ages_s = [0.33, 0.33]
    found = run.until(61)["invariants"]["follower_age"]
    assert (found["held"], found["why"]) == (None, "47 seconds so far")
    assert run.until(125)["invariants"]["follower_age"]["held"] is True
    assert run.said == []


def test_a_fault_that_is_still_open_is_not_settled(tmp_path: Path) -> None:
    run = Run(tmp_path, 200)
    run.whole.faults.append(FaultRecord("gap", 55.0, 57.0))
    for second in run.whole.seconds[55:62]:
        second.error_sum_um = 1000.0
    found = run.until(61)
    assert found["faults"]["gap"]["count"] == 1, "only the one before it"
    assert found["verdict"] == "running"
    assert all(not fault.reported_by and not fault.silent_s for fault in run.seen.faults), "the end settles them"
    found = run.until(125)
    assert found["faults"]["gap"]["count"] == 2
    assert found["invariants"]["faults_told"]["held"] is False, "nobody told of the second"


def test_a_limit_that_is_known_at_the_end_waits_for_it(tmp_path: Path) -> None:
    found = Run(tmp_path, 100, None).until(70)
    assert found["invariants"]["tracking"]["held"] is None
    assert "tracking" in found["not_judged"]


class Rows(list[Any]):
    """Rows of days: only slices of a few minutes may be taken of them, and nobody may go through them."""

    most = 0

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        if isinstance(key, slice):
            Rows.most = max(Rows.most, len(found))
        return found

    def __iter__(self) -> Any:
        raise AssertionError("all rows of a run")


def test_a_look_at_the_third_day_takes_no_more_than_one_at_the_first(tmp_path: Path) -> None:
    run = Run(tmp_path, 1200)
    day = run.seen
    for turn in range(20):
        shift = 1200.0 * turn
        day.seconds += [replace(s, t_s=s.t_s + shift) for s in run.whole.seconds]
        day.query_seconds += [replace(p, t_s=p.t_s + shift) for p in run.whole.query_seconds]
        day.counters += [(t_s + shift, who, counters) for t_s, who, counters in run.whole.counters]
        for begin_s in range(10, 1190, 15):
            day.faults.append(FaultRecord("payload", shift + begin_s, shift + begin_s))
    now_s = 20 * 1200.0
    run.interim.look(now_s - 60.0, {})
    for name in ("seconds", "query_seconds", "counters", "faults"):
        setattr(day, name, Rows(getattr(day, name)))
    begin = time.process_time()
    found = run.interim.look(now_s, {})
    assert time.process_time() - begin < 0.5, "some tens of ms on a machine that is free"
    assert 60 < Rows.most < 200
    assert found["faults"]["payload"]["count"] > 1500


def test_a_file_is_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "soak.json"
    outcome.write_summary(path, {"verdict": "running"})

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(storage_output.os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        outcome.write_summary(path, {"verdict": "held"})
    assert json.loads(path.read_text()) == {"verdict": "running"}
    # A soak goes on without the file.
    run = Run(tmp_path)
    run.until(61)
    assert run.said == ["  soak.json of the run so far: no space left"]
    assert run.interim.look(90.0, {})["verdict"] == "running"
    assert EVERY_S == 60.0
