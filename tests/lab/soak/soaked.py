"""A soak that was all well, and its verdict: what the tests of the judge spoil."""

from __future__ import annotations

from typing import Any

from lab.soak.verdict.judge import judge
from lab.soak.verdict.ledger import Happened, Ledger, Probe
from lab.soak.verdict.outcome import summary
from lab.soak.verdict.settling import settle
from lab.soak.verdict.track import Second


def healthy(duration_s: int = 40) -> Ledger:
    """A run in which a sample stream broke off for a second, and all was as it should be."""
    ledger = Ledger(float(duration_s), 76.0, 4.0, "real_time")
    ledger.faults = [Happened("gap", 10.0, 11.0)]
    lost = 0
    for k in range(duration_s):
        bad = 10 <= k < 12
        ledger.seconds.append(Second(float(k), 1000 * k, 1000, 1000, 1000 * (2.0 if bad else 0.03), 2.0, 0.2))
        ledger.probes.append(Probe(k + 0.9, [200.0, 220.0], [150.0, 160.0], [0.02, 0.03], 0, 0, 0.02))
        lost += 1000 if k == 10 else 0
        ledger.counters.append(
            (
                k + 0.5, "i1-a",
                {"seq": 1000.0 * k, "samples.received": 1000.0 * k - lost, "samples.late": 0.0,
                 "samples.lost": float(lost), "samples.restarts": 0.0, "samples.dropped": 0.0,
                 "samples.gates.learnt": 1000.0 * k - lost},
            )
        )  # fmt: skip
    return ledger


def verdict(ledger: Ledger, missing: int = 0) -> dict[str, Any]:
    settle(ledger)
    return summary(ledger, judge(ledger, missing), {"seen": 1})


def broken(found: dict[str, Any]) -> set[str]:
    return {name for name, row in found["invariants"].items() if row["held"] is False}
