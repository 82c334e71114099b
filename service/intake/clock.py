"""The time of the samples as one that goes on, over a stage that counts anew and a clock that is set."""

from __future__ import annotations

import math
from typing import Any, Final

#: Relative error of the time between two samples beyond which it is wrong; that of the gates of what learns.
TOLERANCE: Final = 0.5
#: So many samples in a row that agree with each other, and not with those before, have another clock.
SET_AFTER: Final = 16
#: What learns refuses so many samples in a row that are in order here: its own count or time is wrong.
UNHEARD: Final = 16
#: No clock shows more than this, s, which is 270 years: beyond it doubles tell the times of samples no longer apart.
MOST_S: Final = 2.0**33
#: What learns refuses by the number or the time of a sample.
_BY_COUNT: Final = frozenset({"timing", "out_of_order", "duplicate"})


def agree(numbers: int, passed_s: float, dt_s: float) -> bool:
    """Whether the time that has passed, s, is that of so many samples; False where it is not finite."""
    expected_s = numbers * dt_s
    return abs(passed_s - expected_s) <= TOLERANCE * abs(expected_s)


class SampleClock:
    """Times of samples, s, with what the stage's clock was set by taken out.

    A clock that is set for good (by a network's time, an operator, a battery that was changed) must not end learning:
    the numbers of the samples go on, and say how much time has passed. A time that is wrong for some samples stays
    wrong, and they are refused.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        #: How often the clock was found to have been set.
        self.sets = 0
        #: Whether the last sample had a time that does not go on.
        self.in_doubt = False
        # Times of the last sample that goes on and of the last one that does not, and what was taken out; s.
        self._times: dict[str, float] = {"t_last_s": 0.0, "t_offset_s": 0.0, "t_other_s": math.nan}
        # Their numbers, how many of the others there were in a row, whether the stage counts anew with the next time,
        # and how many samples in a row what learns has refused.
        self._counts = {"number_last": -1, "number_other": -1, "others": 0, "anew": 0, "unheard": 0}

    def take(self, number: int, t_s: float, anew: bool) -> float:
        """The time of a sample, s, as what learns is to see it; ``number`` never goes back. NaN for what is no time.

        ``anew`` : the stage has begun another count.
        """
        t, n = self._times, self._counts
        self.in_doubt = False
        n["anew"] |= anew
        if not abs(t_s) <= MOST_S:
            return math.nan
        passed = number - n["number_last"]
        # Only numbers that were believed before they needed witnesses are further apart than any clock shows.
        expected_s = t["t_last_s"] + (passed * self._dt_s if passed * self._dt_s <= MOST_S else self._dt_s)
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

    def unheard(self, verdict: str) -> bool:
        """Whether what learns is to forget its own count and time.

        ``verdict`` : what it says of a sample whose number and time go on here. Its gates are its own, and so may be
        what it last believed: from a state of before, or within another tolerance.
        """
        n = self._counts
        if verdict in _BY_COUNT:
            n["unheard"] += 1
        elif verdict != "not_finite":
            n["unheard"] = 0
        if n["unheard"] < UNHEARD:
            return False
        n["unheard"] = 0
        return True

    def state_dict(self) -> dict[str, float]:
        """All of it, plain numbers."""
        return {**self._times, **self._counts, "sets": self.sets}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``. Raises KeyError or ValueError, before anything changes, where it is damaged.

        A time that no clock shows, of a state from before such were refused, is forgotten.
        """
        times = {name: float(state[name]) for name in self._times}
        counts = {name: int(state[name]) for name in ("number_last", "number_other", "others")}
        counts |= {name: int(state.get(name, 0)) for name in ("anew", "unheard")}
        sets = int(state["sets"])
        if not max(abs(times["t_last_s"]), abs(times["t_offset_s"])) <= 8.0 * MOST_S:
            fresh = SampleClock(self._dt_s)
            times, counts = fresh._times, fresh._counts
        self._times, self._counts, self.sets = times, counts, sets
