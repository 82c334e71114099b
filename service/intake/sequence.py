"""The numbers and times of samples: in order, late, far ahead, lost; counters that restart, clocks that are set.

`SequenceTracker` judges the numbers, `SampleClock` the times.

A sample whose number continues the count is in order. Any other number *claims* another count. The tracker changes to
the claimed count only after several consecutive samples have confirmed it: a few for a number ahead of the count, more
for a number behind it, because those samples may only be late. So a single wrong number changes nothing, and from any
count good samples lead back to the right one.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated, Any, Final

from dehyst.adaptive.state import Entry

IN_ORDER: Final = "in_order"
LATE: Final = "late"
#: The number is further ahead than lost samples can explain. Also the name of the refusal.
AHEAD: Final = "ahead"
#: The stage's counter restarted at a lower number.
RESTARTED: Final = "restarted"
#: The stage's counter continues at a higher number that the elapsed time does not explain.
JUMPED: Final = "jumped"
#: Outcomes of samples that are not learnt, and of samples with which another count begins.
REFUSED: Final = frozenset({LATE, AHEAD})
NEW_COUNT: Final = frozenset({RESTARTED, JUMPED})

#: After this many consecutive late samples the stage's counter has restarted. At low sample rates the number of samples
#: in ``_RESTART_S`` is enough.
RESTART_AFTER: Final = 200
_RESTART_S: Final = 0.5
#: A number far ahead needs the samples of ``_AHEAD_S`` to confirm it, within these limits. The upper limit is also the
#: smallest number that confirms a restart, and the most numbers that may be skipped at any time.
MOST_CONFIRMATIONS: Final = 16
_LEAST_CONFIRMATIONS: Final = 4
_AHEAD_S: Final = 0.05
#: Late samples that fill a gap may really be late: a process that was stopped sends its backlog. Samples that come for
#: longer than this, or more than this many times the samples after the gap, are not.
_FLUSH_S: Final = 1.5
_OUTNUMBERED: Final = 4
#: A gap up to ``_GAP_S`` is accepted at once, one up to ``_MOST_GAP_S`` if the time stamps show the same gap.
_GAP_S: Final = 1.0
_MOST_GAP_S: Final = 86_400.0
#: Gap between the old count and the new one, so that the learner sees that samples are missing.
_NEW_COUNT_GAP: Final = 1000
#: Number of gaps that are kept.
_GAPS_KEPT: Final = 64
#: A first number above this is counted from 0. Doubles represent all smaller integers exactly.
_MOST_FIRST: Final = 2**52


class SequenceTracker:
    """Classifies the numbers of arriving samples and maps them to one count that never decreases.

    ``refuted`` : the number far ahead that later samples have just contradicted, -1 for none. ``left_out`` : numbers
    skipped because this process left their samples out (see `leave_out`), which are none of ``lost``.
    """

    last: Annotated[int, Entry("highest number in order in the stage's present count", low=-1)]
    received: Annotated[int, Entry("samples received", low=0)]
    lost: Annotated[int, Entry("numbers that never arrived", low=0)]
    late: Annotated[int, Entry("samples doubled, out of order, or far ahead without confirmation", low=0)]
    restarts: Annotated[int, Entry("changes to another count", low=0)]
    _offset: Annotated[int, Entry("what is added to a number of the present count")]
    _since: Annotated[int, Entry("samples in order since the count began or since its last gap", low=0)]
    _t_s: Annotated[float, Entry("time of the last one", "s", finite=False)]
    _run: Annotated[int, Entry("samples that confirm the claim of another count", low=0)]
    _run_first: Annotated[int, Entry("first number of the claim")]
    _run_last: Annotated[int, Entry("its last number")]
    _run_t_s: Annotated[float, Entry("time of its first", "s", finite=False)]
    _gaps: Annotated[deque[tuple[int, int]], Entry("skipped numbers, first and last, newest last", "", "*,2")]

    def __init__(self, dt_s: float) -> None:
        self.last = -1
        self.received = 0
        self.lost = 0
        self.late = 0
        self.restarts = 0
        self.refuted = -1
        self.left_out = self._to_skip = 0
        self._dt_s = dt_s
        self._confirmations = _between(_LEAST_CONFIRMATIONS, _AHEAD_S / dt_s, MOST_CONFIRMATIONS)
        self._restart_after = _between(MOST_CONFIRMATIONS, _RESTART_S / dt_s, RESTART_AFTER)
        self._flush_after = max(self._restart_after, round(_FLUSH_S / dt_s) + 1)
        self._offset = 0
        #: Samples in order since the count began or since its last gap, and the time of the last one, s.
        self._since = 0
        self._t_s = math.nan
        # The claim of another count: samples that confirm it, its first and last number, the time of the first, s.
        self._run = 0
        self._run_first = self._run_last = -1
        self._run_t_s = math.nan
        # Skipped numbers, the newest last. A late sample that fills such a gap is no sign of a restart.
        self._gaps = deque(maxlen=_GAPS_KEPT)

    def take(self, seq: int, t_s: float) -> str:
        """The outcome for a sample with the number ``seq`` and the stage's time ``t_s``, s: one of the names above.

        RESTARTED and JUMPED are returned for the sample that completes the confirmation. It is in order in the new
        count.
        """
        self.received += 1
        missing = seq - self.last - 1
        if missing and not (self.last < 0 <= seq or (missing > 0 and self._plausible(missing, t_s))):
            return self._out_of_count(seq, t_s)
        if self._run:
            self._refute()
        if self.last < 0 and seq > _MOST_FIRST:
            self._offset = -seq
        elif self.last >= 0 and missing:
            self._skip(seq, missing)
        self.last, self._t_s = seq, t_s
        self._since += 1
        return IN_ORDER

    def leave_out(self, count: int) -> None:
        """This process has left out ``count`` samples before those that are taken next."""
        self._to_skip += count

    def take_refuted(self) -> int:
        """Return ``refuted`` and reset it to -1."""
        refuted, self.refuted = self.refuted, -1
        return refuted

    def was_skipped(self, seq: int) -> bool:
        """Whether ``seq`` is one of the lost numbers that are still remembered."""
        return any(first <= seq <= last for first, last in self._gaps)

    def number(self, seq: int) -> int:
        """``seq``, a number of the present count, in the count that never decreases."""
        return seq + self._offset

    def _plausible(self, missing: int, t_s: float) -> bool:
        """Whether this many lost samples are plausible."""
        if missing <= MOST_CONFIRMATIONS:
            return True
        passed_s = t_s - self._t_s
        time_agrees = not math.isfinite(passed_s) or agree(missing + 1, passed_s, self._dt_s)
        return missing * self._dt_s <= _GAP_S and time_agrees

    def _out_of_count(self, seq: int, t_s: float) -> str:
        """The outcome for a sample that does not continue the count. It begins or confirms a claim."""
        ahead, step = seq > self.last, seq - self._run_last
        if self._run and 0 < step <= MOST_CONFIRMATIONS:
            self._run, self._run_last = self._run + 1, seq
        elif self._run and -MOST_CONFIRMATIONS <= step <= 0:
            # Doubled or out of order within the claim: it neither confirms nor contradicts it.
            self.late += 1
            return AHEAD if ahead else LATE
        else:
            self._refute()
            self._run, self._run_first, self._run_last, self._run_t_s = int(seq >= 0), seq, seq, t_s
        if self._run >= self._needed(seq):
            return self._change_count(seq, t_s)
        self.late += not ahead
        return AHEAD if ahead else LATE

    def _needed(self, seq: int) -> int:
        """How many samples must confirm the claim that ``seq`` belongs to.

        A count that only few samples support gives way to few.
        """
        if seq > self.last:
            return self._confirmations
        most = _OUTNUMBERED * self._since
        if any(first <= seq <= last for first, last in self._gaps):
            return min(self._flush_after, max(self._restart_after, most))
        return min(self._restart_after, max(MOST_CONFIRMATIONS, most))

    def _refute(self) -> None:
        """Drop the claim, which other samples contradict. Samples of a claim ahead do not belong to this count."""
        if self._run and self._run_first > self.last:
            self.late += self._run
            self.refuted = self._run_first
        self._run = 0

    def _change_count(self, seq: int, t_s: float) -> str:
        """Continue with the claimed count."""
        ahead = seq > self.last
        numbers = self._run_first - self.last
        outage = ahead and numbers * self._dt_s <= _MOST_GAP_S
        if outage and agree(numbers, self._run_t_s - self._t_s, self._dt_s):
            order = IN_ORDER
            self._skip(seq, seq - self.last - self._run)
        else:
            order = JUMPED if ahead else RESTARTED
            # Numbers after the gap count from the beginning of the claim, wherever the stage's counter began.
            self._offset = self.number(self.last) + _NEW_COUNT_GAP - self._run_first
            self.restarts += 1
            self._to_skip = 0
            self._gaps.clear()
        self.last, self._t_s, self._since, self._run = seq, t_s, 1, 0
        return order

    def _skip(self, seq: int, lost: int) -> None:
        """Continue the count with ``seq``; ``lost`` of the numbers in between never arrived."""
        left_out = min(lost, self._to_skip)
        self._to_skip -= left_out
        self.left_out += left_out
        self.lost += lost - left_out
        self._gaps.append((self.last + 1, seq - 1))
        if lost > MOST_CONFIRMATIONS:
            self._since = 0

    def counters(self) -> dict[str, int]:
        """Counters for the status."""
        return {"received": self.received, "lost": self.lost, "late": self.late, "restarts": self.restarts}


def _between(least: int, wanted: float, most: int) -> int:
    return max(least, min(most, round(wanted)))


# --- Times of samples: continuous across restarts of the stage's count and settings of its clock.

#: Relative error of the time between two samples from which it counts as wrong; the learner's gates use the same.
TOLERANCE: Final = 0.5
#: Consecutive samples that agree with each other but not with those before: the clock has been set.
SET_AFTER: Final = 16
#: Consecutive samples in order that the learner refuses for their number or time: its own record of them is wrong.
RESYNC_AFTER: Final = 16
#: Largest time that is accepted, s (270 years): beyond it float64 no longer separates the times of samples.
MAX_TIME_S: Final = 2.0**33
#: Verdicts of a learner that concern the number or the time of a sample.
_BY_COUNT: Final = frozenset({"timing", "out_of_order", "duplicate"})


def agree(numbers: int, passed_s: float, dt_s: float) -> bool:
    """Whether ``passed_s`` is the time of ``numbers`` samples within `TOLERANCE`; False if it is not finite."""
    expected_s = numbers * dt_s
    return abs(passed_s - expected_s) <= TOLERANCE * abs(expected_s)


class SampleClock:
    """Times of samples, s, without the steps by which the stage's clock was set.

    A clock may be set permanently (by network time, by an operator, after a change of its battery). Learning continues
    then, since the numbers of the samples tell how much time has passed. Samples whose time is wrong only for a short
    while are refused.
    """

    _times: Annotated[
        dict[str, float],
        Entry(
            "time of the last sample that continues, offset that was removed, time of the last that does not", "s",
            low=-8.0 * MAX_TIME_S, high=8.0 * MAX_TIME_S, finite=False, name="",
            among=("t_last_s", "t_offset_s", "t_other_s"),
        ),
    ]  # fmt: skip
    _counts: Annotated[
        dict[str, int],
        Entry(
            "their numbers, how many did not continue, whether a count begins, and refusals in a row", low=-1,
            name="", among=("number_last", "number_other", "others", "anew", "unheard"),
        ),
    ]  # fmt: skip
    sets: Annotated[int, Entry("how often the clock has been set", low=0)]

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self.sets = 0
        #: Whether the time of the last sample does not continue those before.
        self.in_doubt = False
        # Time of the last sample that continues, offset that was removed, time of the last one that does not; s.
        self._times = {"t_last_s": 0.0, "t_offset_s": 0.0, "t_other_s": math.nan}
        # Their numbers, how many did not continue in a row, whether the stage's count begins anew with the next time,
        # and how many samples in a row the learner has refused.
        self._counts = {"number_last": -1, "number_other": -1, "others": 0, "anew": 0, "unheard": 0}

    def take(self, number: int, t_s: float, anew: bool) -> float:
        """The time of a sample, s, for the learner; NaN if ``t_s`` is not a time.

        ``number`` : of the sample, never decreasing. ``anew`` : the stage has begun another count.
        """
        t, n = self._times, self._counts
        self.in_doubt = False
        n["anew"] |= anew
        if not abs(t_s) <= MAX_TIME_S:
            return math.nan
        passed = number - n["number_last"]
        # A state may have numbers that are further apart than that.
        expected_s = t["t_last_s"] + (passed * self._dt_s if passed * self._dt_s <= MAX_TIME_S else self._dt_s)
        begins, n["anew"] = n["anew"] and n["number_last"] >= 0, 0
        if begins:
            t["t_offset_s"] = expected_s - t_s
        t_on_s = t_s + t["t_offset_s"]
        goes_on = begins or n["number_last"] < 0 or agree(passed, t_on_s - t["t_last_s"], self._dt_s)
        if not goes_on:
            alike = agree(number - n["number_other"], t_on_s - t["t_other_s"], self._dt_s)
            n["others"] = n["others"] + 1 if alike else 1
            n["number_other"], t["t_other_s"] = number, t_on_s
            if n["others"] < SET_AFTER:
                self.in_doubt = True
                return t_on_s
            t["t_offset_s"] += expected_s - t_on_s
            t_on_s = expected_s
            self.sets += 1
        n["others"], n["number_last"], t["t_last_s"] = 0, number, t_on_s
        return t_on_s

    def must_resync(self, verdict: str) -> bool:
        """Whether the learner must resync, because it refuses samples whose number and time continue here.

        ``verdict`` : of the learner on such a sample. Its own last number or time may be wrong, from an older state or
        within another tolerance.
        """
        n = self._counts
        if verdict in _BY_COUNT:
            n["unheard"] += 1
        elif verdict != "not_finite":
            n["unheard"] = 0
        if n["unheard"] < RESYNC_AFTER:
            return False
        n["unheard"] = 0
        return True

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where the clock has no time."""
        for name in ("t_last_s", "t_offset_s"):
            if not math.isfinite(values["_times"][name]):
                raise ValueError(f"{name}: got {values['_times'][name]}, expected a finite time")
