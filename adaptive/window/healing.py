"""Healing a window at work: a thread makes a new factorisation, which is swapped in a fixed number of steps later.

The result does not depend on the speed of the thread: where it is not ready in time, the stepping thread waits for it.
A replay, a copy and a window restored from its state continue with the same numbers to the last bit.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from dehyst.adaptive.errors import NumericsError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.window import Window

# --- A refresh costs O(N³), as much as some hundred steps. It has three parts: `begin` copies the state (stepping
# thread, O(N²)), `Refresh.factor` factors the copy (any thread, without the interpreter's lock), `Refresh.finish`
# applies the steps made meanwhile, one for each changed slot, and swaps the arrays in (stepping thread).


#: Arrays that a factorisation reads and does not write.
_FIELDS = ("R", "X", "scaled")


@dataclass(slots=True)
class HealingState:
    """A refresh in progress: what it factors."""

    left: Annotated[int, Entry("steps until it is swapped in", low=-1, high=1000)]
    R: Annotated[FloatArray, Entry("kernel matrix with the noise variances", "", "N,N")]
    X: Annotated[FloatArray, Entry("features", "", "d,N")]
    scaled: Annotated[FloatArray, Entry("features over their widths", "", "d,N")]
    y: Annotated[FloatArray, Entry("targets", "V", "N")]
    w: Annotated[FloatArray, Entry("noise weights", "", "N")]
    count: Annotated[int, Entry("samples at its beginning", low=1)]
    form: Annotated[int, Entry("form of the window: 0 inverse, 1 Cholesky", low=0, high=1)]
    new_form: Annotated[int, Entry("form of the new factorisation", low=0, high=1)]

    def check_state(self) -> None:
        """Raise ValueError where there are more samples than slots."""
        if self.count > self.y.size:
            raise ValueError(f"count: got {self.count}, expected at most the window's {self.y.size} samples")


class Refresh:
    """A refresh in progress. ``form`` : of the new factorisation; that of the window unless given."""

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
        """Whether `factor` has succeeded."""
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
        False where nothing was swapped: not factored yet, the form changed since, or a step of the catch-up refused.
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
        copy.arrays.C[ws.CURSOR :] = source.C[ws.CURSOR :]
        copy.arrays.C[ws.REFRESHES] += 1
        copy.arrays.F[ws.RESIDUAL : ws.LAST_WORST + 1] = source.F[ws.RESIDUAL : ws.LAST_WORST + 1]
        if not steps.resum(copy.arrays):
            return False
        copy.arrays.C[ws.UNDO] = ws.UNDO_NOTHING
        self._source.take_arrays(copy.arrays)
        return True

    def state(self, left: int) -> HealingState:
        """The input of the factorisation, as it was at the beginning. May be called while `factor` runs."""
        A = self._copy.arrays
        fields = {name: getattr(A, name).copy() for name in _FIELDS}
        y, w = A.V[ws.Y].copy(), A.V[ws.W].copy()
        return HealingState(left, **fields, y=y, w=w, count=self._count, form=self._form, new_form=int(A.C[ws.FORM]))

    @classmethod
    def of(cls, window: Window, state: HealingState) -> Refresh:
        """Inverse of ``state``, for ``window``. The factor has to be made again; it comes out the same."""
        made = cls(window, state.new_form)
        A = made._copy.arrays
        for name in _FIELDS:
            getattr(A, name)[...] = getattr(state, name)
        A.V[ws.Y], A.V[ws.W] = state.y, state.w
        A.C[ws.COUNT] = made._count = state.count
        made._form = state.form
        return made


def begin(window: Window, form: int | None = None) -> Refresh:
    """Start refreshing ``window``, which may continue to step. Raises NumericsError while it is empty."""
    if len(window) == 0:
        raise NumericsError("refresh: the window is empty, there is nothing to factor; wait for samples")
    return Refresh(window, form)


#: Steps from the refusal that begins a refresh to the swap. At 100 steps a second this is a third of a second, ten
#: times the time to factor 500 samples; to catch up costs at most a fifth of a factorisation.
STEPS = 32


class Healing:
    """At most one refresh of one window. Owns the thread ``window-healing``. Not for two threads at a time."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._refresh: Refresh | None = None
        self._thread: threading.Thread | None = None
        self._left = 0

    @property
    def open(self) -> bool:
        """Whether a refresh is in progress."""
        return self._refresh is not None

    def begin(self) -> None:
        """Start a refresh unless one is in progress. The window must hold samples."""
        if self._refresh is None:
            self._refresh, self._left = begin(self._window, self._window.form_called_for()), STEPS
            self._start()

    def step(self) -> None:
        """Call before each step of the window: swap in the refresh that is due. Where that fails, heal in line."""
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
        # Threads are not copied: wait, so that the copy has the factor.
        self._wait()
        return self.__dict__.copy()

    def state(self) -> HealingState | None:
        """None where no refresh is in progress. Does not wait for the thread."""
        return None if self._refresh is None else self._refresh.state(self._left)

    @classmethod
    def of(cls, window: Window, state: HealingState | None) -> Healing:
        """Inverse of ``state``: continues with the same result to the last bit."""
        made = cls(window)
        if state is not None:
            made._left, made._refresh = state.left, Refresh.of(window, state)
            made._start()
        return made


def _factor(refresh: Refresh) -> None:
    try:
        refresh.factor()
    except NumericsError:
        return  # `Refresh.finish` returns False then.
