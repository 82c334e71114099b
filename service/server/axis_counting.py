"""What an axis makes of the numbers and times of its samples: what is refused by them, and counts that begin anew.

What learns sees the samples alone that are in order and whose time goes on, with numbers that never go back. All of it
is for the thread that handles samples.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from adaptive.online.gates import DUPLICATE, OUT_OF_ORDER, TIMING
from adaptive.types import Sample
from service.answers.memory_tracking import MemoryTracker
from service.intake.clock import SampleClock
from service.intake.sequence import AHEAD, RESTARTED, Seldom
from service.server.axis_learning import AxisLearning


class AxisCounting(AxisLearning):
    """Numbers and times of an axis; see :class:`service.server.axis.Axis`, which is the only one to be of this
    class."""

    clock: SampleClock
    tracker: MemoryTracker
    _gates: dict[str, int]
    _seldom: Seldom

    if TYPE_CHECKING:

        @property
        def learning(self) -> bool: ...

    def _counted(self, verdict: str) -> str:
        self._gates[verdict] = self._gates.get(verdict, 0) + 1
        return verdict

    def _refused(self, order: str, seq: int) -> str:
        """What a sample is called that is refused by its number."""
        if order == AHEAD:
            return AHEAD
        if not self.learning:
            return "not_learning"
        return DUPLICATE if seq == self.sequence.last else OUT_OF_ORDER

    def _taught(self, sample: Sample) -> str:
        """What the learner says of a sample in order; one whose time does not go on is refused before."""
        if self.clock.in_doubt and self.learning:
            return TIMING
        verdict = self._learn(sample)
        if self.clock.unheard(verdict) and self.learner is not None:
            detail = f"it refused samples in order as {verdict}: its own count and time begin anew"
            self._note_seldom("learner_resynced", detail)
            self.learner.resync()
        return verdict

    def _time(self, number: int, t_s: float, anew: bool) -> float:
        """The time of a sample for what learns."""
        sets = self.clock.sets
        t_going_on_s = self.clock.take(number, t_s, anew)
        if self.clock.sets != sets:
            detail = "the stage's clock has been set; time goes on by the numbers of the samples"
            self._note_seldom("stage_clock_set", detail)
        return t_going_on_s

    def _begin_count(self, order: str, seq: int, before: int) -> None:
        """The stage counts anew, from ``before`` to ``seq``."""
        self.tracker.forget()
        if order == RESTARTED:
            # Snapshots of the old count can no longer be named.
            self._ring = (replace(self._ring[-1], seq=-1),)
            self._note_seldom("stage_restarted", f"the stage's numbers went back to {seq}; the model is kept")
        else:
            detail = (
                f"the stage's numbers went from {before} to {seq}, which its times do not explain; the model is kept"
            )
            self._note_seldom("numbers_jumped", detail)

    def _tell_refuted(self, before: int) -> None:
        """A sample after ``before`` was refused for its number, and the next ones have not gone on from there."""
        detail = f"number {self.sequence.refuted} after {before} was refused: the next ones did not go on from there"
        self.sequence.refuted = -1
        self._note_seldom("numbers_ahead", detail)

    def _note_seldom(self, event: str, detail: str) -> None:
        if self._seldom.tells(event, self.sequence.received):
            self.note(event, detail)
