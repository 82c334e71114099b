"""What every stage on the wire needs: voltages in by sequence number, samples out by a thread of their own.

A simulated stage (`service.stage_node.node`) and a real one (`service.adapters`) share it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import zenoh
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import FieldError

# --- The commands of a stage node: voltages by sequence number. Late and missing ones are counted.

#: Commands for more than this many ticks ahead are refused.
AHEAD = 65_536
#: Longest wait for a command at a time, s, so that a stop is noticed.
_SLICE_S: Final = 0.02


class CommandBuffer:
    """Voltages by sequence number, written by zenoh's thread and read by the loop.

    A ring of values and of their sequence numbers: a slot whose number differs from the one asked for is empty for it.
    The value is written before its number, so that the reader never sees half a command. ``begin`` is the first tick;
    its command sets ``first``.
    """

    def __init__(self, begin: int = 0) -> None:
        self.begin = begin
        self.counts = {"blocks": 0, "voltages": 0, "late": 0, "missing": 0, "refused": 0}
        self.first = threading.Event()
        self.error = ""
        self._values = np.zeros(AHEAD)
        self._numbers = np.full(AHEAD, -1, dtype=np.int64)
        self._next = begin
        self._last_V = 0.0
        self._came = threading.Event()
        #: Count of blocks when a wait for a voltage was given up; without a further one there is no other wait.
        self._given_up = 0

    def receive(self, payload: bytes) -> None:
        """Take a message. A malformed one is counted, and the error text of the last one is kept."""
        try:
            self.put(wire.decode_command(payload))
        except InputError as error:
            self.counts["refused"] += 1
            self.error = str(error)

    def put(self, block: wire.Block) -> None:
        """Take voltages from ``block.seq`` on. Voltages for past ticks are counted as late.

        Raises FieldError if the block ends beyond the ring.
        """
        now = self._next
        if block.seq + len(block) > now + AHEAD:
            raise FieldError("seq", block.seq + len(block) - 1, f"at most {now + AHEAD - 1}, the ring's end")
        self.counts["blocks"] += 1
        self.counts["voltages"] += len(block)
        numbers = np.arange(block.seq, block.seq + len(block))
        fresh = numbers >= now
        self.counts["late"] += int(len(numbers) - np.count_nonzero(fresh))
        slots = numbers[fresh] % AHEAD
        self._values[slots] = block.values[fresh]
        self._numbers[slots] = numbers[fresh]
        self._came.set()
        if block.seq == self.begin:
            self.first.set()

    def hold(self, u_V: float) -> None:
        """Repeat this voltage, V, until the first command is due."""
        self._last_V = u_V

    def lacks(self, k: int, until_s: float) -> bool:
        """Whether tick ``k`` still has to wait for its voltage, after up to 20 ms of waiting.

        No longer from ``until_s`` (``time.perf_counter``) on; nor again before the next command, or before the first.
        """
        self._came.clear()
        if self._numbers.item(k % AHEAD) == k or self.counts["blocks"] == self._given_up:
            return False
        if time.perf_counter() >= until_s:
            self._given_up = self.counts["blocks"]
            return False
        self._came.wait(_SLICE_S)
        return True

    def take(self, k: int) -> float:
        """The voltage for tick k, V; if none came in time the last one, counted as missing."""
        self._next = k + 1
        slot = k % AHEAD
        if self._numbers.item(slot) == k:
            self._last_V = self._values.item(slot)
        elif self.counts["blocks"]:
            self.counts["missing"] += 1
        return self._last_V


# --- Sends the samples of a stage node, apart from the loop that keeps its clock.
#
# The loop writes each sample into a ring; the thread ``stage-sender`` sends what has collected. On a slow network the
# messages grow and the clock keeps its time. If the network stalls for longer than the ring lasts, samples are lost and
# counted.

#: Samples that may wait to be sent: half a minute at 1 kHz.
RING_SIZE: Final = 32_768
#: Longest message in samples, and the distance of the sender from the slot that the loop writes.
MAX_MESSAGE: Final = 4096


#: Sample numbers, times, s, voltages, V, and readings, µm: (n,) each.
Rows = tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]


class SampleRing:
    """The last `RING_SIZE` samples, written by the loop and sent by another thread.

    ``put`` sends one message. Samples that wait for longer than the ring lasts, or that it cannot send, are lost and
    counted. ``changed`` gives the messages that are sent in place of one, ``rest`` those that it held back at the end.
    """

    def __init__(
        self, put: Callable[..., None], changed: Callable[[Rows], list[Rows]] = lambda rows: [rows],
        rest: Callable[[], list[Rows]] = list,
    ) -> None:  # fmt: skip
        self.written = self.published = self.lost = 0
        self._put, self._changed, self._rest = put, changed, rest
        self._columns: Rows = (np.zeros(RING_SIZE, dtype=np.int64), *np.zeros((3, RING_SIZE)))
        self._sent = 0

    def write(self, seq: int, t_s: float, u_V: float, y_um: float) -> None:
        """Write a sample; numbers rise."""
        slot = self.written % RING_SIZE
        for column, value in zip(self._columns, (seq, t_s, u_V, y_um), strict=True):
            column[slot] = value
        self.written += 1

    def since(self, seq: int) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
        """(numbers, V, µm), (n,) each, of the samples from number ``seq`` on, as far as kept. For the loop's thread."""
        first, numbers = self.written, self._columns[0]
        while first > max(self.written - RING_SIZE, 0) and numbers[(first - 1) % RING_SIZE] >= seq:
            first -= 1
        numbers, _, u_V, y_um = self._rows(first, self.written)
        return numbers, u_V, y_um

    def send(self) -> bool:
        """Send what waits, at most `MAX_MESSAGE` samples in one message. Returns whether more is left."""
        end = self.written
        # The slots that the loop writes next are left alone.
        lost = max(0, end - RING_SIZE + MAX_MESSAGE - self._sent)
        first = self._sent + lost
        self.lost += lost
        self._sent = min(end, first + MAX_MESSAGE)
        if self._sent > first:
            self._deliver(self._changed(self._rows(first, self._sent)))
        return self._sent < end

    def finish(self) -> None:
        """Send what was held back; after the last ``send``."""
        self._deliver(self._rest())

    def _rows(self, first: int, stop: int) -> Rows:
        slots, (seq, t_s, u_V, y_um) = np.arange(first, stop) % RING_SIZE, self._columns
        return seq[slots], t_s[slots], u_V[slots], y_um[slots]

    def _deliver(self, messages: list[Rows]) -> None:
        for rows in messages:
            try:
                self._put(*rows)
            except zenoh.ZError:
                self.lost += len(rows[0])
            else:
                self.published += len(rows[0])


class Sender:
    """The thread ``stage-sender``: it empties the rings and calls ``status`` when the loop asks for it."""

    def __init__(self, rings: Sequence[SampleRing], status: Callable[[], None] = lambda: None) -> None:
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
