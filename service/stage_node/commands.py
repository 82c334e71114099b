"""The commands of a stage node: voltages by sequence number. Late and missing ones are counted."""

from __future__ import annotations

import threading

import numpy as np

from adaptive.errors import InputError
from service.protocol import samples as wire
from service.protocol.errors import FieldError

#: Commands for more than this many ticks ahead are refused.
AHEAD = 65_536


class CommandBuffer:
    """Voltages by sequence number, written by zenoh's thread and read by the loop.

    A ring of values and of their sequence numbers: a slot whose number differs from the one asked for is empty for it.
    The value is written before its number, so that the reader never sees half a command. ``begin`` is the first tick;
    its command sets ``first``.
    """

    def __init__(self, size: int = AHEAD, begin: int = 0) -> None:
        self.size = size
        self.begin = begin
        self.counts = {"blocks": 0, "voltages": 0, "late": 0, "missing": 0, "refused": 0}
        self.first = threading.Event()
        self.error = ""
        self._values = np.zeros(size)
        self._numbers = np.full(size, -1, dtype=np.int64)
        self._next = begin
        self._last_V = 0.0

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
        if block.seq + len(block) > now + self.size:
            raise FieldError("seq", block.seq + len(block) - 1, f"at most {now + self.size - 1}, the ring's end")
        self.counts["blocks"] += 1
        self.counts["voltages"] += len(block)
        numbers = np.arange(block.seq, block.seq + len(block))
        fresh = numbers >= now
        self.counts["late"] += int(len(numbers) - np.count_nonzero(fresh))
        slots = numbers[fresh] % self.size
        self._values[slots] = block.values[fresh]
        self._numbers[slots] = numbers[fresh]
        if block.seq == self.begin:
            self.first.set()

    def take(self, k: int) -> float:
        """The voltage for tick k, V; if none came in time the last one, counted as missing."""
        self._next = k + 1
        slot = k % self.size
        if self._numbers.item(slot) == k:
            self._last_V = self._values.item(slot)
        elif self.counts["blocks"]:
            self.counts["missing"] += 1
        return self._last_V
