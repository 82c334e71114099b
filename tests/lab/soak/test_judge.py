"""The verdict of a soak: every invariant is broken by what it is there for, and what a run does not tell is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from dehyst.lab.soak.judge import MEMORY_MB, TRACKING_PCT, assess, judge
from dehyst.lab.soak.observed import Counted, FaultRecord, Observations, QuerySecond, SampleSecond
from dehyst.lab.soak.report import soak_summary, verdict_line


def healthy(
    duration_s: int = 40, change: Callable[[int, dict[str, Any]], None] = lambda _k, _status: None
) -> Observations:
    """A run in which a sample stream broke off for a second, and all was as it should be. ``change``: changes the
    status of a second."""
    observed = Observations(76.0, 4.0, duration_s=float(duration_s))
    observed.faults = [FaultRecord("gap", 10.0, 11.0)]
    for k in range(duration_s):
        error_um = 2.0 if 10 <= k < 12 else 0.03
        observed.seconds.append(SampleSecond(float(k), 1000 * k, 1000, 1000, 1000 * error_um, 2.0, 0.2))
        observed.probes.append(QuerySecond(k + 0.9, [200.0, 220.0], [0.02, 0.03], 0, 0, 0.02))
        lost = 1000 * (k >= 10)
        handled = 1000 * k - lost
        samples = {"received": handled, "lost": lost, "gates": {"learnt": handled}}
        status: dict[str, Any] = {"seq": 1000 * k, "samples": samples}
        change(k, status)
        observed.counters.append(Counted.of(k + 0.5, "i1-a", status))
    return observed


def verdict(observed: Observations) -> dict[str, Any]:
    assess(observed)
    return soak_summary(observed, judge(observed, 0), {"seen": 1})


def test_a_healthy_run_holds_and_has_the_promised_form() -> None:
    found = verdict(healthy())
    assert list(found) == ["verdict", "not_judged", "duration_s", "faults", "invariants", "latency", "samples"]
    assert found["latency"] == {"p50_us": 210.0, "p99_us": 220.0, "p999_us": 220.0}
    assert (found["faults"]["gap"]["told_by"], found["faults"]["gap"]["worst_recovery_s"]) == (["samples.lost"], 1.0)
    assert found["invariants"]["tracking"]["worst"] == pytest.approx(100 * 0.03 / 76.0, rel=1e-3)
    assert verdict_line(found) == "held; not judged: memory (too short a run)"
    json.dumps(found, allow_nan=False)


def errors(um: float, first: int, last: int = 40) -> Callable[[Observations], None]:
    return lambda o: [setattr(one, "error_sum_um", 1000.0 * um) for one in o.seconds[first:last]] and None


#: What breaks each invariant.
SPOILT: dict[str, Callable[[Observations], Any]] = {
    "voltages_finite": lambda o: setattr(o.seconds[30], "not_finite", 1),
    "voltages_within_limits": lambda o: setattr(o.seconds[30], "beyond_V", 0.01),
    "voltages_within_slew": lambda o: setattr(o.seconds[30], "step_V", 4.1),
    "answers_safe": lambda o: setattr(o.probes[5], "unsafe", 1),
    "queries_answered": lambda o: setattr(o.probes[30], "silent_s", 0.4),
    "answered_again": lambda o: setattr(o.probes[11], "silent_s", 2.0),
    "follower_age": lambda o: setattr(o.probes[30], "ages_s", [0.3]),
    "recovers_by_itself": errors(1.0, 12, 25),
    "faults_told": lambda o: o.faults.append(FaultRecord("gap", 20.0, 20.5)),
    "faults_happened": lambda o: (o.faults.clear(), setattr(o, "planned", 3)),
    "faults_held": lambda o: o.faults[0].breaches.append("named after 2.0 s"),
    "processes_alive": lambda o: o.ended.append((3.0, "viewer")),
    "tracking": errors(2.0 * TRACKING_PCT / 100.0 * 76.0, 20),
}


@pytest.mark.parametrize("what", SPOILT)
def test_every_invariant_is_broken_by_what_it_is_there_for(what: str) -> None:
    observed = healthy()
    SPOILT[what](observed)
    found = verdict(observed)
    assert found["invariants"][what]["held"] is False
    assert found["verdict"] == "broken"


@pytest.mark.parametrize(("grows_mb", "held"), [(0.5 * MEMORY_MB, True), (1.5 * MEMORY_MB, False)])
def test_memory_in_use_is_compared_with_that_after_the_warm_up(grows_mb: float, held: bool) -> None:
    def grows(k: int, status: dict[str, Any]) -> None:
        # All that is taken in the warm-up, and for a moment, is no growth.
        mb = 100.0 + min(k, 180) + grows_mb * (k > 700) + 50.0 * (k in (185, 999))
        status["memory"] = {"malloc_bytes": mb * 2**20, "python_blocks": 10}

    assert verdict(healthy(1000, grows))["invariants"]["memory"]["held"] is held
    assert verdict(healthy(700, grows))["not_judged"] == ["memory"], "less than ten minutes after the warm-up"
