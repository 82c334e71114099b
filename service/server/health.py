"""What the counts of an axis show: its state in a word, and whether samples that come are lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

#: Time over which rates and shares are taken, s, and the shortest one that is judged.
WINDOW_S: Final = 10.0
_LEAST_S: Final = 2.0
#: Least share of the samples that are learnt or passed while it is ok.
LEAST_LEARNT: Final = 0.5
#: What to do where samples come faster than they are learnt.
_OUTRUN: Final = "a simulation that outruns the learner waits by client.wait_learnt(seq)"
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

    def state(self, status: dict[str, Any]) -> tuple[str, str]:
        """(state, reason in words) for a status without them."""
        if status["trouble"]:
            where = "docs/troubleshooting.md says what it means and what to do"
            lost = _lost(status) if status["trouble"] == NOT_RECORDED else ""
            return str(status["trouble"]), "; ".join(filter(None, (status.get("trouble_why"), lost, where)))
        if status["stale"]:
            waiting = status["samples"]["waiting"]
            why = f"{waiting} samples wait to be learnt; {_OUTRUN}" if waiting else "no samples come"
            return "stale", why
        if status["frozen"]:
            return "frozen", "an operator has stopped the learning"
        if not status["learning"]:
            return "not learning", "no model of this axis learns"
        if not status["samples"]["received"]:
            return "no samples", "none has come since the start"
        if self._dropped:
            return "dropping", f"{self._dropped} dropped in the last {WINDOW_S:g} s: too many waited; {_OUTRUN}"
        if (factor := status["thinning"]) > 1:
            rate = "" if self.per_s is None else f" of {self.per_s:.0f} samples/s"
            return f"thinned 1/{factor}", f"the learner cannot keep up: it learns one stretch in {factor}{rate}"
        if self._refusal:
            return "refusing", f"most samples of the last {WINDOW_S:g} s are not learnt: {self._refusal}"
        if status["quality"].get("valid") == 0.0:
            return "unsure", "the recent error of the learning model is too large"
        return "ok", ""


class Staleness:
    """Whether the newest sample that was learnt is too old to answer from.

    It is from ``stale_s`` on (0: never), until the age has come below half of that: the age of a learner that is just
    behind goes up and down with every batch.
    """

    def __init__(self, stale_s: float) -> None:
        self.stale = False
        self._stale_s = stale_s

    def look(self, age_s: float) -> bool:
        """Take the age, s. Returns whether `stale` has changed."""
        before = self.stale
        self.stale = 0.0 < self._stale_s * (0.5 if before else 1.0) < age_s
        return self.stale != before


# --- The ways in which an axis loses the samples of its stage although they come.
#
# A stage that is silent is stale. A stage whose samples come and are dropped, refused for their numbers, or
# contradicted by another sender looks alive: the counters grow, and nothing is learnt. `SampleLosses` compares the
# counters of the last second, once for each look of the publishing thread, and gives what is wrong a name.

SAMPLES_DROPPED: Final = "samples_dropped"
SAMPLES_LOST: Final = "samples_lost"
SAMPLES_MALFORMED: Final = "samples_malformed"
SAMPLES_OUT_OF_ORDER: Final = "samples_out_of_order"
TWO_STAGES: Final = "two_stages"

#: What is compared: the counters of this time, s; the pause between two looks, s; and for how long it must hold, s.
LOSSES_S: Final = 1.0
_LOOK_S: Final = 0.1
_HOLDS_S: Final = 0.7
#: Fewest samples or messages that tell anything.
_LEAST_ARRIVALS: Final = 4
#: Shares of what came: dropped; refused for the number; of another sender, with as many in order at least. Share of
#: what should have come that is missing. The last two in both halves of the time: one restart or outage is none.
_DROPPED: Final = 0.1
_REFUSED: Final = 0.6
_LOST: Final = 0.1
_FOREIGN: Final = 0.05
_IN_ORDER: Final = 0.2


class Arrivals(NamedTuple):
    """Counts since the start.

    Attributes
    ----------
    received : samples that reached the axis. refused : of them, those refused for their number. foreign : of these,
    those that contradict a sample that came before, or belong to another count. dropped : samples for which the queue
    had no room. malformed : messages that could not be decoded. lost : numbers that are missing although nothing here
    left them out.
    """

    received: int = 0
    refused: int = 0
    foreign: int = 0
    dropped: int = 0
    malformed: int = 0
    lost: int = 0


class SampleLosses:
    """The watch over the arrivals of one axis. One thread calls it.

    Attributes
    ----------
    trouble : name of what is lost now, "" for nothing. why : the counts of the last second behind it.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self.why = ""
        self._marks: deque[tuple[float, Arrivals]] = deque()
        self._found = ""
        self._since_s = 0.0

    def look(self, now_s: float, arrivals: Arrivals) -> bool:
        """Judge the arrivals up to ``now_s`` (``time.monotonic``); whether `trouble` has changed."""
        marks = self._marks
        if marks and now_s - marks[-1][0] < _LOOK_S:
            return False
        marks.append((now_s, arrivals))
        while len(marks) > 2 and now_s - marks[1][0] >= LOSSES_S:
            marks.popleft()
        middle = marks[len(marks) // 2][1]
        found, why = _named(
            *(_since(*pair) for pair in ((arrivals, marks[0][1]), (middle, marks[0][1]), (arrivals, middle)))
        )
        if found != self._found:
            self._found, self._since_s = found, now_s
        if found == self.trouble or (found and now_s - self._since_s < _HOLDS_S):
            return False
        self.trouble, self.why = found, why
        return True


def _since(now: Arrivals, then: Arrivals) -> Arrivals:
    return Arrivals(*(a - b for a, b in zip(now, then, strict=True)))


def _named(came: Arrivals, *halves: Arrivals) -> tuple[str, str]:
    """(name, counts in words) of what the arrivals of a second and of its halves show; ("", "") for nothing."""
    samples = came.received + came.dropped
    if came.malformed >= _LEAST_ARRIVALS and samples == 0:
        return SAMPLES_MALFORMED, f"{came.malformed} messages, none of which could be decoded"
    if samples + came.lost < _LEAST_ARRIVALS:
        return "", ""
    if came.dropped > _DROPPED * samples:
        return SAMPLES_DROPPED, f"{came.dropped} of {samples} samples found no room in the queue"
    foreign = all(half.foreign > _FOREIGN * (half.received + half.dropped) for half in halves)
    if foreign and came.received - came.refused >= _IN_ORDER * samples:
        return TWO_STAGES, f"{came.foreign} of {samples} samples contradict the others: two stages send on one key"
    if came.refused > _REFUSED * samples:
        return SAMPLES_OUT_OF_ORDER, f"{came.refused} of {samples} samples were refused for their numbers"
    if all(half.lost > _LOST * (half.lost + half.received + half.dropped) for half in halves):
        missing = f"{came.lost} of {came.lost + samples} numbers are missing"
        if came.malformed >= _LEAST_ARRIVALS:
            return SAMPLES_MALFORMED, f"{came.malformed} messages could not be decoded, and {missing}"
        return SAMPLES_LOST, f"{missing}: samples are lost on the way, or the stage leaves numbers out"
    return "", ""


# --- What of an axis does not reach the disk.

NOT_RECORDED: Final = "samples_not_recorded"
NOT_KEPT: Final = "checkpoints_not_written"

_MEND: Final = "make room on the disk or mend it, and it goes on by itself"


class DiskFailures:
    """The watch over what an axis writes. One thread calls it, once a second or so.

    Attributes
    ----------
    trouble : name of what is not written now, "" for nothing. why : the error behind it, and what to do.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self.why = ""
        self._unrecorded = 0

    def look(self, recorder: Mapping[str, Any] | None, checkpoints: Mapping[str, Any] | None) -> bool:
        """Judge the counters of both, None for what is not kept; whether `trouble` has changed."""
        before, self.trouble, self.why = self.trouble, "", ""
        if checkpoints is not None and checkpoints.get("degraded"):
            self.trouble, self.why = NOT_KEPT, f"{checkpoints['error']}: a restart goes back to the newest; {_MEND}"
        if recorder is not None:
            unrecorded = int(recorder.get("lost", 0)) + int(recorder.get("dropped", 0))
            if recorder.get("degraded") or unrecorded > self._unrecorded:
                self.trouble, self.why = NOT_RECORDED, f"{recorder.get('error') or 'the disk is too slow'}; {_MEND}"
            self._unrecorded = unrecorded
        return self.trouble != before


def _lost(status: Mapping[str, Any]) -> str:
    """What the recording of an axis lacks, in words."""
    recorder = status.get("recorder") or {}
    return f"{recorder.get('lost', 0) + recorder.get('dropped', 0)} samples since the start are in no recording"
