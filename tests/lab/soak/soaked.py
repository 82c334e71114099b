"""A soak that was all well, and its verdict: what the tests of the judge spoil."""

from __future__ import annotations

from typing import Any

from lab.soak.verdict.invariants import judge
from lab.soak.verdict.observations import FaultRecord, Observations, QuerySecond, SampleSecond, assess_recovery
from lab.soak.verdict.outcome import soak_summary


def healthy(duration_s: int = 40) -> Observations:
    """A run in which a sample stream broke off for a second, and all was as it should be."""
    observed = Observations(float(duration_s), 76.0, 4.0, "real_time")
    observed.faults = [FaultRecord("gap", 10.0, 11.0)]
    lost = 0
    for k in range(duration_s):
        bad = 10 <= k < 12
        observed.seconds.append(SampleSecond(float(k), 1000 * k, 1000, 1000, 1000 * (2.0 if bad else 0.03), 2.0, 0.2))
        observed.query_seconds.append(QuerySecond(k + 0.9, [200.0, 220.0], [150.0, 160.0], [0.02, 0.03], 0, 0, 0.02))
        lost += 1000 if k == 10 else 0
        observed.counters.append(
            (
                k + 0.5, "i1-a",
                {"seq": 1000.0 * k, "samples.received": 1000.0 * k - lost, "samples.late": 0.0,
                 "samples.lost": float(lost), "samples.restarts": 0.0, "samples.dropped": 0.0,
                 "samples.gates.learnt": 1000.0 * k - lost},
            )
        )  # fmt: skip
    return observed


def verdict(observed: Observations, missing: int = 0) -> dict[str, Any]:
    assess_recovery(observed)
    return soak_summary(observed, judge(observed, missing), {"seen": 1})


def broken(found: dict[str, Any]) -> set[str]:
    return {name for name, row in found["invariants"].items() if row["held"] is False}
