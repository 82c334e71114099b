"""Long evaluations: beside the short ones, a slice each in turns, and refused where they would take too long.

Short queries are answered at once, by the thread that receives them. A long one is handed to a thread of its source:
the session that asks, where the query tells it, else one that all others share. One of these threads runs at a time.
After each slice (`service.answers.slices`) it waits while a short query is being answered, and gives the turn to the
next source. So a source gets its share however much others ask, and each of them delays a shorter query by no more than
its length.

Nothing waits without bound. Where an answer would take longer than ``busy_after_s``, the query is refused with the time
after which it will be accepted. What it asked for is kept free until then, so that those who ask again at once do not
take it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from dehyst.service.answers.slices import Pace, StoppedError
from dehyst.service.protocol.errors import BusyError, ServiceError

#: Most points of a query that is answered at once: a quarter of a millisecond with a window of 500.
SHORT: Final = 128
#: Most sources at a time, and most points that may wait together: they take memory.
_SOURCES: Final = 16
_POINTS: Final = 2**20
#: Time of a point before any was measured, s, and the weight of a new measurement.
_POINT_S, _NEW_SHARE = 2e-6, 0.05
#: Longest time for which a slice waits for short queries, s, and between two looks.
_YIELD_S, _LOOK_S = 0.002, 0.0001
#: Shortest time after which a refused query is asked for again, and how long after it its place is kept, s.
_RETRY_S, _KEPT_S = 0.02, 0.25
#: Niceness of the threads: any other thread that wakes runs before them.
_NICENESS: Final = 10


#: Sends an answer: after the turn has passed on, because a receiver that does not read makes it wait.
Send = Callable[[], None]


@dataclass(slots=True)
class _Job:
    """``points`` : left to do. ``work`` : makes the answer, calling its pace. ``refuse`` : answers with an error."""

    points: int
    work: Callable[[Pace], Send]
    refuse: Callable[[BaseException], None]


@dataclass(slots=True)
class _Source:
    name: str
    jobs: deque[_Job] = field(default_factory=deque)
    #: Released when it has the turn.
    turn: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    def points(self) -> int:
        return sum(job.points for job in self.jobs)


class LongQueries:
    """Runs the long queries of all axes of a process.

    Parameters
    ----------
    busy_after_s : longest time that an answer may take beside others, s; a query that meets no other is always taken.

    Attributes
    ----------
    refused : count of refused queries.
    """

    def __init__(self, busy_after_s: float = 0.5) -> None:
        self.busy_after_s = busy_after_s
        self.refused = 0
        self._lock = threading.Lock()
        self._sources: dict[str, _Source] = {}
        #: Those that have a turn to come; the first has it now.
        self._turns: deque[_Source] = deque()
        #: What refused sources will ask for again, in the order of refusal: points, and until when it is kept.
        self._promised: dict[str, tuple[int, float]] = {}
        self._threads: set[threading.Thread] = set()
        self._short = 0
        self._point_s = _POINT_S
        self._closed = False

    @property
    def waiting_points(self) -> int:
        """Points that are not answered yet."""
        with self._lock:
            return sum(source.points() for source in self._sources.values())

    # ---- short queries

    def short_begins(self) -> None:
        """A short query is being answered: the long ones pause. Any number at a time."""
        with self._lock:
            self._short += 1

    def short_ends(self) -> None:
        """It has been answered."""
        with self._lock:
            self._short -= 1

    # ---- long queries

    def offer(
        self, source: str, points: int, work: Callable[[Pace], Send], refuse: Callable[[BaseException], None]
    ) -> None:
        """Let ``work`` answer a query of ``points`` points. Raises BusyError if it would take too long.

        ``source`` : who asks; "" where it is not known. ``work`` runs in another thread, with the pace to keep, and
        never raises but `StoppedError`. ``refuse`` answers a query that was taken and is not finished at `close`.
        """
        with self._lock:
            if self._closed:
                raise ServiceError("the service is stopping: ask again when it has started")
            wait_s = self._too_long_s(source, points, time.monotonic())
            if wait_s > 0.0:
                self.refused += 1
                raise BusyError(wait_s)
            self._promised.pop(source, None)
            held = self._sources.get(source)
            if held is not None:
                held.jobs.append(_Job(points, work, refuse))
                return
            self._sources[source] = held = _Source(source, deque([_Job(points, work, refuse)]))
            self._queue(held)
            thread = threading.Thread(target=self._run, args=(held,), name="long-queries", daemon=True)
            self._threads.add(thread)
            thread.start()

    def close(self) -> None:
        """Refuse what waits, end what runs after its slice, and the threads."""
        with self._lock:
            self._closed = True
            threads = list(self._threads)
        for thread in threads:
            thread.join()

    # ---- inside

    def _too_long_s(self, source: str, points: int, now_s: float) -> float:
        """Time, s, after which a query of ``points`` points can be taken; 0 for now. Keeps it free until then."""
        others = {name: other.points() for name, other in self._sources.items() if name != source}
        promised = 0
        for name, (kept, until_s) in list(self._promised.items()):
            if until_s < now_s:
                del self._promised[name]
            elif name == source:
                break  # those after it were refused later
            else:
                others[name] = others.get(name, 0) + kept
                promised += kept
        held = self._sources.get(source)
        own = points + (0 if held is None else held.points())
        if own == points and not others:
            return 0.0
        # In turns the others do as much as this one until it is done.
        takes_s = self._point_s * (own + sum(min(other, own) for other in others.values()))
        waiting = own + sum(others.values())
        full = waiting > _POINTS or (held is None and len(others) >= _SOURCES)
        if takes_s <= self.busy_after_s and not full:
            return 0.0
        wait_s = max(_RETRY_S, takes_s - self.busy_after_s)
        if full:
            wait_s = max(wait_s, self._point_s * max(waiting - _POINTS, points))
        if source in self._promised:
            points = max(points, self._promised[source][0])
        self._promised[source] = (points, now_s + wait_s + _KEPT_S)
        return wait_s

    def _run(self, source: _Source) -> None:
        """The thread of a source, until it has no more jobs."""
        _be_nice()
        while True:
            source.turn.acquire()
            send = self._answered(source.jobs[0])
            with self._lock:
                source.jobs.popleft()
                self._turns.popleft()
                self._give_turn()
            send()
            with self._lock:
                if not source.jobs:
                    del self._sources[source.name]
                    self._threads.discard(threading.current_thread())
                    return
                self._queue(source)

    def _answered(self, job: _Job) -> Send:
        """How to send the answer to a job, which is made here."""
        started_s = time.perf_counter()

        def pace(done: int) -> None:
            nonlocal started_s
            job.points = max(0, job.points - done)
            taken_s = (time.perf_counter() - started_s) / max(1, done)
            self._point_s += _NEW_SHARE * (taken_s - self._point_s)
            self._pause()
            started_s = time.perf_counter()

        with contextlib.suppress(StoppedError):
            if not self._closed:
                return job.work(pace)
        return lambda: job.refuse(ServiceError("the service has stopped: ask again when another serves"))

    def _pause(self) -> None:
        """Wait while a short query is answered, then until the turn comes round. Raises StoppedError at the end."""
        until_s = time.monotonic() + _YIELD_S
        while self._short and time.monotonic() < until_s:
            time.sleep(_LOOK_S)
        if len(self._turns) > 1 and not self._closed:
            with self._lock:
                source = self._turns.popleft()
                self._turns.append(source)
                self._give_turn()
            source.turn.acquire()
        if self._closed:
            raise StoppedError

    def _queue(self, source: _Source) -> None:
        """A turn for ``source``, behind the others; with the lock held."""
        self._turns.append(source)
        if len(self._turns) == 1:
            self._give_turn()

    def _give_turn(self) -> None:
        """The first in the queue goes on; with the lock held."""
        if self._turns:
            self._turns[0].turn.release()


def _be_nice() -> None:
    """Lower the priority of the calling thread, where the system has one for threads."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
