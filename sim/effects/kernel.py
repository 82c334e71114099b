"""The chain's loop: calls the blocks of all effects one after the other, each over all samples.

Blocks are called by address, so that adding an effect or editing one compiles nothing but its own file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from adaptive.compiled import compiled

_intrinsic: Any = intrinsic


@_intrinsic  # type: ignore[untyped-decorator]
def _call(
    typing: Any, address: Any, p: Any, s: Any, x: Any, v: Any, w: Any, n: Any, k0: Any
) -> Any:  # pragma: no cover - runs in the compiler
    """Call the machine code at ``address`` with five pointers, given as integers, and two counts."""
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

    ``marks``: index of the effect before which the drive voltage is kept in ``v``, the displacements of both axes
    are crossed into ``w`` (negative: leave ``w`` as given), and the true displacement is kept in ``true``.
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
