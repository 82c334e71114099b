"""Refreshing a window's factorisation beside its work: begin, factor elsewhere, catch up, swap.

A refresh costs O(N³), some hundred steps' worth. It is split in three: `begin` copies the state (on the
stepping thread, O(N²)), `Refresh.factor` does the work on any thread without the interpreter's lock, `finish`
(again on the stepping thread) carries over what was learnt meanwhile, one ordinary step a changed slot, and
swaps the arrays in.
"""

from __future__ import annotations

import numpy as np

from adaptive import window_state as ws
from adaptive.errors import NumericsError
from adaptive.window import Window
from adaptive.window_state import IntArray


class Refresh:
    """One refresh under way."""

    def __init__(self, window: Window) -> None:
        self._source = window
        self._copy = window.copy()
        self._count = len(window)
        self._factored = False

    def factor(self) -> None:
        """Factor the copy. Any thread. Raises NumericsError where R is not positive definite."""
        self._copy.rebuild()
        self._factored = True

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
        same_form = source.C[ws.FORM] == copy.arrays.C[ws.FORM]
        if not self._factored or n < self._count or not same_form:
            return False
        y, w = source.V[ws.Y], source.V[ws.W]
        for slot in self.changed_slots():
            if copy.replace(int(slot), np.ascontiguousarray(source.X[:, slot]), y[slot], w[slot]) != ws.ACCEPTED:
                return False
        for slot in range(self._count, n):
            if copy.append(np.ascontiguousarray(source.X[:, slot]), y[slot], w[slot]) != ws.ACCEPTED:
                return False
        copy.arrays.V[ws.Y, :n] = y[:n]
        refreshes = copy.arrays.C[ws.REFRESHES]
        copy.arrays.C[ws.CURSOR : ws.COUNTERS] = source.C[ws.CURSOR : ws.COUNTERS]
        copy.arrays.C[ws.REFRESHES] = refreshes
        copy.arrays.F[ws.RESIDUAL : ws.LAST_WORST + 1] = source.F[ws.RESIDUAL : ws.LAST_WORST + 1]
        if not copy.resum():
            return False
        copy.arrays.C[ws.UNDO] = ws.UNDO_NOTHING
        self._source.arrays = copy.arrays
        return True


def begin(window: Window) -> Refresh:
    """Start refreshing ``window``, which may go on stepping. Raises NumericsError while it is empty."""
    if len(window) == 0:
        raise NumericsError("refresh: the window is empty, there is nothing to factor; wait for samples")
    return Refresh(window)
