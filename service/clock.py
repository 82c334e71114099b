"""The time of the samples as one that goes on, over a stage that counts anew and a clock that is set."""

from __future__ import annotations

import math
from typing import Any, Final

#: Relative error of the time between two samples beyond which it is wrong; that of the gates of what learns.
TOLERANCE: Final = 0.5
#: So many samples in a row that agree with each other, and not with those before, have another clock.
SET_AFTER: Final = 16


class SampleClock:
    """Times of samples, s, with what the stage's clock was set by taken out.

    A clock that is set for good (by a network's time, an operator, a battery that was changed) must not end learning:
    the numbers of the samples go on, and say how much time has passed. A time that is wrong for some samples stays
    wrong, and the gates refuse them.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        #: How often the clock was found to have been set.
        self.sets = 0
        # Of the last sample with a time that goes on, of the last one with another, and how many of those in a row.
        self._n: dict[str, float] = {
            "t_last_s": 0.0, "t_offset_s": 0.0, "number_last": -1,
            "t_other_s": math.nan, "number_other": -1, "others": 0,
        }  # fmt: skip

    def take(self, number: int, t_s: float, restarted: bool) -> float:
        """The time of a sample, s, as what learns is to see it; ``number`` never goes back.

        ``restarted`` : the stage has begun to count anew.
        """
        n = self._n
        if not math.isfinite(t_s):
            return t_s
        expected_s = n["t_last_s"] + (number - n["number_last"]) * self._dt_s
        if restarted:
            n["t_offset_s"] = expected_s - t_s
        t_on_s = t_s + n["t_offset_s"]
        if n["number_last"] >= 0 and self._differ(number - n["number_last"], t_on_s - n["t_last_s"]):
            agree = not self._differ(number - n["number_other"], t_on_s - n["t_other_s"])
            n["others"] = n["others"] + 1 if agree else 1
            n["number_other"], n["t_other_s"] = number, t_on_s
            if n["others"] < SET_AFTER:
                return t_on_s
            n["t_offset_s"] += expected_s - t_on_s
            t_on_s = expected_s
            self.sets += 1
        n["others"], n["number_last"], n["t_last_s"] = 0, number, t_on_s
        return t_on_s

    def _differ(self, numbers: float, passed_s: float) -> bool:
        expected_s = numbers * self._dt_s
        return not abs(passed_s - expected_s) <= TOLERANCE * abs(expected_s)

    def state_dict(self) -> dict[str, float]:
        """All of it, plain numbers."""
        return {**self._n, "sets": self.sets}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``. Raises KeyError or ValueError, before anything changes, where it is damaged."""
        numbers, sets = {name: float(state[name]) for name in self._n}, int(state["sets"])
        self._n, self.sets = numbers, sets
