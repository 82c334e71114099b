"""The windows of all axes on the processor: the single learner's own compiled steps, in loops over the axes.

A step of a window reads and writes one triangle once, which operations of torch cannot do; that is why the processor
has this form. Some threads share the axes. Each axis is stepped by one of them, so the result does not depend on their
number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.fleet.state import Fixed, Rows
from dehyst.adaptive.online import kernel_window as window
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import COUNT, ILL_CONDITIONED, WindowArrays, arrays_of

#: Fewest axes for which a second thread is worth its wake-up.
_LEAST_AXES = 16


class Threads:
    """Some threads that share a loop over axes; for several callers at once."""

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count - 1, "fleet") if count > 1 else None
        self._count = count

    def share(self, count: int, work: Callable[..., None], *arguments: object) -> None:
        """``work(lo, hi, ...)`` over ``count`` axes, in parts on the threads."""
        parts = max(1, min(self._count, count // _LEAST_AXES))
        ends = [count * i // parts for i in range(parts + 1)]
        pool = self._pool
        others = [pool.submit(work, ends[i], ends[i + 1], *arguments) for i in range(1, parts)] if pool else []
        work(0, ends[1], *arguments)
        for one in others:
            one.result()


@compiled
def _predict(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, out: FloatArray) -> None:
    for k in range(lo, hi):
        out[k] = steps.predict(arrays_of(handles[axes[k]]), s.point[axes[k]])


@compiled
def learn(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, c: Fixed, w: Any, out: IntArray) -> None:
    """`ResidualWindow.learn` of each axis."""
    fifo = c.config[0].fifo
    for k in range(lo, hi):
        b = axes[k]
        A, r = arrays_of(handles[b]), s.numbers[b].window
        empty = A.C[COUNT] == 0
        status = window.learn(A, r, s.point[b], w[b].target_V, s.born[b], fifo)
        # An empty window has nothing that a new factorisation could mend.
        out[k] = ws.BAD_INPUT if empty and status == ILL_CONDITIONED else status


@compiled
def let_go(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, c: Fixed) -> None:
    """`ResidualWindow.let_go` of each axis."""
    most = c.config[0].before_change
    for k in range(lo, hi):
        b = axes[k]
        window.let_go(arrays_of(handles[b]), s.numbers[b].window, most, s.born[b])


class CompiledWindows:
    """Windows of B axes, stepped by compiled code. ``axes`` (k,) are numbers of axes, without repeats."""

    #: Whether ``arrays`` gives the state itself, not a copy.
    shares = True

    def __init__(self, rows: Rows, fixed: Fixed, starts: Sequence[WindowArrays], threads: Threads) -> None:
        """``starts`` : what each window begins as."""
        self._rows, self._fixed, self._threads = rows, fixed, threads
        #: What windows begin as whose matrices are not written yet. It would take seconds to write all of them at once.
        self.unwritten = dict(enumerate(starts))
        small = (name for name in WindowArrays._fields if name not in ("P", "R", "kept"))
        self._all = {name: np.array([getattr(start, name) for start in starts]) for name in small}
        # They take memory as they are written: ``kept``, in the inverse form, never.
        self._all["kept"] = np.zeros((len(starts), starts[0].kept.size))
        matrices = np.empty((len(starts), 2, *starts[0].P.shape))
        self._views = [
            WindowArrays(*pair, **{name: field[axis] for name, field in self._all.items()})
            for axis, pair in enumerate(matrices)
        ]
        for view in self._views:
            ws.forget_kept(view)
        self._handles = np.array([ws.handle_of(view) for view in self._views])

    def write(self, axes: Iterable[int]) -> None:
        """Write the matrices that the windows of ``axes`` begin with, where they are not yet. No step before that."""
        for axis in self.unwritten.keys() & axes:
            start = self.unwritten.pop(axis)
            self._views[axis].P[...], self._views[axis].R[...] = start.P, start.R

    def arrays(self, axis: int) -> WindowArrays:
        """The solver's state of an axis: views, stepped in place by whoever has them, after `write`."""
        return self._views[axis]

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver; nothing where it is the axis' own."""
        if arrays is not self._views[axis]:
            self.unwritten.pop(axis, None)
            ws.take_over(self._views[axis], arrays)

    def samples(self) -> dict[str, FloatArray]:
        """The windows' arrays by name; views."""
        return self._all

    def predict(self, axes: IntArray) -> FloatArray:
        """(k,) kernel parts, V, at the present points of ``axes``."""
        out = np.empty(axes.size)
        self._threads.share(axes.size, _predict, self._handles, axes, self._rows, out)
        return out

    def learn(self, axes: IntArray, w: Any) -> IntArray:
        """(k,) status of one step of each window with its record of ``w``; see `ResidualWindow.learn`."""
        self.write(axes.tolist())
        out = np.empty(axes.size, dtype=np.int64)
        self._threads.share(axes.size, learn, self._handles, axes, self._rows, self._fixed, w, out)
        return out

    def let_go(self, axes: IntArray) -> None:
        """`ResidualWindow.let_go` of each axis."""
        self.write(axes.tolist())
        self._threads.share(axes.size, let_go, self._handles, axes, self._rows, self._fixed)
