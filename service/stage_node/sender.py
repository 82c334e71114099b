"""Sends the samples of a stage node, apart from the loop that keeps its clock.

The loop writes each sample into a ring; the thread ``stage-sender`` sends what has collected. On a slow network the
messages grow and the clock keeps its time. If the network stalls for longer than the ring lasts, samples are lost and
counted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np
import zenoh
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol import samples as wire
from service.stage_node.faults import Injector

#: Samples that may wait to be sent: half a minute at 1 kHz.
RING_SIZE: Final = 32_768
#: Longest message in samples, and the distance of the sender from the slot that the loop writes.
MAX_MESSAGE: Final = 4096


class SampleRing:
    """Samples by number, written by one thread and sent by another.

    ``injector`` may change the messages. Samples that it leaves out count neither as published nor as lost; samples
    that it sends twice count twice as published.
    """

    def __init__(
        self, dt_s: float, put: Callable[[bytes], None], injector: Injector | None = None, begin: int = 0
    ) -> None:
        self.dt_s = dt_s
        self.published = 0
        self.lost = 0
        self._injector = injector
        self._put = put
        self._u_V: FloatArray = np.zeros(RING_SIZE)
        self._y_um: FloatArray = np.zeros(RING_SIZE)
        self._written = begin
        self._sent = begin

    def write(self, k: int, u_V: float, y_um: float) -> None:
        """Write sample k; samples come in order, without gaps, from ``begin`` on."""
        slot = k % RING_SIZE
        self._u_V[slot] = u_V
        self._y_um[slot] = y_um
        self._written = k + 1

    def send(self) -> bool:
        """Send what waits, at most ``MAX_MESSAGE`` samples in one message. Returns whether more is left."""
        end = self._written
        oldest = end - RING_SIZE + MAX_MESSAGE
        if self._sent < oldest:
            self.lost += oldest - self._sent
            self._sent = oldest
        n = min(end - self._sent, MAX_MESSAGE)
        if n <= 0:
            return False
        seq = np.arange(self._sent, self._sent + n, dtype=np.int64)
        slots = seq % RING_SIZE
        rows = (seq, seq.astype(np.float64) * self.dt_s, self._u_V[slots], self._y_um[slots])
        self._sent += n
        for message in [rows] if self._injector is None else self._injector.deliver(rows):
            self._send(*message)
        return self._sent < end

    def finish(self) -> None:
        """Send what a fault holds back."""
        for message in [] if self._injector is None else self._injector.flush():
            self._send(*message)

    def _send(self, seq: NDArray[np.int64], t_s: FloatArray, u_V: FloatArray, y_um: FloatArray) -> None:
        try:
            self._put(wire.encode_samples(seq, t_s, u_V, y_um))
        except zenoh.ZError:
            self.lost += len(seq)
        else:
            self.published += len(seq)


class Sender:
    """The thread ``stage-sender``: it empties the rings and calls ``status`` when the loop asks for it."""

    def __init__(self, rings: list[SampleRing], status: Callable[[], None]) -> None:
        self._rings = rings
        self._status = status
        self._wake = threading.Event()
        self._status_due = False
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="stage-sender", daemon=True)
        self._thread.start()

    def wake(self, *, status: bool = False) -> None:
        """Wake the thread: there are samples to send, and with ``status`` a status too."""
        if status:
            self._status_due = True
        self._wake.set()

    def close(self, timeout_s: float = 10.0) -> bool:
        """Send what waits and end the thread. Returns False if that took longer than ``timeout_s``."""
        self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            closing = self._closing
            # Each ring sends one message before any sends a second one.
            while any([ring.send() for ring in self._rings]):
                pass
            if self._status_due:
                self._status_due = False
                self._status()
            if closing:
                for ring in self._rings:
                    ring.finish()
                return
