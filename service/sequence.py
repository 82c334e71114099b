"""Bookkeeping of sequence numbers: what is in order, what came late or twice, what never came, and restarts."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

IN_ORDER: Final = "in_order"
LATE: Final = "late"
RESTARTED: Final = "restarted"

#: That many late samples in a row, each one after the other, are not late: the stage counts anew.
RESTART_AFTER: Final = 200
#: Gap put between the old count and the new one, so that whoever learns sees that samples are missing.
_RESTART_GAP: Final = 1000
#: Gaps that are remembered.
_GAPS_KEPT: Final = 64


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
        # Numbers that were skipped, the newest last: what comes late is no sign of a restart where it fills such a gap.
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_GAPS_KEPT)

    def take(self, seq: int) -> str:
        """IN_ORDER, LATE (twice or out of order), or RESTARTED for the sample that shows that the stage began anew."""
        self.received += 1
        if seq > self.last:
            if self.last >= 0 and seq > self.last + 1:
                self.lost += seq - self.last - 1
                self._gaps.append((self.last + 1, seq - 1))
            self.last = seq
            self._run = 0
            return IN_ORDER
        self.late += 1
        if self._gaps and any(first <= seq <= last for first, last in self._gaps):
            return LATE
        self._run = self._run + 1 if seq == self._run_last + 1 else 1
        self._run_last = seq
        if self._run < RESTART_AFTER:
            return LATE
        self._offset += self.last + _RESTART_GAP
        self.last = seq
        self.restarts += 1
        self._run = 0
        self._gaps.clear()
        return RESTARTED

    def number(self, seq: int) -> int:
        """``seq`` in the count that never goes back."""
        return seq + self._offset

    def state_dict(self) -> dict[str, Any]:
        """All of it: plain numbers, and (n, 2) gaps."""
        kept = {"offset": self._offset, "run": self._run, "run_last": self._run_last}
        gaps = np.array(self._gaps, dtype=np.int64).reshape(-1, 2)
        return {"last": self.last, **self.counters(), **kept, "gaps": gaps}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``. Raises KeyError or ValueError, before anything changes, where it is damaged."""
        s = {name: int(state[name]) for name in self.state_dict() if name != "gaps"}
        gaps = np.asarray(state["gaps"], dtype=np.int64).reshape(-1, 2).tolist()
        self._gaps = deque(((first, last) for first, last in gaps), maxlen=_GAPS_KEPT)
        self.last, self.received, self.lost, self.late = s["last"], s["received"], s["lost"], s["late"]
        self.restarts, self._offset, self._run, self._run_last = s["restarts"], s["offset"], s["run"], s["run_last"]

    def counters(self) -> dict[str, int]:
        """For the status."""
        return {"received": self.received, "lost": self.lost, "late": self.late, "restarts": self.restarts}
