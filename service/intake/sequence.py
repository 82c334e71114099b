"""Bookkeeping of sequence numbers: what is in order, late, far ahead, what never came, and counts that begin anew.

The count of the stage is believed as far as samples bear it out. Samples whose numbers go on with the count are in
order. All others make a claim of another count, and a claim needs witnesses: samples in a row that go on from it. Few
are enough ahead of the count, where nothing else explains them; more are needed behind it, where samples may be late.
So one number, however absurd, changes nothing, and there is no count from which good samples do not lead back.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final

import numpy as np

from service.intake.clock import agree

IN_ORDER: Final = "in_order"
LATE: Final = "late"
#: Its number is further ahead than samples get lost. The name of the refusal too.
AHEAD: Final = "ahead"
#: The stage counts anew, from a lower number ...
RESTARTED: Final = "restarted"
#: ... or from a higher one, which no time explains.
JUMPED: Final = "jumped"
#: Outcomes of samples that are not to be learnt, and of those with which another count begins.
REFUSED: Final = frozenset({LATE, AHEAD})
ANEW: Final = frozenset({RESTARTED, JUMPED})

#: So many late samples, one after the other, are not late: the stage counts anew. At low sample rates those of
#: ``_RESTART_S`` are enough.
RESTART_AFTER: Final = 200
_RESTART_S: Final = 0.5
#: So many samples bear out a number far ahead: those of ``_AHEAD_S``, within these limits. The upper one is also the
#: least that shows a restart, and the most that a count may skip at any time.
WITNESSES: Final = 16
_FEWEST: Final = 4
_AHEAD_S: Final = 0.05
#: Late samples that fill a gap may be late indeed: a process that was stopped passes on what it had kept. After more
#: than this, or than this many times the samples that came behind the gap, they are not.
_FLUSH_S: Final = 1.5
_OUTNUMBERED: Final = 4
#: A gap of up to this long is taken at once; of up to the other, where the time stamps tell of the same gap.
_GAP_S: Final = 1.0
_MOST_GAP_S: Final = 86_400.0
#: Gap put between the old count and the new one, so that whoever learns sees that samples are missing.
_ANEW_GAP: Final = 1000
#: Gaps that are remembered.
_GAPS_KEPT: Final = 64
#: A first number beyond this is counted from 0: doubles tell all numbers below it apart.
_MOST_FIRST: Final = 2**52


class SequenceTracker:
    """Sorts the numbers of arriving samples and keeps one ever-growing count over all that the stage's does.

    Attributes
    ----------
    last : highest number taken in order in the stage's present count, -1 before any.
    received, lost, late, restarts : samples that came; numbers that never came; samples that came twice, out of order
        or far ahead with nothing to bear them out; how often another count of the stage began.
    refuted : number far ahead that other samples have just spoken against, -1 for none.
    """

    def __init__(self, dt_s: float) -> None:
        self.last = -1
        self.received = 0
        self.lost = 0
        self.late = 0
        self.restarts = 0
        self.refuted = -1
        self._dt_s = dt_s
        self._witnesses = _between(_FEWEST, _AHEAD_S / dt_s, WITNESSES)
        self._restart_after = _between(WITNESSES, _RESTART_S / dt_s, RESTART_AFTER)
        self._flush_after = max(self._restart_after, round(_FLUSH_S / dt_s) + 1)
        self._offset = 0
        #: Samples in order since the count began or had a gap, and the time of the last one, s.
        self._since = 0
        self._t_s = math.nan
        # The claim of another count: samples that bear it out, its first and last number, the time of the first, s.
        self._run = 0
        self._run_first = self._run_last = -1
        self._run_t_s = math.nan
        # Numbers that were skipped, the newest last: what comes late is no sign of a restart where it fills such a gap.
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_GAPS_KEPT)

    def take(self, seq: int, t_s: float) -> str:
        """What a sample with the number ``seq`` and the stage's time ``t_s``, s, is: one of the outcomes above.

        RESTARTED and JUMPED are told of the sample with which the other count is believed; it is in order in that.
        """
        self.received += 1
        missing = seq - self.last - 1
        if missing and not (self.last < 0 <= seq or (missing > 0 and self._plausible(missing, t_s))):
            return self._doubt(seq, t_s)
        if self._run:
            self._refute()
        if self.last < 0 and seq > _MOST_FIRST:
            self._offset = -seq
        elif self.last >= 0 and missing:
            self._skip(seq, missing)
        self.last, self._t_s = seq, t_s
        self._since += 1
        return IN_ORDER

    def take_refuted(self) -> int:
        """``refuted``, which is then -1."""
        refuted, self.refuted = self.refuted, -1
        return refuted

    def number(self, seq: int) -> int:
        """``seq``, in order in the present count, in the count that never goes back."""
        return seq + self._offset

    def _plausible(self, missing: int, t_s: float) -> bool:
        """Whether that many samples may just have been lost."""
        if missing <= WITNESSES:
            return True
        passed_s = t_s - self._t_s
        told = not math.isfinite(passed_s) or agree(missing + 1, passed_s, self._dt_s)
        return missing * self._dt_s <= _GAP_S and told

    def _doubt(self, seq: int, t_s: float) -> str:
        """A sample that does not go on with the count: what it is by the claim that it makes or bears out."""
        ahead, step = seq > self.last, seq - self._run_last
        if self._run and 0 < step <= WITNESSES:
            self._run, self._run_last = self._run + 1, seq
        elif self._run and -WITNESSES <= step <= 0:
            # Twice or out of order within the claim: it neither bears it out nor speaks against it.
            self.late += 1
            return AHEAD if ahead else LATE
        else:
            self._refute()
            self._run, self._run_first, self._run_last, self._run_t_s = int(seq >= 0), seq, seq, t_s
        if self._run >= self._needed(seq):
            return self._believe(seq, t_s)
        self.late += not ahead
        return AHEAD if ahead else LATE

    def _needed(self, seq: int) -> int:
        """How many samples must bear out the claim that ``seq`` is of.

        A count that few samples bear out themselves gives way to few.
        """
        if seq > self.last:
            return self._witnesses
        most = _OUTNUMBERED * self._since
        if any(first <= seq <= last for first, last in self._gaps):
            return min(self._flush_after, max(self._restart_after, most))
        return min(self._restart_after, max(WITNESSES, most))

    def _refute(self) -> None:
        """Other samples speak against the claim: if it was one ahead, its samples were none of this count."""
        if self._run and self._run_first > self.last:
            self.late += self._run
            self.refuted = self._run_first
        self._run = 0

    def _believe(self, seq: int, t_s: float) -> str:
        """The samples of the claim are in order from here on."""
        ahead = seq > self.last
        numbers = self._run_first - self.last
        outage = ahead and numbers * self._dt_s <= _MOST_GAP_S
        if outage and agree(numbers, self._run_t_s - self._t_s, self._dt_s):
            order = IN_ORDER
            self._skip(seq, seq - self.last - self._run)
        else:
            order = JUMPED if ahead else RESTARTED
            # The numbers behind the gap are those since the claim began, wherever the stage has begun to count.
            self._offset = self.number(self.last) + _ANEW_GAP - self._run_first
            self.restarts += 1
            self._gaps.clear()
        self.last, self._t_s, self._since, self._run = seq, t_s, 1, 0
        return order

    def _skip(self, seq: int, lost: int) -> None:
        """The count goes on with ``seq``: of the numbers in between so many never came."""
        self.lost += lost
        self._gaps.append((self.last + 1, seq - 1))
        if lost > WITNESSES:
            self._since = 0

    def state_dict(self) -> dict[str, Any]:
        """All of it: plain numbers, and (n, 2) gaps."""
        kept = {"last": self.last, **self.counters(), "offset": self._offset, "since": self._since, "t_s": self._t_s}
        kept |= {"run": self._run, "run_first": self._run_first, "run_last": self._run_last, "run_t_s": self._run_t_s}
        return {**kept, "gaps": np.array(self._gaps, dtype=np.int64).reshape(-1, 2)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from ``state_dict``. Raises KeyError or ValueError, before anything changes, where it is damaged.

        States of before a claim needed witnesses lack some entries: their count is believed as one just begun.
        """
        names = ("last", "received", "lost", "late", "restarts", "offset", "run", "run_last")
        s = {name: int(state[name]) for name in names}
        run_first, since = int(state.get("run_first", s["run_last"] - s["run"] + 1)), int(state.get("since", 0))
        t_s, run_t_s = (float(state.get(name, math.nan)) for name in ("t_s", "run_t_s"))
        gaps = np.asarray(state["gaps"], dtype=np.int64).reshape(-1, 2).tolist()
        self._gaps = deque(((first, last) for first, last in gaps), maxlen=_GAPS_KEPT)
        self.last, self.received, self.lost, self.late = s["last"], s["received"], s["lost"], s["late"]
        self.restarts, self._offset, self._run, self._run_last = s["restarts"], s["offset"], s["run"], s["run_last"]
        self._run_first, self._since, self._t_s, self._run_t_s = run_first, since, t_s, run_t_s

    def counters(self) -> dict[str, int]:
        """For the status."""
        return {"received": self.received, "lost": self.lost, "late": self.late, "restarts": self.restarts}


def _between(least: int, wanted: float, most: int) -> int:
    return max(least, min(most, round(wanted)))
