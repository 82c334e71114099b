"""How busy the machine was during a soak: times are judged beside the delays of a bare paced loop.

A query wakes several threads one after the other (client, router, service, and back). On a busy machine each of them
waits about as long as the bare loop does, so that much is added to a limit. A loop that only wakes up does not notice
if other processes keep the cores busy, so their processor time is measured too. If the machine stalled or other
processes occupied it, a time says nothing about the service and is not judged.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import psutil

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


class MachineLoad:
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


# --- How much of the machine's processor others take than a soak's own processes.


#: A shorter time between two looks says nothing, s.
_LEAST_S = 0.2


class OtherLoad:
    """Asked now and then with the processor time of one's own processes so far."""

    def __init__(self) -> None:
        self._cores = psutil.cpu_count() or 1
        self._at_s, self._busy_s = time.monotonic(), _busy_s()
        self._own: dict[int, float] = {}

    def share(self, own_s: Mapping[int, float]) -> float | None:
        """Share of all cores that others had since the last call, 0 to 1; None where that was a moment ago.

        ``own_s``: by number of the process, its seconds of processor time so far (:func:`taken_s`); one that was not
        there before counts from its beginning.
        """
        now_s, busy_s = time.monotonic(), _busy_s()
        passed_s = now_s - self._at_s
        if passed_s < _LEAST_S:
            return None
        own = sum(max(0.0, taken - self._own.get(pid, 0.0)) for pid, taken in own_s.items()) if self._own else 0.0
        others_s = busy_s - self._busy_s - own
        first = not self._own
        self._at_s, self._busy_s, self._own = now_s, busy_s, dict(own_s)
        # What the processes had before the first look is not known.
        return None if first else min(1.0, max(0.0, others_s / (passed_s * self._cores)))


def processor_times_s(roots: Iterable[int]) -> dict[int, float]:
    """By number of the process, seconds of processor time so far of each root that lives and of all that it has begun.

    Of a tree each process counts, and those that it has outlived, so that it only grows; a root within the tree of
    another counts for itself only. Of one's own process those that it has outlived are not counted: they were roots.
    """
    parent, taken = {}, {}
    for process in psutil.process_iter(["ppid", "cpu_times"]):
        parent[process.pid], times = process.info["ppid"], process.info["cpu_times"]
        if times is not None:
            taken[process.pid] = float(sum(times[: 2 if process.pid == os.getpid() else 4]))
    total = {pid: 0.0 for pid in roots if pid in taken}
    for pid, seconds in taken.items():
        at = pid
        while at not in total and parent.get(at):
            at = parent[at]
        if at in total:
            total[at] += seconds
    return total


def _busy_s() -> float:
    times = psutil.cpu_times()
    # Fields beside these depend on the platform.
    fields = times._asdict()
    return float(sum(times) - sum(fields.get(name, 0.0) for name in ("idle", "iowait", "guest", "guest_nice")))
