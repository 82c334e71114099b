"""A soak that was all well, and its verdict: what the tests of the judge spoil."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dehyst.lab.soak.judge import assess, judge
from dehyst.lab.soak.observed import Counted, FaultRecord, Observations, QuerySecond, SampleSecond
from dehyst.lab.soak.report import soak_summary


def healthy(
    duration_s: int = 40, change: Callable[[int, dict[str, Any]], None] = lambda _k, _status: None
) -> Observations:
    """A run in which a sample stream broke off for a second, and all was as it should be. ``change``: changes the
    status of a second."""
    observed = Observations(76.0, 4.0, duration_s=float(duration_s))
    observed.faults = [FaultRecord("gap", 10.0, 11.0)]
    lost = 0
    for k in range(duration_s):
        bad = 10 <= k < 12
        observed.seconds.append(SampleSecond(float(k), 1000 * k, 1000, 1000, 1000 * (2.0 if bad else 0.03), 2.0, 0.2))
        observed.probes.append(QuerySecond(k + 0.9, [200.0, 220.0], [0.02, 0.03], 0, 0, 0.02))
        lost += 1000 if k == 10 else 0
        handled = 1000 * k - lost
        status: dict[str, Any] = {
            "seq": 1000 * k, "samples": {"received": handled, "lost": lost, "gates": {"learnt": handled}}
        }  # fmt: skip
        change(k, status)
        observed.counters.append(Counted.of(k + 0.5, "i1-a", status))
    return observed


def verdict(observed: Observations, missing: int = 0) -> dict[str, Any]:
    assess(observed)
    return soak_summary(observed, judge(observed, missing), {"seen": 1})


def broken(found: dict[str, Any]) -> set[str]:
    return {name for name, row in found["invariants"].items() if row["held"] is False}
