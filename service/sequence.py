"""Bookkeeping of sequence numbers: what is in order, what came late or twice, what never came, and restarts."""

from __future__ import annotations

from typing import Final

IN_ORDER: Final = "in_order"
LATE: Final = "late"
RESTARTED: Final = "restarted"

#: That many late samples in a row, each one after the other, are not late: the stage counts anew.
RESTART_AFTER: Final = 200
#: Gap put between the old count and the new one, so that whoever learns sees that samples are missing.
_RESTART_GAP: Final = 1000


class SequenceTracker:
    """Sorts the numbers of arriving samples and keeps one ever-growing count over restarts of the stage.

    Attributes
    ----------
    last : highest number taken in order in the stage's present count, -1 before any.
    received, lost, late, restarts : samples that came; numbers that were skipped; samples that came twice or out of
        order; how often the stage began to count anew.
    """

    def __init__(self) -> None:
        self.last = -1
        self.received = 0
        self.lost = 0
        self.late = 0
        self.restarts = 0
        self._offset = 0
        self._run = 0
        self._run_last = -1

    def take(self, seq: int) -> str:
        """IN_ORDER, LATE (twice or out of order), or RESTARTED for the sample that shows that the stage began anew."""
        self.received += 1
        if seq > self.last:
            if self.last >= 0:
                self.lost += seq - self.last - 1
            self.last = seq
            self._run = 0
            return IN_ORDER
        self.late += 1
        self._run = self._run + 1 if seq == self._run_last + 1 else 1
        self._run_last = seq
        if self._run < RESTART_AFTER:
            return LATE
        self._offset += self.last + _RESTART_GAP
        self.last = seq
        self.restarts += 1
        self._run = 0
        return RESTARTED

    def number(self, seq: int) -> int:
        """``seq`` in the count that never goes back."""
        return seq + self._offset

    def counters(self) -> dict[str, int]:
        """For the status."""
        return {"received": self.received, "lost": self.lost, "late": self.late, "restarts": self.restarts}
