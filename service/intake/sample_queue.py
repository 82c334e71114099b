"""The bounded queue between the wire and the thread of an axis: samples, and jobs that run between two batches.

Urgent jobs, which are the commands of operators, have a lane of their own in front of the samples that wait. `Thinner`
leaves samples out where the queue fills faster than the learner empties it.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from dehyst.adaptive.types import BoolArray
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.samples import SampleBatch, joined

T = TypeVar("T")

#: Time to wait after the first message for others to handle with it, s. Waking the thread costs as much as learning
#: from two samples, and fewer wake-ups disturb fewer queries.
GATHER_S: Final = 0.005
#: Samples that are handled together at most unless one message holds more: a command waits for no more than these.
MOST_TOGETHER: Final = 500
#: Time, s, that a job which runs already may take. What it does takes far less.
_LONGEST_JOB_S: Final = 60.0


class Arrived(NamedTuple):
    """Samples of one or more messages, the time of arrival of the last one by ``time.monotonic``, s, and how many
    samples were left out before them."""

    batch: SampleBatch
    at_s: float
    left_out: int = 0


class Job(NamedTuple):
    """Work for the thread of the axis, and where its result goes."""

    work: Callable[[], Any]
    done: Future[Any]

    def run(self) -> None:
        """Do the work and hand over what it returns or raises."""
        if not self.done.set_running_or_notify_cancel():
            return
        try:
            self.done.set_result(self.work())
        except Exception as error:
            self.done.set_exception(error)
            # The exception refers to this frame: a state of megabytes that was refused would wait for the collector.
            del self


class SampleQueue:
    """Samples and jobs of one axis in order of arrival. Any thread puts; the thread of the axis takes.

    Parameters
    ----------
    name : of the axis, for messages. capacity : samples that may wait.

    Attributes
    ----------
    capacity : samples that may wait.
    waiting : samples that wait or are being handled. dropped, malformed : samples refused for lack of space, messages
    that could not be decoded.
    handled_at_s : time of arrival, by ``time.monotonic``, of the last sample that was handled; of the first one until
    it has been; None before any. A learner that is behind does not make it newer.
    """

    def __init__(self, name: str, capacity: int) -> None:
        self.waiting = 0
        self.dropped = 0
        self.malformed = 0
        self.handled_at_s: float | None = None
        self._name = name
        self.capacity = capacity
        self._items: deque[Arrived | Job] = deque()
        self._urgent: deque[Job] = deque()
        self._changed = threading.Condition()
        self._taker: threading.Thread | None = None
        self._closing = False
        self._until_s = math.inf
        #: Samples left out since the last that were queued.
        self._left_out = 0

    # ---- putting, from any thread

    def put(self, batch: SampleBatch) -> bool:
        """Queue samples; False if they were dropped because too many wait or the queue is closed."""
        at_s = time.monotonic()
        with self._changed:
            if self.handled_at_s is None:
                self.handled_at_s = at_s
            if self._closing or self.waiting + len(batch) > self.capacity:
                self.dropped += len(batch)
                self._left_out += len(batch)
                return False
            self._items.append(Arrived(batch, at_s, self._left_out))
            self._left_out = 0
            self.waiting += len(batch)
            self._changed.notify()
        return True

    def leave_out(self, count: int) -> None:
        """``count`` samples that came are not queued: their numbers are missing in those that come next."""
        with self._changed:
            self._left_out += count

    def count_malformed(self) -> int:
        """Count a message that could not be decoded; returns how many there were."""
        self.malformed += 1
        return self.malformed

    def call(self, work: Callable[[], T], timeout_s: float = 2.0, urgent: bool = False) -> T:
        """Run ``work`` in the thread of the axis; what it returns or raises.

        ``urgent`` : before the samples that wait; else after those that have come. Not from that thread itself.
        Raises ServiceError if the thread does not run, or did not begin the work within ``timeout_s``; the work is then
        not done later either.
        """
        done: Future[T] = Future()
        with self._changed:
            if self._closing or self._taker is None or not self._taker.is_alive():
                raise ServiceError(f"axis {self._name}: no samples are handled; the service begins or ends")
            (self._urgent if urgent else self._items).append(Job(work, done))
            self._changed.notify()
        try:
            return done.result(timeout_s)
        except FutureTimeout:
            if done.done():  # the work itself raised it
                raise
            if not done.cancel():  # it has begun: say how it ends
                return done.result(_LONGEST_JOB_S)
            raise ServiceError(
                f"axis {self._name}: the learner did not get to it within {timeout_s:g} s; it was not applied"
            ) from None
        finally:
            # An exception in it refers to this frame: without this, both would wait for the garbage collector.
            del done

    def age_s(self, now_s: float) -> float | None:
        """Time from the arrival of the last sample handled to ``now_s`` (``time.monotonic``), s; None: none came."""
        at_s = self.handled_at_s
        return None if at_s is None else max(0.0, now_s - at_s)

    def close(self, drain_s: float = math.inf) -> None:
        """Take no more; what is queued is still handed out for ``drain_s``."""
        with self._changed:
            self._closing = True
            self._until_s = time.monotonic() + drain_s
            self._changed.notify()

    def leave(self) -> list[SampleBatch]:
        """The samples that were not handed out, which count as dropped; the jobs among them are refused."""
        with self._changed:
            items = [*self._urgent, *self._items]
            self._urgent.clear()
            self._items.clear()
        for item in items:
            if isinstance(item, Job):
                item.done.cancel()
        left = [item.batch for item in items if isinstance(item, Arrived)]
        self.dropped += sum(map(len, left))
        self.waiting -= sum(map(len, left))
        return left

    # ---- taking, from the thread of the axis

    def serve(self, taker: threading.Thread) -> None:
        """``taker`` takes from now on."""
        self._taker = taker

    def take(self) -> Arrived | Job | None:
        """Wait for the next job, urgent ones first, or for samples as one batch. None: closed and empty.

        A batch ends before the next job, and holds `MOST_TOGETHER` samples at most unless one message holds more.
        """
        with self._changed:
            while not self._items and not self._urgent and not self._closing:
                self._changed.wait()
            if self._urgent:
                return self._urgent.popleft()
            if not self._items or time.monotonic() > self._until_s:
                return None
            first = self._items[0]
            if isinstance(first, Job):
                self._items.popleft()
                return first
            behind = self._closing or self.waiting >= MOST_TOGETHER
        if not behind:
            time.sleep(GATHER_S)
        batches: list[SampleBatch] = []
        at_s, count, left_out = 0.0, 0, 0
        with self._changed:
            if self._urgent:
                return self._urgent.popleft()
            while self._items and isinstance(self._items[0], Arrived):
                arrived = self._items[0]
                count += len(arrived.batch)
                if batches and count > MOST_TOGETHER:
                    break
                self._items.popleft()
                batches.append(arrived.batch)
                at_s = arrived.at_s
                left_out += arrived.left_out
        return Arrived(batches[0] if len(batches) == 1 else joined(batches), at_s, left_out)

    def finish(self, arrived: Arrived, handled: bool) -> None:
        """The samples of `take` no longer wait. ``handled`` : without an exception."""
        if handled:
            self.handled_at_s = arrived.at_s
        with self._changed:
            self.waiting -= len(arrived.batch)


# --- Thins samples by a stated factor where a stage sends more than the learner can handle.
#
# Whole stretches are handled and whole ones are left out: single samples left out everywhere would leave the smoother
# nothing to work with. After each gap the smoother begins anew and the hysteresis memory has to be found again, so the
# stretches are as long as the age of what is learnt and the queue allow (docs/measurements/learner.md).

#: Longest and shortest stretch, s, and its fewest samples; most time left out between two, s; most of the queue that
#: one fills.
_LONGEST_S, _SHORTEST_S, _LEAST_SAMPLES = 0.4, 0.05, 100
_LEFT_OUT_S, _OF_QUEUE = 1.0, 0.2
#: Shares of the queue above which the factor is raised, and below which it may be lowered: a stretch fills less.
_HIGH, _LOW = 0.5, 0.25
#: Share of the queue above which the factor is raised sooner, and after which time, s: the next stretch needs room.
_FULL, _SOON_S = 0.7, 0.1
#: Time for which the queue fills before the factor is raised, s; calm time before it is lowered, s, and the longest
#: one: each vain trial doubles it.
_RAISE_S, _CALM_S, _LONGEST_CALM_S = 0.5, 10.0, 600.0
_MOST: Final = 1000
#: Share by which the learner is to be faster than the samples that are left.
_RESERVE: Final = 1.1


class Thinner:
    """Chooses the samples of one axis that are handled. One thread calls it.

    Parameters
    ----------
    dt_s : sample time, s. capacity : samples that may wait for the learner.

    Attributes
    ----------
    factor : one of so many stretches is handled; 1 for all. thinned : samples left out since the start.
    """

    def __init__(self, dt_s: float, capacity: int) -> None:
        self.factor = 1
        self.thinned = 0
        self._dt_s, self._capacity = dt_s, capacity
        self._high, self._low = _HIGH * capacity, _LOW * capacity
        #: When the queue became half full, when it was last not empty, and when the factor changed and was lowered.
        self._high_s, self._busy_s, self._changed_s, self._lowered_s = np.inf, -np.inf, -np.inf, -np.inf
        self._waiting_then = self._sent = self._sent_then = self._kept_then = 0
        self._calm_s = _CALM_S
        #: Samples for which the queue has room, and the number of the stretch whose rest is left out for lack of it.
        self._room, self._ended = capacity, -1

    def watch(self, waiting: int, now_s: float) -> bool:
        """Adapt the factor to the ``waiting`` samples at ``now_s`` (any monotonic clock); whether it has changed."""
        self._room = self._capacity - waiting
        if waiting > self._low:
            self._busy_s = now_s
        if waiting <= self._high:
            self._high_s = np.inf
        elif self._high_s == np.inf:
            self._high_s, self._waiting_then = now_s, waiting
            self._sent_then, self._kept_then = self._sent, self._sent - self.thinned
        soon = waiting > _FULL * self._capacity
        # At high rates the queue is full before that: it has grown by as much as there is room left.
        at_once = self._high_s < now_s and waiting - self._waiting_then >= self._room
        if (at_once or now_s - self._high_s >= (_SOON_S if soon else _RAISE_S)) and self.factor < _MOST:
            self._high_s = np.inf
            needed = self._needed(waiting)
            if not needed:
                return False
            if now_s - self._lowered_s < self._calm_s:
                self._calm_s = min(2.0 * self._calm_s, _LONGEST_CALM_S)
            self.factor, self._changed_s = needed, now_s
            return True
        if self.factor > 1 and now_s - max(self._busy_s, self._changed_s) >= self._calm_s:
            self.factor, self._changed_s, self._lowered_s = self.factor - 1, now_s, now_s
            return True
        return False

    def _needed(self, waiting: int) -> int:
        """The factor for which the samples handled while the queue was half full would have been enough; 0: no other.

        The queue itself rises and falls with each stretch, so its samples do not tell whether the factor is enough.
        """
        sent = self._sent - self._sent_then
        handled = self._sent - self.thinned - self._kept_then - (waiting - self._waiting_then)
        # A learner that stands still needs another remedy.
        if handled <= 0 or self.factor * handled > sent:
            return 0
        wanted = math.ceil(_RESERVE * sent / handled)
        return min(max(wanted, self.factor + 1), 2 * self.factor + 4, _MOST)

    @property
    def stretch(self) -> int:
        """Length of a stretch at the present factor, samples."""
        longest_s = min(_LONGEST_S, _LEFT_OUT_S / max(self.factor - 1, 1))
        samples = min(round(max(longest_s, _SHORTEST_S) / self._dt_s), round(_OF_QUEUE * self._capacity))
        return max(samples, _LEAST_SAMPLES)

    def split(self, batch: SampleBatch) -> tuple[SampleBatch | None, SampleBatch | None]:
        """(samples to handle, samples left out); None for none. A stretch ends early where the queue is full."""
        self._sent += len(batch)
        if self.factor == 1:
            return batch, None
        stretch = batch.seq // self.stretch
        kept: BoolArray = (stretch % self.factor == 0) & (stretch != self._ended)
        count = int(np.count_nonzero(kept))
        if count > self._room:
            self._ended = int(stretch[kept][-1])
            kept, count = np.zeros_like(kept), 0
        self.thinned += len(batch) - count
        if count == len(batch):
            return batch, None
        return (batch.where(kept) if count else None), batch.where(~kept)
