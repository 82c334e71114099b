"""Between the wire and the learner: a bounded queue and the one thread that handles samples.

The wire's callback only decodes and hands over; what does not fit is dropped, counted and told. The thread spends its
time in compiled code that releases the interpreter's lock, so that queries are answered meanwhile.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any, Final, NamedTuple, TypeVar

from service.intake.sequence import AHEAD
from service.intake.sinks import SampleSink, SampleWatcher
from service.protocol.errors import ServiceError
from service.protocol.samples import SampleBatch, joined
from service.server.axis import Axis
from service.server.competing import standing_of

T = TypeVar("T")

#: How long after the first message the others are waited for that are handled with it, s. To be woken costs as much as
#: to learn from two samples, and a query meets a core, a cache and an interpreter's lock that are busy less often.
GATHER_S: Final = 0.005
#: In a recording: what was never handled, because too much waited already.
DROPPED: Final = "dropped"
#: Diagnostics are taken every so many seconds of samples, the points of the window every so many of those.
DIAGNOSTICS_S: Final = 0.05
_WINDOW_EVERY: Final = 20
_WINDOW_FIELDS: Final = ("window_y_um", "window_v_um_per_s", "window_u_V")


class _Arrived(NamedTuple):
    """Samples of a message, and when they came by a clock that never goes back, s."""

    batch: SampleBatch
    at_s: float


class _Work(NamedTuple):
    job: Callable[[], Any]
    done: Future[Any]


class Intake:
    """Queue and thread of one axis.

    Parameters
    ----------
    axis : what handles the samples.
    changed : called from the thread after a new snapshot.
    sink : gets every sample with its verdict, or None.
    """

    def __init__(self, axis: Axis, changed: Callable[[], None], sink: SampleSink | None = None) -> None:
        self.axis = axis
        self.sink = sink
        #: Sees every batch after it was handled, in this thread; None where nobody watches.
        self.watcher: SampleWatcher | None = None
        self.dropped = 0
        self.malformed = 0
        self.waiting = 0
        #: When what was handled last came, by ``time.monotonic``; of the first, until it has been. None: none came.
        #: A learner that is behind, or hangs, is no newer for what it has not seen.
        self.handled_at_s: float | None = None
        #: Newest values of the learner's own, replaced whole; and whether anybody wants the diagnostics.
        self.counters: dict[str, int] = {}
        #: Who is champion and how good each contestant is; None without a competition.
        self.standing: dict[str, Any] | None = None
        self.diagnostics: dict[str, Any] = {}
        self.want_diagnostics = False
        self._changed = changed
        #: Samples, and work that is to be done behind those that came before it.
        self._queue: deque[_Arrived | _Work] = deque()
        #: What of a batch is to be handled now, None for nothing: a standby keeps its samples back until it may.
        self.gate: Callable[[SampleBatch], SampleBatch | None] | None = None
        self._ready = threading.Condition()
        self._closing = False
        self._next_diagnostics_s = 0.0
        self._ticks = 0
        self._thread = threading.Thread(target=self._run, name=f"learn-{axis.config.name}")

    def start(self) -> None:
        """Begin to handle samples."""
        self._thread.start()

    def offer(self, batch: SampleBatch) -> bool:
        """Queue samples for the learner; False if they were dropped because it is too far behind."""
        at_s = time.monotonic()
        with self._ready:
            if self.handled_at_s is None:
                self.handled_at_s = at_s
            fits = not self._closing and self.waiting + len(batch) <= self.axis.config.queue_samples
            if fits:
                self._queue.append(_Arrived(batch, at_s))
                self.waiting += len(batch)
                self._ready.notify()
            else:
                if not self.dropped:
                    self.axis.note("samples_dropped", "the learner is behind and its queue is full; see the status")
                self.dropped += len(batch)
        # Nobody will handle them: they are recorded apart from those that the learner goes through.
        put_aside = None if fits else getattr(self.sink, "put_aside", None)
        if put_aside is not None:
            put_aside(batch.seq, batch.t_s, batch.u_V, batch.y_um, DROPPED)
        return fits

    def age_s(self, now_s: float) -> float | None:
        """How long before ``now_s``, by ``time.monotonic``, what was handled last came, s; None: nothing came."""
        at_s = self.handled_at_s
        return None if at_s is None else max(0.0, now_s - at_s)

    def call(self, work: Callable[[], T], timeout_s: float = 2.0) -> T:
        """Do ``work`` in the thread that handles samples, after those that have come; what it returns or raises.

        Not from that thread itself. Raises ServiceError where that thread has ended or is too far behind.
        """
        done: Future[T] = Future()
        with self._ready:
            if self._closing or not self._thread.is_alive():
                raise ServiceError(f"axis {self.axis.config.name}: no samples are handled; the service begins or ends")
            self._queue.append(_Work(work, done))
            self._ready.notify()
        try:
            return done.result(timeout_s)
        except FutureTimeout:
            if done.done():  # what it raised, and not that it took too long
                raise
            done.cancel()
            raise ServiceError(
                f"axis {self.axis.config.name}: the learner did not get to it within {timeout_s:g} s"
            ) from None
        finally:
            # What it raised knows this frame, and this frame would know it.
            del done

    def close(self) -> None:
        """Handle what is queued, then end the thread."""
        with self._ready:
            self._closing = True
            self._ready.notify()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._ready:
                while not self._queue and not self._closing:
                    self._ready.wait()
                if not self._queue:
                    return
                first = self._queue[0]
                work = first if isinstance(first, _Work) else None
                if work is not None:
                    self._queue.popleft()
            if work is not None:
                _do(*work)
                self._changed()
                continue
            if not self._closing:
                time.sleep(GATHER_S)
            arrived, at_s = self._gathered()
            try:
                batch = arrived if self.gate is None else self.gate(arrived)
                if batch is not None:
                    self.handle(batch)
                self.handled_at_s = at_s
            except Exception as error:
                # The samples after it are as good as ever, and somebody waits for their snapshots.
                self.axis.note("internal_error", f"handling samples: {type(error).__name__}: {error}")
            with self._ready:
                self.waiting -= len(arrived)

    def _gathered(self) -> _Arrived:
        """The samples at the head of the queue, up to the next piece of work, as one batch that came with its last."""
        batches, at_s = [], 0.0
        with self._ready:
            while self._queue:
                first = self._queue[0]
                if isinstance(first, _Work):
                    break
                batches.append(first.batch)
                at_s = first.at_s
                self._queue.popleft()
        return _Arrived(batches[0] if len(batches) == 1 else joined(batches), at_s)

    def handle(self, batch: SampleBatch) -> None:
        """Learn and record samples; in the thread that handles samples, or before it has started."""
        before = self.axis.newest
        verdicts = self.axis.handle(batch)
        if self.sink is not None:
            self.sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, verdicts)
        if self.watcher is not None:
            # Behind a number far ahead all that follow would be old.
            near = [verdict != AHEAD for verdict in verdicts]
            if any(near):
                self.watcher.take(batch if all(near) else batch.where(near))
        if self.axis.retuner is not None:
            self.axis.retuner.step(self.axis)
        if self.axis.newest is not before:
            self._observe()
            self._changed()

    def _observe(self) -> None:
        """Copy what the learner tells of itself, here, where nothing changes it meanwhile."""
        learner = self.axis.learner
        t_s = self.axis.newest.t_s
        if learner is None or 0.0 <= self._next_diagnostics_s - t_s <= DIAGNOSTICS_S:
            return
        self._next_diagnostics_s = t_s + DIAGNOSTICS_S
        self.counters = dict(learner.counters())
        self.standing = standing_of(learner)
        ticks, self._ticks = self._ticks, self._ticks + 1
        # Once a second for the status, even where nobody follows.
        if not self.want_diagnostics and ticks % _WINDOW_EVERY:
            return
        told = learner.diagnostics()
        if not told:
            return
        if ticks % _WINDOW_EVERY:
            for name in _WINDOW_FIELDS:
                told.pop(name, None)
        self.diagnostics = {"seq": self.axis.newest.seq, "t_s": t_s, **told}


def _do(job: Callable[[], Any], done: Future[Any]) -> None:
    if not done.set_running_or_notify_cancel():
        return
    try:
        done.set_result(job())
    except Exception as error:
        done.set_exception(error)
        # As above: a state of megabytes that was refused would stay until circles are looked for.
        del job, done
