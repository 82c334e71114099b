"""The way of a stage node's samples onto the wire, apart from its clock.

The loop writes each sample into a ring and goes on; a thread sends what has gathered. Where the wire is slow the
messages grow and the clock keeps its time. Samples are lost only where the wire stands still for longer than the ring
is long, and then they are counted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol import samples as wire
from service.stage_node.faults import Injector

#: Samples that may wait for the wire: half a minute at 1 kHz.
RING: Final = 32_768
#: Longest message, and the distance that the sender keeps from the place where the loop writes.
MOST: Final = 4096


class SampleRing:
    """Samples by number, written by one thread and sent by another.

    ``injector`` may change what leaves; what it leaves out counts neither as published nor as lost,
    what it sends twice counts twice as published.
    """

    def __init__(
        self, dt_s: float, put: Callable[[bytes], None], injector: Injector | None = None, begin: int = 0
    ) -> None:
        self.dt_s = dt_s
        self.published = 0
        self.lost = 0
        self._injector = injector
        self._put = put
        self._u_V: FloatArray = np.zeros(RING)
        self._y_um: FloatArray = np.zeros(RING)
        self._written = begin
        self._sent = begin

    def write(self, k: int, u_V: float, y_um: float) -> None:
        """Take sample k; samples come in order, without gaps, from ``begin`` on."""
        slot = k % RING
        self._u_V[slot] = u_V
        self._y_um[slot] = y_um
        self._written = k + 1

    def send(self) -> bool:
        """Send what waits, at most ``MOST`` samples in one message; True where more is left."""
        end = self._written
        oldest = end - RING + MOST
        if self._sent < oldest:
            self.lost += oldest - self._sent
            self._sent = oldest
        n = min(end - self._sent, MOST)
        if n <= 0:
            return False
        seq = np.arange(self._sent, self._sent + n, dtype=np.int64)
        slots = seq % RING
        rows = (seq, seq.astype(np.float64) * self.dt_s, self._u_V[slots], self._y_um[slots])
        self._sent += n
        for message in [rows] if self._injector is None else self._injector.deliver(rows):
            self._send(*message)
        return self._sent < end

    def finish(self) -> None:
        """Send what a fault still holds back."""
        for message in [] if self._injector is None else self._injector.flush():
            self._send(*message)

    def _send(self, seq: NDArray[np.int64], t_s: FloatArray, u_V: FloatArray, y_um: FloatArray) -> None:
        if self._put_quietly(wire.encode_samples(seq, t_s, u_V, y_um)):
            self.published += len(seq)
        else:
            self.lost += len(seq)

    def _put_quietly(self, payload: bytes) -> bool:
        import zenoh

        try:
            self._put(payload)
        except zenoh.ZError:
            return False
        return True


class Sender:
    """The thread that empties the rings, and calls ``status`` whenever the loop has asked for it."""

    def __init__(self, rings: list[SampleRing], status: Callable[[], None]) -> None:
        self._rings = rings
        self._status = status
        self._wake = threading.Event()
        self._status_due = False
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="stage-sender", daemon=True)
        self._thread.start()

    def wake(self, *, status: bool = False) -> None:
        """There is something to send; ``status``: that too."""
        if status:
            self._status_due = True
        self._wake.set()

    def close(self, timeout_s: float = 10.0) -> bool:
        """Send what waits and end; False where the wire did not take it within the time."""
        self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            closing = self._closing
            # Every ring gets its turn before any gets a second one.
            while any([ring.send() for ring in self._rings]):
                pass
            if self._status_due:
                self._status_due = False
                self._status()
            if closing:
                for ring in self._rings:
                    ring.finish()
                return
