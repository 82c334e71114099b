"""Healing a window at work: its factor is made anew in a thread, and swapped in a fixed number of steps later.

What was refused, and how often, does not depend on how fast the thread was: where it is not ready by then it is waited
for. So a replay, a copy and a window restored from its state all go on with the same numbers to the last bit.
"""

from __future__ import annotations

import threading
from typing import Any

from adaptive.errors import NumericsError
from adaptive.types import StateDict
from adaptive.window import Window
from adaptive.window_refresh import Refresh, begin

#: Steps from the refusal that shows a window worn out to the swap. At 100 a second a third of a second: ten times what
#: factoring 500 samples takes, and catching up with as many steps costs no more than a fifth of that.
STEPS = 32


class Healing:
    """At most one refresh of one window; see the module. Not for two threads at a time."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._refresh: Refresh | None = None
        self._thread: threading.Thread | None = None
        self._left = 0

    @property
    def open(self) -> bool:
        """Whether a refresh is under way."""
        return self._refresh is not None

    def begin(self) -> None:
        """Start one, unless one is under way; of a window that holds samples."""
        if self._refresh is None:
            self._refresh, self._left = begin(self._window, self._window.form_called_for()), STEPS
            self._start()

    def step(self) -> None:
        """Before each step of the window: swap in what is due. Where that does not fit, heal in line."""
        if self._refresh is None:
            return
        self._left -= 1
        if self._left > 0:
            return
        self._wait()
        refresh, self._refresh = self._refresh, None
        if not refresh.finish():
            self._window.heal()

    def _start(self) -> None:
        assert self._refresh is not None
        self._thread = threading.Thread(target=_factor, args=(self._refresh,), name="window-healing", daemon=True)
        self._thread.start()

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
        elif self._refresh is not None and not self._refresh.factored:
            _factor(self._refresh)
        self._thread = None

    def __getstate__(self) -> dict[str, Any]:
        # A thread is of one process: a copy has the factor itself.
        self._wait()
        return self.__dict__.copy()

    def state_dict(self) -> StateDict:
        """Flat; empty where nothing is under way. The thread is not waited for."""
        return {} if self._refresh is None else {"left": self._left, **self._refresh.state_dict()}

    @classmethod
    def from_state(cls, window: Window, state: StateDict) -> Healing:
        """Goes on where ``state_dict`` was taken, with the same result to the last bit."""
        made = cls(window)
        if state:
            made._left, made._refresh = int(state["left"]), Refresh.from_state(window, state)
            made._start()
        return made


def _factor(refresh: Refresh) -> None:
    try:
        refresh.factor()
    except NumericsError:
        return  # it stays unfactored, and `finish` says so
