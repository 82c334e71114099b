"""The matrices of all axes on the processor: the single learner's own compiled steps, in loops over the axes.

A step of a window reads and writes one triangle once, which operations of torch cannot do; that is why the processor
has this form. Some threads share the axes. Each axis is stepped by one of them, so the result does not depend on their
number.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from adaptive.compiled import compiled
from adaptive.fleet.state import AxisConstants, BatchState
from adaptive.inverse_model import mean_of
from adaptive.online import drift
from adaptive.online.kernel_window import NOWHERE, SAME
from adaptive.types import BoolArray, FloatArray, IntArray
from adaptive.window import arrays as ws
from adaptive.window import steps
from adaptive.window.arrays import COUNT, ILL_CONDITIONED, WindowArrays, arrays_of

#: Fewest axes for which a second thread is worth its wake-up.
_LEAST_AXES = 32


@compiled
def _predict(lo: int, hi: int, handles: IntArray, axes: IntArray, points: FloatArray, out: FloatArray) -> None:
    for k in range(lo, hi):
        out[k] = steps.predict(arrays_of(handles[axes[k]]), points[k])


@compiled
def _frozen(
    lo: int,
    hi: int,
    models: IntArray,
    axes: IntArray,
    basis: FloatArray,
    kernel: FloatArray,
    beta: FloatArray,
    scaled: FloatArray,
    alpha: FloatArray,
    inverse_widths: FloatArray,
    out: FloatArray,
) -> None:
    for k in range(lo, hi):
        m = models[axes[k]]
        out[k] = mean_of(basis[k], kernel[k], beta[m], scaled[m], alpha[m], inverse_widths[m])


@compiled
def _learn(
    lo: int,
    hi: int,
    handles: IntArray,
    axes: IntArray,
    points: FloatArray,
    targets: FloatArray,
    weights: FloatArray,
    fifo: bool,
    fade_steps: float,
    born: IntArray,
    own: FloatArray,
    clock: IntArray,
    out: IntArray,
) -> None:
    """`ResidualWindow.learn` and ``fade`` of each axis; ``fade_steps``: half-life in window steps, 0 for none."""
    for k in range(lo, hi):
        b = axes[k]
        A = arrays_of(handles[b])
        n = A.C[COUNT]
        slot, value = steps.nearest(A, points[k])
        clock[b] += 1
        room = n < A.S.shape[0] and value < SAME
        if room:
            slot = n
        elif fifo:
            slot = int(np.argmin(born[b, :n]))
        if room:
            status = steps.append(A, points[k], targets[k], weights[k])
        else:
            status = steps.replace(A, slot, points[k], targets[k], weights[k])
        if status == ws.ACCEPTED:
            born[b, slot] = clock[b]
            own[b, slot] = weights[k]
        out[k] = status if status != ILL_CONDITIONED or n > 0 else ws.BAD_INPUT
        n = A.C[COUNT]
        if fade_steps > 0.0 and n > 0:
            slot = clock[b] % n
            age = float(clock[b] - born[b, slot]) / fade_steps
            steps.reweight(A, slot, own[b, slot] * max(0.5**age, 1e-3))


@compiled
def _let_go(
    lo: int,
    hi: int,
    handles: IntArray,
    axes: IntArray,
    most: float,
    born: IntArray,
    own: FloatArray,
    changed: IntArray,
    following: IntArray,
) -> None:
    """`ResidualWindow.let_go` of each axis."""
    for k in range(lo, hi):
        b = axes[k]
        A = arrays_of(handles[b])
        found = False
        while 0 <= following[b] < A.C[COUNT] and not found:
            slot = following[b]
            following[b] += 1
            if born[b, slot] <= changed[b] and own[b, slot] > most:
                found = True
                if steps.reweight(A, slot, most) == ws.ACCEPTED:
                    own[b, slot] = most
        if not found:
            following[b] = NOWHERE


@compiled
def _drift(
    lo: int,
    hi: int,
    axes: IntArray,
    basis: FloatArray,
    targets: FloatArray,
    moving: BoolArray,
    weights: FloatArray,
    x: FloatArray,
    P: FloatArray,
    walks: FloatArray,
    bursts: FloatArray,
    span: FloatArray,
    limits: FloatArray,
    squares: FloatArray,
    counts: IntArray,
    out: IntArray,
) -> None:
    """`DriftFilter.update` of each axis: 0 updated, 1 outlier, 2 burst into ``out``. See `drift_limits`.

    squares (B, 2) : fast and slow mean square innovation. counts (B, 4) : rejected, quiet, bursts, updates.
    """
    gain_walk2, burst_gain2, noise_share, floor_share, ratio, gate2, most_rejected, fast, slow, step_s = limits
    p = x.shape[1]
    row, gain = np.empty(p), np.empty(p)
    for k in range(lo, hi):
        b, h, z = axes[k], basis[k], targets[k]
        if moving[k]:
            drift.walk(x[b], P[b], walks[b], gain_walk2)
        else:
            P[b, 0, 0] += walks[b, 0]
        innovation, variance = drift.innovation_of(x[b], P[b], h, z, row)
        noise = (noise_share * span[b]) ** 2 / weights[k]
        squared = innovation * innovation
        if squared > gate2 * (variance + noise) and counts[b, 0] < most_rejected:
            counts[b, 0] += 1
            out[k] = 1
            continue
        counts[b, 0] = 0
        squares[b, 0] += (squared - squares[b, 0]) * fast
        counts[b, 1] += 1
        out[k] = 0
        threshold = max(ratio * squares[b, 1], (floor_share * span[b]) ** 2)
        if squares[b, 0] > threshold and counts[b, 1] * step_s > drift.DEAD_S and moving[k]:
            drift.walk(x[b], P[b], bursts[b], burst_gain2)
            counts[b, 1] = 0
            counts[b, 2] += 1
            out[k] = 2
            innovation, variance = drift.innovation_of(x[b], P[b], h, z, row)
        squares[b, 1] += (min(squared, threshold) - squares[b, 1]) * slow
        if moving[k]:
            drift.take_in(x[b], P[b], h, innovation, variance, noise, gain, row)
        else:
            drift.update_constant(x[b], P[b], h, z, noise, row)
        counts[b, 3] += 1


class CompiledMatrices:
    """Windows and drift filters of B axes, stepped by compiled code. See `adaptive.fleet.fleet.Matrices`."""

    shares = True

    def __init__(self, constants: AxisConstants, state: BatchState, example: WindowArrays, threads: int) -> None:
        self._c, self._s = constants, state
        B = constants.axes
        self._all = {name: np.zeros((B, *field.shape), field.dtype) for name, field in example._asdict().items()}
        self._views = [WindowArrays(**{name: field[b] for name, field in self._all.items()}) for b in range(B)]
        self._handles = np.array([ws.handle_of(view) for view in self._views])
        self._pool = ThreadPoolExecutor(threads, "fleet") if threads > 1 else None
        self._threads = threads

    def arrays(self, axis: int) -> WindowArrays:
        """The solver's state of an axis: views, stepped in place by whoever has them."""
        return self._views[axis]

    def put(self, axis: int, arrays: WindowArrays) -> None:
        """Take over the state of a solver; nothing where it is the axis' own."""
        if arrays is not self._views[axis]:
            ws.take_over(self._views[axis], arrays)

    def samples(self) -> tuple[Tensor, ...]:
        """See `adaptive.fleet.snapshot.Samples`; views."""
        V, F, C = self._all["V"], self._all["F"], self._all["C"]
        parts = (self._all["scaled"], V[:, ws.ALPHA], F[:, ws.BETA], C[:, COUNT], self._all["inverse_widths"])
        return tuple(torch.from_numpy(part) for part in (*parts, F[:, ws.GAMMA]))

    def predict(self, axes: Tensor, points: Tensor) -> Tensor:
        """(k,) kernel parts, V, at ``points`` (k, d) of ``axes`` (k,)."""
        out = torch.empty(axes.shape[0], dtype=torch.float64)
        at, x, u = axes.numpy(), points.contiguous().numpy(), out.numpy()
        self._share(axes.shape[0], _predict, self._handles, at, x, u)
        return out

    def frozen(self, axes: Tensor, basis: Tensor, kernel: Tensor) -> Tensor:
        """(k,) voltages of the identified models, V, at inputs (k, p) and (k, d)."""
        c, out = self._c, torch.empty(axes.shape[0], dtype=torch.float64)
        at, g, x, u = axes.numpy(), basis.contiguous().numpy(), kernel.contiguous().numpy(), out.numpy()
        m = [part.numpy() for part in (c.model_beta, c.model_scaled, c.model_alpha, c.model_inverse_widths)]
        models = c.model_of.numpy()
        self._share(axes.shape[0], _frozen, models, at, g, x, *m, u)
        return out

    def learn(self, axes: Tensor, points: Tensor, targets: Tensor, weights: Tensor, fade_steps: float) -> Tensor:
        """(k,) status of one step of each window; see `ResidualWindow.learn` and ``fade``."""
        out = torch.empty(axes.shape[0], dtype=torch.int64)
        given = [part.contiguous().numpy() for part in (points, targets, weights)]
        at, said, fifo = axes.numpy(), out.numpy(), self._c.config.learner.eviction == "fifo"
        kept = [self._s[f"window.{name}"].numpy() for name in ("born", "own_weights", "clock")]
        self._share(axes.shape[0], _learn, self._handles, at, *given, fifo, fade_steps, *kept, said)
        return out

    def let_go(self, axes: Tensor, most: float) -> None:
        """`ResidualWindow.let_go` of each axis."""
        at = axes.numpy()
        kept = [self._s[f"window.{name}"].numpy() for name in ("born", "own_weights", "changed", "next")]
        self._share(axes.shape[0], _let_go, self._handles, at, most, *kept)

    def drift(self, axes: Tensor, basis: Tensor, targets: Tensor, moving: Tensor, weights: Tensor) -> Tensor:
        """(k,) results of an update of each filter: 0 updated, 1 outlier, 2 burst."""
        c, out = self._c, torch.empty(axes.shape[0], dtype=torch.int64)
        given = [part.contiguous().numpy() for part in (basis, targets, moving, weights)]
        kept = [self._s[name].numpy() for name in ("filter.beta", "filter.covariance")]
        noise = [part.numpy() for part in (c.walk_V2, c.burst_V2, c.span_V, c.drift_limits)]
        counted = [self._s[name].numpy() for name in ("filter.squares", "filter.counts")]
        at, said = axes.numpy(), out.numpy()
        self._share(axes.shape[0], _drift, at, *given, *kept, *noise, *counted, said)
        return out

    def _share(self, count: int, work: Callable[..., None], *arguments: object) -> None:
        """``work(lo, hi, ...)`` over ``count`` axes, in parts on the threads."""
        parts = min(self._threads, count // _LEAST_AXES)
        if self._pool is None or parts < 2:
            work(0, count, *arguments)
            return
        ends = [count * i // parts for i in range(parts + 1)]
        others: list[Future[None]] = [
            self._pool.submit(work, ends[i], ends[i + 1], *arguments) for i in range(1, parts)
        ]
        work(ends[0], ends[1], *arguments)
        for one in others:
            one.result()
