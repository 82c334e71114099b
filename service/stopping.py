"""A clean stop on Ctrl-C and SIGTERM."""

from __future__ import annotations

import math
import signal
import threading
import time
from types import FrameType


class StopSignal:
    """Ctrl-C and SIGTERM, caught from its making on; make it in the main thread before anything slow."""

    def __init__(self) -> None:
        self.reason = ""
        self._event = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def wait(self, duration_s: float | None = None) -> str:
        """Wait for a signal or for ``duration_s``; returns the signal's name, or that the time is over."""
        until = math.inf if duration_s is None else time.monotonic() + duration_s
        # In steps, because a wait without end keeps some platforms from delivering the signal.
        while not self._event.wait(min(0.5, max(0.0, until - time.monotonic()))):
            if time.monotonic() >= until:
                return "time is over"
        return self.reason

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.reason = signal.Signals(number).name
        self._event.set()
