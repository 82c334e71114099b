"""Healing a window at work: its factor is made anew in a thread, and swapped in a fixed number of steps later.

What was refused, and how often, does not depend on how fast the thread was: where it is not ready by then it is waited
for. So a replay, a copy and a window restored from its state all go on with the same numbers to the last bit.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from adaptive.errors import NumericsError
from adaptive.types import IntArray, StateDict
from adaptive.window import arrays as ws
from adaptive.window import steps
from adaptive.window.window import Window

# --- Refreshing a window's factorisation beside its work: begin, factor elsewhere, catch up, swap.
#
# A refresh costs O(N³), some hundred steps' worth. It is split in three: `begin` copies the state (on the
# stepping thread, O(N²)), `Refresh.factor` does the work on any thread without the interpreter's lock, `finish`
# (again on the stepping thread) carries over what was learnt meanwhile, one ordinary step a changed slot, and
# swaps the arrays in. What comes of it depends on when it was begun and finished, not on when the factor was ready.


#: What a factorisation is made from; factoring does not write to these.
_FIELDS = ("R", "X", "scaled")


class Refresh:
    """One refresh under way. ``form`` : of the new factorisation, that of the window unless given."""

    def __init__(self, window: Window, form: int | None = None) -> None:
        self._source = window
        self._form = int(window.arrays.C[ws.FORM])
        self._copy = window.copy()
        self._copy.arrays.C[ws.FORM] = self._form if form is None else form
        self._count = len(window)
        self._factored = False

    def factor(self) -> None:
        """Factor the copy. Any thread. Raises NumericsError where R is not positive definite."""
        self._copy.rebuild()
        self._factored = True

    @property
    def factored(self) -> bool:
        """Whether `factor` has done its work."""
        return self._factored

    def changed_slots(self) -> IntArray:
        """Slots whose sample or weight differs from the copy's, in order."""
        n, now, then = self._count, self._source.arrays, self._copy.arrays
        differs = np.any(now.X[:, :n] != then.X[:, :n], axis=0) | (now.V[ws.W, :n] != then.V[ws.W, :n])
        return np.flatnonzero(differs)

    def finish(self) -> bool:
        """Bring the factored copy up to date and swap it in. The stepping thread.

        Returns
        -------
        False where nothing was swapped: not factored yet, slots removed or the form changed since, or a step of the
        catch-up refused.
        """
        n, source, copy = len(self._source), self._source.arrays, self._copy
        if not self._factored or source.C[ws.FORM] != self._form:
            return False
        y, w = source.V[ws.Y], source.V[ws.W]
        for slot in self.changed_slots():
            if copy.replace(int(slot), np.ascontiguousarray(source.X[:, slot]), y[slot], w[slot]) != ws.ACCEPTED:
                return False
        for slot in range(self._count, n):
            if copy.append(np.ascontiguousarray(source.X[:, slot]), y[slot], w[slot]) != ws.ACCEPTED:
                return False
        copy.arrays.V[ws.Y, :n] = y[:n]
        copy.arrays.C[ws.CURSOR : ws.UNDO_PLACE] = source.C[ws.CURSOR : ws.UNDO_PLACE]
        copy.arrays.C[ws.REFRESHES] += 1
        copy.arrays.F[ws.RESIDUAL : ws.LAST_WORST + 1] = source.F[ws.RESIDUAL : ws.LAST_WORST + 1]
        if not steps.resum(copy.arrays):
            return False
        copy.arrays.C[ws.UNDO] = ws.UNDO_NOTHING
        self._source.arrays = copy.arrays
        return True

    def state_dict(self) -> StateDict:
        """What the factorisation is made from, as it was at the beginning; while `factor` runs, too."""
        A = self._copy.arrays
        fields = {name: getattr(A, name).copy() for name in _FIELDS}
        samples = {"y": A.V[ws.Y].copy(), "w": A.V[ws.W].copy()}
        return {**fields, **samples, "count": self._count, "form": self._form, "new_form": int(A.C[ws.FORM])}

    @classmethod
    def from_state(cls, window: Window, state: StateDict) -> Refresh:
        """The refresh of ``window`` that a ``state_dict`` is of; its factor, made again, comes out the same."""
        made = cls(window, int(state["new_form"]))
        A = made._copy.arrays
        for name in _FIELDS:
            getattr(A, name)[...] = state[name]
        A.V[ws.Y], A.V[ws.W] = state["y"], state["w"]
        A.C[ws.COUNT] = made._count = int(state["count"])
        made._form = int(state["form"])
        return made


def begin(window: Window, form: int | None = None) -> Refresh:
    """Start refreshing ``window``, which may go on stepping. Raises NumericsError while it is empty."""
    if len(window) == 0:
        raise NumericsError("refresh: the window is empty, there is nothing to factor; wait for samples")
    return Refresh(window, form)


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
