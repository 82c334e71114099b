"""The windows of all axes on the processor: the single learner's own compiled steps, in loops over the axes.

A step of a window reads and writes one triangle once, which operations of torch cannot do; that is why the processor
has this form. Some threads share the axes. Each axis is stepped by one of them, so the result does not depend on their
number.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from adaptive.compiled import compiled
from adaptive.fleet.state import Rows
from adaptive.online.kernel_window import NOWHERE, SAME
from adaptive.types import FloatArray, IntArray
from adaptive.window import arrays as ws
from adaptive.window import steps
from adaptive.window.arrays import ACCEPTED, COUNT, ILL_CONDITIONED, WindowArrays, arrays_of

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


class Step(NamedTuple):
    """One sample for each of k windows: points (k, d), targets in V and noise weights (k,).

    fade_steps : half-life in steps of a window, 0 for none. fifo : whether the oldest sample makes way.
    """

    points: FloatArray
    targets: FloatArray
    weights: FloatArray
    fade_steps: float
    fifo: bool


@compiled
def _predict(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, out: FloatArray) -> None:
    for k in range(lo, hi):
        out[k] = steps.predict(arrays_of(handles[axes[k]]), s.point[axes[k]])


@compiled
def learn(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, step: Step, out: IntArray) -> None:
    """`ResidualWindow.learn` and ``fade`` of each axis."""
    for k in range(lo, hi):
        b, x, weight = axes[k], step.points[k], step.weights[k]
        A, r = arrays_of(handles[b]), s.numbers[b]
        n = A.C[COUNT]
        slot, value = steps.nearest(A, x)
        r["clock"] += 1
        room = n < A.S.shape[0] and value < SAME
        if room:
            slot = n
            status = steps.append(A, x, step.targets[k], weight)
        else:
            if step.fifo:
                slot = int(np.argmin(s.born[b, :n]))
            status = steps.replace(A, slot, x, step.targets[k], weight)
        if status == ACCEPTED:
            s.born[b, slot] = r.clock
            s.own[b, slot] = weight
        out[k] = status if status != ILL_CONDITIONED or n > 0 else ws.BAD_INPUT
        fade(A, r.clock, s.born[b], s.own[b], step.fade_steps)


@compiled
def fade(A: WindowArrays, clock: int, born: IntArray, own: FloatArray, fade_steps: float) -> None:
    """`ResidualWindow.fade` of one axis."""
    n = A.C[COUNT]
    if fade_steps > 0.0 and n > 0:
        slot = clock % n
        age = float(clock - born[slot]) / fade_steps
        steps.reweight(A, slot, own[slot] * max(0.5**age, 1e-3))


@compiled
def fade_alone(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, fade_steps: float) -> None:
    """`fade` of each axis."""
    for k in range(lo, hi):
        b = axes[k]
        fade(arrays_of(handles[b]), s.numbers[b].clock, s.born[b], s.own[b], fade_steps)


@compiled
def let_go(lo: int, hi: int, handles: IntArray, axes: IntArray, s: Rows, most: float) -> None:
    """`ResidualWindow.let_go` of each axis."""
    for k in range(lo, hi):
        b = axes[k]
        A, r = arrays_of(handles[b]), s.numbers[b]
        found = False
        while 0 <= r.next < A.C[COUNT] and not found:
            slot = r.next
            r["next"] += 1
            if s.born[b, slot] <= r.changed and s.own[b, slot] > most:
                found = True
                if steps.reweight(A, slot, most) == ACCEPTED:
                    s.own[b, slot] = most
        if not found:
            r["next"] = NOWHERE


class CompiledWindows:
    """Windows of B axes, stepped by compiled code. ``axes`` (k,) are numbers of axes, without repeats."""

    #: Whether ``arrays`` gives the state itself, not a copy.
    shares = True

    def __init__(self, rows: Rows, example: WindowArrays, threads: Threads) -> None:
        B = rows.x.shape[0]
        self._rows, self._threads = rows, threads
        self._all = {name: np.zeros((B, *field.shape), field.dtype) for name, field in example._asdict().items()}
        self._views = [WindowArrays(**{name: field[b] for name, field in self._all.items()}) for b in range(B)]
        self._handles = np.array([ws.handle_of(view) for view in self._views])

    def arrays(self, axis: int) -> WindowArrays:
        """The solver's state of an axis: views, stepped in place by whoever has them."""
        return self._views[axis]

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver; nothing where it is the axis' own."""
        if arrays is not self._views[axis]:
            ws.take_over(self._views[axis], arrays)

    def samples(self) -> dict[str, FloatArray]:
        """The windows' arrays by name; views."""
        return self._all

    def predict(self, axes: IntArray) -> FloatArray:
        """(k,) kernel parts, V, at the present points of ``axes``."""
        out = np.empty(axes.size)
        self._threads.share(axes.size, _predict, self._handles, axes, self._rows, out)
        return out

    def learn(self, axes: IntArray, step: Step) -> IntArray:
        """(k,) status of one step of each window; see `ResidualWindow.learn` and ``fade``."""
        out = np.empty(axes.size, dtype=np.int64)
        self._threads.share(axes.size, learn, self._handles, axes, self._rows, step, out)
        return out

    def let_go(self, axes: IntArray, most: float) -> None:
        """`ResidualWindow.let_go` of each axis."""
        self._threads.share(axes.size, let_go, self._handles, axes, self._rows, most)
