"""Continuous sample times, across restarts of the stage's count and settings of its clock."""

from __future__ import annotations

import math
from typing import Any, Final

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

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        #: How often the clock has been set.
        self.sets = 0
        #: Whether the time of the last sample does not continue those before.
        self.in_doubt = False
        # Time of the last sample that continues, offset that was removed, time of the last one that does not; s.
        self._times: dict[str, float] = {"t_last_s": 0.0, "t_offset_s": 0.0, "t_other_s": math.nan}
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
        # Only states from older versions have numbers that are further apart than that.
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

    def state_dict(self) -> dict[str, float]:
        """The whole state, as numbers."""
        return {**self._times, **self._counts, "sets": self.sets}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``. Raises KeyError or ValueError, before anything changes, if it is damaged.

        A time beyond `MAX_TIME_S`, from an older state, is discarded.
        """
        times = {name: float(state[name]) for name in self._times}
        counts = {name: int(state[name]) for name in ("number_last", "number_other", "others")}
        counts |= {name: int(state.get(name, 0)) for name in ("anew", "unheard")}
        sets = int(state["sets"])
        if not max(abs(times["t_last_s"]), abs(times["t_offset_s"])) <= 8.0 * MAX_TIME_S:
            fresh = SampleClock(self._dt_s)
            times, counts = fresh._times, fresh._counts
        self._times, self._counts, self.sets = times, counts, sets
