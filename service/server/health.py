"""The state of an axis in a word: ok only while it learns what it is sent."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

#: Time over which rates and shares are taken, s, and the shortest one that is judged.
WINDOW_S: Final = 10.0
_LEAST_S: Final = 2.0
#: Least share of the samples that are learnt or passed while it is ok.
LEAST_LEARNT: Final = 0.5
#: Verdicts on samples of which nothing is to be learnt: the stage rests.
_RESTING: Final = frozenset({"learnt", "passed", "unexcited"})


class _Reading(NamedTuple):
    at_s: float
    received: int
    dropped: int
    gates: dict[str, int]


class Health:
    """Follows the counts of an axis. The publishing thread updates it; any thread reads.

    Attributes
    ----------
    per_s : samples received per second over the last seconds; None before two readings.
    """

    def __init__(self) -> None:
        self.per_s: float | None = None
        self._readings: deque[_Reading] = deque()
        self._dropped = 0
        self._refusal = ""

    def update(self, now_s: float, received: int, dropped: int, gates: dict[str, int]) -> None:
        """Take the counts at ``now_s`` (any monotonic clock), once a second or so."""
        readings = self._readings
        readings.append(_Reading(now_s, received, dropped, dict(gates)))
        while len(readings) > 2 and now_s - readings[1].at_s >= WINDOW_S:
            readings.popleft()
        first, last = readings[0], readings[-1]
        passed_s = last.at_s - first.at_s
        if passed_s <= 0.0:
            return
        self.per_s = max(0, last.received - first.received) / passed_s
        self._dropped = max(0, last.dropped - first.dropped)
        new = {name: count - first.gates.get(name, 0) for name, count in last.gates.items()}
        total = sum(new.values())
        good = sum(count for name, count in new.items() if name in _RESTING)
        refused = {name: count for name, count in new.items() if name not in _RESTING}
        judged = passed_s >= _LEAST_S and total > 0 and good < LEAST_LEARNT * total
        self._refusal = max(refused, key=lambda name: refused[name]) if judged else ""

    def state(self, status: dict[str, Any], factor: int) -> tuple[str, str]:
        """(state, reason in words) for a status without them; ``factor`` : by which samples are thinned."""
        if status["trouble"]:
            return str(status["trouble"]), "see the table of troubles"
        if status["stale"]:
            return "stale", "no samples come, or too many wait to be learnt"
        if status["frozen"]:
            return "frozen", "an operator has stopped the learning"
        if not status["learning"]:
            return "not learning", "no model of this axis learns"
        if not status["samples"]["received"]:
            return "no samples", "none has come since the start"
        if self._dropped:
            return "dropping", f"{self._dropped} samples were dropped in the last {WINDOW_S:g} s: too many waited"
        if factor > 1:
            rate = "" if self.per_s is None else f" of {self.per_s:.0f} samples/s"
            return f"thinned 1/{factor}", f"the learner cannot keep up: it learns one stretch in {factor}{rate}"
        if self._refusal:
            return "refusing", f"most samples of the last {WINDOW_S:g} s are not learnt: {self._refusal}"
        if status["quality"].get("valid") == 0.0:
            return "unsure", "the recent error of the learning model is too large"
        return "ok", ""
