"""What a soak may ask of the machine that it runs on: times are judged beside what a bare loop had in the same seconds.

A query wakes some threads one after the other (client, router, service, and back). On a machine that is busy with other
things each of them waits about as long as the bare loop does, and so much is allowed on top of a limit. A loop that
only wakes up sees nothing of a processor that others hold for long, so what others than the soak's own processes took
of it is looked at too. Where the machine stood still or was taken, a time says nothing about the service.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import Final

#: Threads that a query wakes on its way.
HANDOVERS: Final = 8
#: The soak itself wants about half of two cores: who is left less than that waits, though others have not all.
#: A second in which the bare loop was later than this, s, or others had more than this share of all cores, is none
#: that a time can be judged by.
STALLED_S: Final = 0.1
TAKEN_SHARE: Final = 0.45
#: Later than this, s, or more than this share for others, and commands that are asked for 60 ms ahead need not come in
#: time.
BUSY_S: Final = 0.0075
BUSY_SHARE: Final = 0.25

#: By second: its end, s, and what was measured.
Rows = Sequence[tuple[float, float]]


class Machine:
    """``bare``: the most that the bare loop was late, s; ``others``: their share of all cores, 0 to 1.

    Where nothing was measured it is a machine that is free.
    """

    def __init__(self, bare: Rows, others: Rows = ()) -> None:
        self._rows = [([row[0] for row in rows], [row[1] for row in rows]) for rows in (bare, others)]

    def _within(self, which: int, begin_s: float, end_s: float) -> list[float]:
        """Of the seconds that overlap with the time from ``begin_s`` to ``end_s``."""
        t_s, values = self._rows[which]
        return values[bisect_left(t_s, begin_s) : bisect_left(t_s, end_s + 1.0)]

    def stalled(self, begin_s: float, end_s: float) -> bool:
        """Whether the machine stood still, or was taken by others, in that time."""
        late_s, others = (max(self._within(which, begin_s, end_s), default=0.0) for which in (0, 1))
        return late_s > STALLED_S or others > TAKEN_SHARE

    def taken(self, begin_s: float, end_s: float) -> bool:
        """Whether others had so much of it that what computes may have had to wait."""
        return max(self._within(1, begin_s, end_s), default=0.0) > BUSY_SHARE

    def allowed_s(self, begin_s: float, end_s: float) -> float:
        """What a query may take longer than on a machine that is free, s."""
        return HANDOVERS * max(self._within(0, begin_s, end_s), default=0.0)

    def busy_s(self, begin_s: float, end_s: float) -> float:
        """How much of that time the machine was too busy for a voltage to come in time, s."""
        late = sum(late_s > BUSY_S for late_s in self._within(0, begin_s, end_s))
        taken = sum(share > BUSY_SHARE for share in self._within(1, begin_s, end_s))
        return float(max(late, taken))
