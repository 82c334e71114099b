"""Between the wire and the learner: a bounded queue and the one thread that handles samples.

The wire's callback only decodes and hands over; what does not fit is dropped, counted and told. The thread spends its
time in compiled code that releases the interpreter's lock, so that queries are answered meanwhile.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Protocol

from numpy.typing import ArrayLike

from service.axis import Axis
from service.wire import SampleBatch

#: Diagnostics are taken every so many seconds of samples, the points of the window every so many of those.
DIAGNOSTICS_S: Final = 0.05
_WINDOW_EVERY: Final = 20
_WINDOW_FIELDS: Final = ("window_y_um", "window_v_um_per_s", "window_u_V")


class SampleSink(Protocol):
    """What keeps samples: the recorder. None of these may block or raise."""

    def put(self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]) -> bool:
        """Take n samples with what the learner said of each; False if they were dropped."""
        ...

    def counters(self) -> dict[str, Any]:
        """For the status."""
        ...

    def close(self, timeout_s: float = ...) -> bool:
        """Write what waits and end."""
        ...


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
        self.dropped = 0
        self.malformed = 0
        self.waiting = 0
        #: Newest values of the learner's own, replaced whole; and whether anybody wants the diagnostics.
        self.counters: dict[str, int] = {}
        self.diagnostics: dict[str, Any] = {}
        self.want_diagnostics = False
        self._changed = changed
        self._queue: deque[SampleBatch] = deque()
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
        with self._ready:
            if self._closing or self.waiting + len(batch) > self.axis.config.queue_samples:
                if not self.dropped:
                    self.axis.note("samples_dropped", "the learner is behind and its queue is full; see the status")
                self.dropped += len(batch)
                return False
            self._queue.append(batch)
            self.waiting += len(batch)
            self._ready.notify()
        return True

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
                batch = self._queue.popleft()
            before = self.axis.newest
            verdicts = self.axis.handle(batch)
            with self._ready:
                self.waiting -= len(batch)
            if self.sink is not None:
                self.sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, verdicts)
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
        diagnose = getattr(learner, "diagnostics", None)
        if diagnose is None or not self.want_diagnostics:
            return
        told = dict(diagnose())
        if self._ticks % _WINDOW_EVERY:
            for name in _WINDOW_FIELDS:
                told.pop(name, None)
        self._ticks += 1
        self.diagnostics = {"seq": self.axis.newest.seq, "t_s": t_s, **told}
