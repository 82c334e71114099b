"""The verdict of a soak: every invariant is broken by what it is there for, and what a run does not tell is named."""

from __future__ import annotations

import json
from typing import Any

import pytest

from dehyst.lab.soak.judge import MEMORY_MB, TRACKING_PCT
from dehyst.lab.soak.observed import FaultRecord, Observations
from dehyst.lab.soak.report import verdict_line
from tests.lab.soak.soaked import broken, healthy, verdict


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


@pytest.mark.parametrize(("grows_mb", "held"), [(0.5 * MEMORY_MB, True), (1.5 * MEMORY_MB, False)])
def test_memory_in_use_is_compared_with_that_after_the_warm_up(grows_mb: float, held: bool) -> None:
    def grows(k: int, status: dict[str, Any]) -> None:
        # All that is taken in the warm-up, and for a moment, is no growth.
        mb = 100.0 + min(k, 180) + grows_mb * (k > 700) + 50.0 * (k in (185, 999))
        status["memory"] = {"malloc_bytes": mb * 2**20, "python_blocks": 10}

    found = verdict(healthy(1000, grows))
    assert found["invariants"]["memory"]["held"] is held
    assert verdict(healthy(700, grows))["not_judged"] == ["memory"], "less than ten minutes after the warm-up"
