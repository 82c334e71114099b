"""Refreshing a window's factorisation beside its work: begin, factor elsewhere, catch up, swap.

A refresh costs O(N³), some hundred steps' worth. It is split in three: `begin` copies the state (on the
stepping thread, O(N²)), `Refresh.factor` does the work on any thread without the interpreter's lock, `finish`
(again on the stepping thread) carries over what was learnt meanwhile, one ordinary step a changed slot, and
swaps the arrays in. What comes of it depends on when it was begun and finished, not on when the factor was ready.
"""

from __future__ import annotations

import numpy as np

from adaptive import window_state as ws
from adaptive.errors import NumericsError
from adaptive.types import StateDict
from adaptive.window import Window
from adaptive.window_state import IntArray

#: What a factorisation is made from; factoring does not write to these.
_FIELDS = ("R", "X", "scaled", "H")


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
        if not self._factored or n < self._count or source.C[ws.FORM] != self._form:
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
        if not copy.resum():
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
