"""Simulation of chains: the layout that the compiled loop runs, and the loop itself.

The loop calls the block of one effect after the other by its address, each over all samples. Adding or editing an
effect therefore compiles nothing but its own file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.effects.base import SENSOR_FROM, Chain, Context, Place
from dehyst.sim.effects.counter_noise import stream

IntArray = NDArray[np.int64]
_intrinsic: Any = intrinsic


@_intrinsic  # type: ignore[untyped-decorator]
def _call(
    typing: Any, address: Any, p: Any, s: Any, x: Any, v: Any, w: Any, n: Any, k0: Any
) -> Any:  # pragma: no cover - runs in the compiler
    """Call the machine code at ``address`` with five pointers (as integers) and two counts."""
    signature = types.void(*([types.intp] * 6), types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        double_pointer = ir.DoubleType().as_pointer()
        integer = ir.IntType(64)
        function = ir.FunctionType(ir.VoidType(), [double_pointer] * 5 + [integer] * 2)
        target = builder.inttoptr(args[0], function.as_pointer())
        pointers = [builder.inttoptr(a, double_pointer) for a in args[1:6]]
        builder.call(target, [*pointers, args[6], args[7]])
        return context.get_dummy_value()

    return signature, generate


@compiled
def run_chain(
    addresses: Any,
    axes: Any,
    p_at: Any,
    s_at: Any,
    marks: Any,
    p: Any,
    s: Any,
    x: Any,
    v: Any,
    w: Any,
    true: Any,
    k0: int,
) -> None:
    """Run all effects over the samples in ``x`` (axes, n), in place.

    ``marks`` are the indices of the effects before which the voltage at the actuator is copied to ``v``, the
    displacements of both axes are exchanged into ``w`` (negative: ``w`` stays as given), and the true displacement is
    copied to ``true``.
    """
    n = x.shape[1]
    for i in range(addresses.shape[0] + 1):
        if i == marks[0]:
            v[:, :] = x
        if i == marks[1]:
            for k in range(n):
                w[0, k] = x[1, k]
                w[1, k] = x[0, k]
        if i == marks[2]:
            true[:, :] = x
        if i < addresses.shape[0]:
            row = axes[i] * n * 8
            _call(
                np.intp(addresses[i]),
                np.intp(p.ctypes.data + p_at[i] * 8),
                np.intp(s.ctypes.data + s_at[i] * 8),
                np.intp(x.ctypes.data + row),
                np.intp(v.ctypes.data + row),
                np.intp(w.ctypes.data + row),
                n,
                k0,
            )


def _contexts(chain: Chain, dt_s: float, seed: int, axis: int) -> list[Context]:
    """The context of each effect. Raises InputError where an effect lacks what it acts on."""
    names = {e.name for e in chain}
    start = Context(dt_s)
    for effect in chain:
        kind = effect.kind
        if kind.needs and not names.intersection(kind.needs):
            raise InputError(
                f"effects: {effect.label} got nothing to act on, expected {' or '.join(kind.needs)} in the chain"
            )
        if kind.shares is not None:
            start = kind.shares(effect.values, start)
    return [dataclasses.replace(start, seed=stream(seed, axis, e.label)) for e in chain]


@dataclass(frozen=True, slots=True)
class Plan:
    """Chains of one or two axes, laid out as arrays for the compiled loop. Made by `plan`."""

    addresses: IntArray
    axes: IntArray
    p_at: IntArray
    s_at: IntArray
    marks: IntArray
    p: FloatArray
    rest: FloatArray
    n_axes: int

    def run(
        self, s: FloatArray, x: FloatArray, k0: int, other_um: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Run the commands ``x`` (axes, n) V, which become the readings µm in place; ``s`` is advanced in place.

        ``k0`` is the index of the reading after ``x[:, 0]``. ``other_um`` (n,) is the displacement of the other axis
        where only one is simulated. Returns the true displacements, before the sensor, and the voltages at the
        actuator, (axes, n) each.
        """
        v, true = np.empty_like(x), np.empty_like(x)
        w = np.zeros_like(x) if other_um is None else np.ascontiguousarray(other_um, dtype=np.float64).reshape(x.shape)
        run_chain(self.addresses, self.axes, self.p_at, self.s_at, self.marks, self.p, s, x, v, w, true, k0)
        return true, v


def plan(chains: tuple[Chain, ...], dt_s: float, seed: int = 0) -> Plan:
    """Lay out the chains of one or two axes. Takes some tens of µs and compiles nothing anew."""
    items: list[tuple[Place, int, int, list[float], list[float]]] = []
    for axis, chain in enumerate(chains):
        for effect, context in zip(chain, _contexts(chain, dt_s, seed, axis), strict=True):
            if effect.kind.block is None:
                continue
            values = effect.values
            p, s = list(effect.kind.derive(values, context)), list(effect.kind.rest(values, context))
            items.append((effect.kind.place, axis, effect.kind.block.address, p, s))
    items.sort(key=lambda item: item[0])
    places = [item[0] for item in items]

    def first(place: Place) -> int:
        return next((i for i, p in enumerate(places) if p >= place), len(places))

    sizes_p = [0, *(len(item[3]) for item in items)]
    sizes_s = [0, *(len(item[4]) for item in items)]
    return Plan(
        addresses=np.array([item[2] for item in items], dtype=np.int64),
        axes=np.array([item[1] for item in items], dtype=np.int64),
        p_at=np.cumsum(sizes_p)[:-1].astype(np.int64),
        s_at=np.cumsum(sizes_s)[:-1].astype(np.int64),
        marks=np.array(
            [first(Place.ACTUATOR), first(Place.CROSS_TALK) if len(chains) == 2 else -1, first(SENSOR_FROM)],
            dtype=np.int64,
        ),
        # one extra number, so that the pointer of a last effect without coefficients is valid
        p=np.array([v for item in items for v in item[3]] + [0.0], dtype=np.float64),
        rest=np.array([v for item in items for v in item[4]] + [0.0], dtype=np.float64),
        n_axes=len(chains),
    )


def simulate(
    chain: Chain,
    u_V: FloatArray,
    dt_s: float,
    *,
    params: Mapping[str, float] | None = None,
    other_um: FloatArray | None = None,
    seed: int = 0,
) -> FloatArray:
    """Readings ``y_um`` (n,) of one axis, at rest at 0 V, to which the commands ``u_V`` (n,) are applied.

    ``y_um[k]`` is read at ``t_k``; ``u_V[k]`` is held from ``t_k`` to ``t_(k+1)`` and does not change it. ``params``
    changes parameters by ``label.parameter`` without compiling anew. ``other_um`` (n,) is the displacement of the
    other axis at ``t_k``, for `cross_talk`. Raises InputError on bad arrays, names and values.
    """
    u = np.asarray(u_V, dtype=np.float64)
    if u.ndim != 1 or u.size == 0 or not np.all(np.isfinite(u)):
        raise InputError(
            f"u_V: got shape {u.shape}, expected a one-dimensional array of finite voltages; repair it first"
        )
    if other_um is not None and np.shape(other_um) != u.shape:
        raise InputError(f"other_um: got shape {np.shape(other_um)}, expected that of u_V, {u.shape}")
    layout = plan((chain if params is None else chain.replace(params),), dt_s, seed)
    # the reading at t_0 follows from one step at rest before it
    x = np.concatenate(([0.0], u[:-1]))[None, :].copy()
    layout.run(layout.rest.copy(), x, 0, other_um)
    reading: FloatArray = x[0]
    return reading
