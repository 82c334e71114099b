"""A clean stop on Ctrl-C, SIGTERM and SIGHUP."""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Final

#: Names of the signals of this system: Windows has no SIGHUP.
_KNOWN: Final = signal.Signals.__members__
#: Signals that end a process cleanly.
STOPS: Final = tuple(signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in _KNOWN)


class StopSignal:
    """Ctrl-C, SIGTERM and SIGHUP, caught from its making on; make it in the main thread before anything slow.

    SIGHUP says that the terminal has gone. A process that ignores it, as under nohup, goes on.

    ``raising`` is for work that does not look: it is broken off by a KeyboardInterrupt. Where that is raised into
    something that swallows it (an object that is being cleaned up), :meth:`look` raises it once more.
    """

    def __init__(self, *, raising: bool = False) -> None:
        self.reason = ""
        self._raising = raising
        self._then: Callable[[], None] = lambda: None
        # A pipe and no threading.Event: setting one takes a lock, which the code that the signal interrupts may hold.
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        weakref.finalize(self, _close, self._read, self._write)
        for number in STOPS:
            if number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def wait(self, duration_s: float | None = None) -> str:
        """Wait for a signal or for ``duration_s``; returns the signal's name, or that the time is over."""
        until = math.inf if duration_s is None else time.monotonic() + duration_s
        while not self.reason and (rest_s := until - time.monotonic()) > 0.0:
            if sys.platform == "win32":  # which waits for sockets only
                time.sleep(min(0.05, rest_s))
                continue
            # In steps, because a wait without end keeps some platforms from delivering the signal.
            select.select([self._read], [], [], min(0.5, rest_s))
        return self.reason or "time is over"

    def every(self, period_s: float, duration_s: float | None = None) -> Iterator[None]:
        """Yields after each period, until a signal comes or the time is over."""
        until = math.inf if duration_s is None else time.monotonic() + duration_s
        while not self.reason and (rest_s := until - time.monotonic()) > 0.0:
            self.wait(min(period_s, rest_s))
            if not self.reason and rest_s > period_s:
                yield

    def look(self) -> None:
        """Raises KeyboardInterrupt if a signal has come."""
        if self.reason:
            raise KeyboardInterrupt

    def then(self, action: Callable[[], None]) -> None:
        """From now on a signal does ``action``, which takes no lock, in place of raising; at once if one has come."""
        self._then = action
        self._raising = False
        if self.reason:
            action()

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.reason = signal.Signals(number).name
        with contextlib.suppress(OSError):
            os.write(self._write, b".")
        self._then()
        if self._raising:
            raise KeyboardInterrupt


def _close(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


@contextlib.contextmanager
def unbroken() -> Iterator[None]:
    """Signals to stop that come in this block act at its end: a child process that was started is also noted down.

    In another thread than the main one it does nothing, because no signal is handled there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in STOPS}
    held = {number: handler for number, handler in before.items() if callable(handler)}
    for number in held:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
