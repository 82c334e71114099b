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

#: Threads that a query wakes, one after the other.
HANDOVERS: Final = 8
#: In a second in which the bare loop was later than this, s, or other processes had more than this share of all cores,
#: no time is judged. The soak itself needs about half of two cores.
STALLED_S: Final = 0.1
TAKEN_SHARE: Final = 0.45
#: Above this delay, s, or this share of other processes, commands that are asked for 60 ms ahead may come late.
BUSY_S: Final = 0.0075
BUSY_SHARE: Final = 0.25

#: One row per second: its end, s, and the value measured.
Rows = Sequence[tuple[float, float]]


class MachineLoad:
    """``bare``: largest delay of the bare loop, s; ``others``: share of all cores that other processes had, 0 to 1.

    Without any rows the machine counts as idle.
    """

    def __init__(self, bare: Rows, others: Rows = ()) -> None:
        self._rows = [([row[0] for row in rows], [row[1] for row in rows]) for rows in (bare, others)]

    def _within(self, which: int, begin_s: float, end_s: float) -> list[float]:
        """The values of the seconds that overlap with the time from ``begin_s`` to ``end_s``."""
        t_s, values = self._rows[which]
        return values[bisect_left(t_s, begin_s) : bisect_left(t_s, end_s + 1.0)]

    def stalled(self, begin_s: float, end_s: float) -> bool:
        """Whether the machine stalled, or other processes occupied it, in that time."""
        late_s, others = (max(self._within(which, begin_s, end_s), default=0.0) for which in (0, 1))
        return late_s > STALLED_S or others > TAKEN_SHARE

    def taken(self, begin_s: float, end_s: float) -> bool:
        """Whether other processes had so much that a computation may have had to wait."""
        return max(self._within(1, begin_s, end_s), default=0.0) > BUSY_SHARE

    def allowed_s(self, begin_s: float, end_s: float) -> float:
        """How much longer a query may take than on an idle machine, s."""
        return HANDOVERS * max(self._within(0, begin_s, end_s), default=0.0)

    def busy_s(self, begin_s: float, end_s: float) -> float:
        """How many seconds of that time the machine was too busy for voltages to come in time."""
        late = sum(late_s > BUSY_S for late_s in self._within(0, begin_s, end_s))
        taken = sum(share > BUSY_SHARE for share in self._within(1, begin_s, end_s))
        return float(max(late, taken))


# --- Load by other processes

#: A shorter time between two calls gives no result, s.
_LEAST_S = 0.2


class OtherLoad:
    """Processor time that other processes take, from one call of `share` to the next."""

    def __init__(self) -> None:
        self._cores = psutil.cpu_count() or 1
        self._at_s, self._busy_s = time.monotonic(), _busy_s()
        self._own: dict[int, float] = {}

    def share(self, own_s: Mapping[int, float]) -> float | None:
        """Share of all cores that other processes had since the last call, 0 to 1; None if that was less than 0.2 s
        ago.

        ``own_s``: by process id, the processor time so far of the soak's own processes, s (`processor_times_s`). A
        process that was not in the last call counts from its start.
        """
        now_s, busy_s = time.monotonic(), _busy_s()
        passed_s = now_s - self._at_s
        if passed_s < _LEAST_S:
            return None
        own = sum(max(0.0, taken - self._own.get(pid, 0.0)) for pid, taken in own_s.items()) if self._own else 0.0
        others_s = busy_s - self._busy_s - own
        first = not self._own
        self._at_s, self._busy_s, self._own = now_s, busy_s, dict(own_s)
        # Their time before the first call is unknown.
        return None if first else min(1.0, max(0.0, others_s / (passed_s * self._cores)))


def processor_times_s(roots: Iterable[int]) -> dict[int, float]:
    """By process id, the processor time so far, s, of each root that lives, with all its descendants.

    Includes descendants that have ended, so that the value only grows. A root below another root counts for itself
    only. For the calling process, children that have ended are not counted: they were roots.
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
