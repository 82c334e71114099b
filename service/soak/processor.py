"""How much of the machine's processor others take than a soak's own processes."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping

import psutil

#: A shorter time between two looks says nothing, s.
_LEAST_S = 0.2


class Others:
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


def taken_s(roots: Iterable[int]) -> dict[int, float]:
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
    waiting = times.idle + getattr(times, "iowait", 0.0) + getattr(times, "guest", 0.0)
    return float(sum(times) - waiting - getattr(times, "guest_nice", 0.0))
