"""Which fault of a plan is next, and when it really comes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from service.soak.plan import Planned, SoakPlan

#: The calm between two faults has room for so much, s.
LATE_S: Final = 0.5


class Schedule:
    """The faults of ``plan`` one after the other, each with its time to recover, whatever those before it took.

    One that takes a process to begin begins when the machine has made that process; one that may not happen yet, as
    ``possible`` says, waits; those behind it come as much later. What then has no time left to recover is left out.
    """

    def __init__(self, plan: SoakPlan, possible: Callable[[Planned], bool]) -> None:
        self._plan, self._possible = plan, possible
        self._waiting = deque(enumerate(plan.faults))
        self._delay_s = 0.0
        self._notes: list[str] = []

    def due(self, now_s: float) -> tuple[int, Planned] | None:
        """The fault that is to begin at ``now_s``, and its number in the plan; None where there is none."""
        while self._waiting:
            index, fault = self._waiting[0]
            if now_s < fault.at_s + self._delay_s:
                return None
            if fault.window_s[1] + self._delay_s > self._plan.duration_s:
                self._notes.append(_note(fault, "no time to recover"))
            elif self._possible(fault):
                self._waiting.popleft()
                return index, fault
            else:
                self._delay_s = now_s - fault.at_s
                return None
            self._waiting.popleft()
        return None

    def over(self, index: int, end_s: float) -> None:
        """The fault of that number has ended at ``end_s``."""
        late_s = end_s - (self._plan.faults[index].end_s + self._delay_s)
        if late_s > LATE_S:
            self._delay_s += late_s

    def left_out(self) -> list[str]:
        """At the end of a run: which faults did not happen, and why."""
        # Such as one that waited to the end for the standby to be synced, and those behind it.
        return self._notes + [_note(fault, "it did not come to it") for _, fault in self._waiting]


def _note(fault: Planned, why: str) -> str:
    return f"{fault.kind} at {fault.at_s:.0f} s: left out, {why}"
