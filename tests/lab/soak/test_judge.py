"""The verdict of a soak: every invariant is broken by what it is there for, and what a run does not tell is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.lab.soak.controller import ControlTask
from dehyst.lab.soak.fault_plan import FAULT_KINDS, make_plan
from dehyst.lab.soak.judge import MEMORY_MB, TRACKING_PCT, assess, recorded, unrecordable
from dehyst.lab.soak.observed import FaultRecord, Observations, SampleTracker
from dehyst.lab.soak.report import draw, report, verdict_line
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.storage.recorder import Recorder, RecorderConfig
from tests.lab.soak.soaked import broken, healthy, verdict

CONTROL = ControlTask(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)


def test_the_track_counts_errors_steps_and_held_voltages() -> None:
    now = 0.0
    track = SampleTracker(CONTROL, lambda: now)
    track.want(0, np.array([1.0, 2.0, 3.0, 4.0]))
    track.command(0, np.array([0.0, 1.0, 1.5]))

    def take(first: int, u_V: list[float], y_um: list[float]) -> None:
        seq = np.arange(first, first + len(u_V), dtype=np.int64)
        samples = SampleBatch(seq, seq * 1e-3, np.array(u_V), np.array(y_um))
        track.take(samples)
        track.take_sound(samples)

    take(0, [0.0, 1.0], [1.5, 2.0])
    take(2, [1.5, 1.5], [np.nan, 3.0])
    track.take(SampleBatch(np.array([2]), np.array([2e-3]), np.array([9.0]), np.array([3.0])))
    now = 1.5
    take(6, [11.0, np.nan], [0.0, 0.0])
    first, second = track.seconds
    assert (first.samples, first.judged, first.held) == (5, 3, 2)
    assert first.error_sum_um == pytest.approx(0.5 + 0.0 + 1.0)
    assert first.step_V == pytest.approx(1.0), "neither the repeated sample nor the gap makes a step"
    assert second.beyond_V == pytest.approx(1.0)
    assert second.not_finite == 1
    assert track.seen.spans == [(0, 4), (6, 8)]


def test_a_healthy_run_holds_and_has_the_promised_form() -> None:
    found = verdict(healthy())
    assert broken(found) == set()
    assert list(found) == ["verdict", "not_judged", "duration_s", "faults", "invariants", "latency", "samples"]
    assert found["latency"] == {"p50_us": 210.0, "p99_us": 220.0, "p999_us": 220.0}
    assert found["faults"]["gap"]["told_by"] == ["samples.lost"]
    assert found["faults"]["gap"]["worst_recovery_s"] == 1.0
    assert found["invariants"]["tracking"]["worst"] == pytest.approx(100 * 0.03 / 76.0, rel=1e-3)
    assert verdict_line(found) == "held; not judged: memory (too short a run)"
    json.dumps(found, allow_nan=False)


def spoil(observed: Observations, what: str) -> None:
    second, probe = observed.seconds[30], observed.probes[30]
    if what == "voltages_finite":
        second.not_finite = 1
    elif what == "voltages_within_limits":
        second.beyond_V = 0.01
    elif what == "voltages_within_slew":
        second.step_V = 4.1
    elif what == "answers_safe":
        observed.probes[5].unsafe = 1
    elif what == "queries_answered":
        probe.silent_s = 0.4
    elif what == "follower_age":
        probe.ages_s = [0.3]
    elif what == "answered_again":
        observed.probes[11].silent_s = 2.0
    elif what == "recovers_by_itself":
        for late in observed.seconds[12:25]:
            late.error_sum_um = 1000.0
    elif what == "faults_told":
        observed.faults.append(FaultRecord("gap", 20.0, 20.5))
    elif what == "faults_happened":
        observed.faults, observed.planned = [], 3
    elif what == "faults_held":
        observed.faults[0].breaches.append("named after 2.0 s")
    elif what == "processes_alive":
        observed.ended.append((3.0, "viewer"))
    elif what == "tracking":
        for late in observed.seconds[20:]:
            late.error_sum_um = 1000.0 * 2.0 * TRACKING_PCT / 100.0 * 76.0


@pytest.mark.parametrize(
    "what",
    ["voltages_finite", "voltages_within_limits", "voltages_within_slew", "answers_safe",
     "queries_answered", "answered_again", "follower_age", "recovers_by_itself", "faults_told", "faults_happened",
     "faults_held", "processes_alive", "tracking"],
)  # fmt: skip
def test_every_invariant_is_broken_by_what_it_is_there_for(what: str) -> None:
    observed = healthy()
    spoil(observed, what)
    found = verdict(observed)
    assert what in broken(found)
    assert found["verdict"] == "broken"


def test_a_lost_record_breaks_the_run() -> None:
    assert broken(verdict(healthy(), missing=1)) == {"no_record_lost"}


def test_samples_are_accounted_for() -> None:
    def thinned(k: int, status: dict[str, Any]) -> None:
        samples = status["samples"]
        if k >= 30:
            samples |= {"received": samples["received"] + 2000, "thinned": 5000, "dropped": 2000}
            samples["gates"]["learnt"] -= 5000
            status["seq"] -= 5000 if k < 33 else 0
        if k >= 33:
            # Those that waited before them have been handled: only now their numbers have been passed.
            samples["left_out"] = 7000
            status["seq"] += 2000

    def lost(k: int, status: dict[str, Any]) -> None:
        status["samples"]["gates"]["learnt"] -= 100 if k == 30 else 0

    assert broken(verdict(healthy(change=thinned))) == set()
    assert broken(verdict(healthy(change=lost))) == {"samples_accounted"}


@pytest.mark.parametrize(("grows_mb", "held"), [(0.5 * MEMORY_MB, True), (1.5 * MEMORY_MB, False)])
def test_memory_in_use_is_compared_with_that_after_the_warm_up(grows_mb: float, held: bool) -> None:
    def grows(k: int, status: dict[str, Any]) -> None:
        # All that is taken in the warm-up, and for a moment, is no growth.
        mb = 100.0 + min(k, 180) + grows_mb * (k > 700) + 50.0 * (k in (185, 999))
        status["memory"] = {"malloc_bytes": mb * 2**20, "python_blocks": 10}

    found = verdict(healthy(1000, grows))
    assert found["invariants"]["memory"]["held"] is held
    assert verdict(healthy(700, grows))["not_judged"] == ["memory"], "less than ten minutes after the warm-up"


def test_bad_messages_are_told_where_queries_and_samples_are_counted() -> None:
    """Of both: a service that counts the queries alone has not told of the samples."""
    for both in (True, False):

        def count(k: int, status: dict[str, Any], both: bool = both) -> None:
            status["queries"] = {"errors": 5 * (k > 10)}
            status["samples"]["malformed"] = 5 * (k > 10 and both)

        observed = healthy(change=count)
        observed.faults[0].kind = "bad_queries"
        assess(observed)
        assert bool(observed.faults[0].told) is both


def test_a_fault_whose_time_the_run_did_not_have_is_not_judged() -> None:
    observed = healthy()
    for second in observed.seconds[36:]:
        second.error_sum_um = 1000.0
    observed.faults.append(FaultRecord("gap", 36.0, 38.5))
    assert broken(verdict(observed)) == set()
    for second in observed.seconds[30:]:
        second.error_sum_um = 1000.0
    observed.faults[-1] = FaultRecord("gap", 31.0, 32.0)
    assert broken(verdict(observed)) == {"recovers_by_itself", "faults_told", "tracking"}


def test_what_a_run_does_not_tell_is_named_with_the_reason() -> None:
    observed = healthy()
    for second in observed.seconds:
        second.held = 1
    assert verdict_line(verdict(observed)).startswith("held; not judged: tracking (no such second), memory")
    # Where every second is one of a fault nobody can say how soon queries are answered without one.
    observed.faults = [FaultRecord("gain", 0.0, 30.0)]
    assert {"queries_answered", "follower_age"} <= set(verdict(observed)["not_judged"])


def test_samples_that_were_recorded_aside_are_in_a_recording(tmp_path: Path) -> None:
    k = np.arange(1000)
    with Recorder(RecorderConfig(tmp_path)) as recorder:
        recorder.put(k[:400], k[:400] * 1e-3, k[:400] * 0.1, k[:400] * 0.1, "learnt")
        recorder.put_aside(k[400:], k[400:] * 1e-3, k[400:] * 0.1, k[400:] * 0.1, "thinned")
    found, rows = recorded([tmp_path])
    assert (len(found), rows) == (1000, 1000)


def test_what_was_seen_just_before_the_router_went_proves_nothing() -> None:
    observed = healthy()
    observed.faults = [FaultRecord("restart_router", 10.4, 10.5)]
    ((start, stop),) = unrecordable(observed).spans
    assert start == 8_001
    assert stop == 23_001, "in time to recover"
    observed.faults = [FaultRecord("gap", 10.4, 10.5)]
    assert len(unrecordable(observed)) == 0


def test_the_files_of_a_run_say_what_was_found(tmp_path: Path) -> None:
    observed = healthy()
    observed.faults[0].breaches.append("it went wrong")
    observed.notes.append("a note")
    found = verdict(observed)
    text = report(found, observed, make_plan(40.0, 1, ("gap",)), interrupted=True)
    assert text.startswith("# Soak: broken; not judged: memory (too short a run)\n")
    for part in ("Interrupted", "- a note", "- **gap: it went wrong**", f"| gap | {FAULT_KINDS['gap'].what} | 1 |"):
        assert part in text
    draw(tmp_path / "soak.png", observed)
    assert (tmp_path / "soak.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
