"""The verdict of a soak: what was observed, what must hold, and the files that say so."""

from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.invariants import Invariant, judge
from lab.soak.verdict.observations import Observations, assess_recovery
from lab.soak.verdict.outcome import report, soak_summary, verdict_line

__all__ = [
    "InterimJudge", "Invariant", "Observations", "assess_recovery", "judge", "report", "soak_summary", "verdict_line",
]  # fmt: skip
