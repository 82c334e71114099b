"""Predictions of a window that is handed to compiled code as one array of addresses.

Each array that compiled code takes over costs some 0.15 µs, so that a window's sixteen cost more than half of a
prediction. Its *handle* holds where they are and how large; the compiled side looks at the same memory through it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from adaptive.compiled import compiled
from adaptive.types import FloatArray
from adaptive.window import steps as window_core
from adaptive.window.arrays import IntArray, WindowArrays

_FIELDS = len(WindowArrays._fields)
_predict = window_core.predict
_predict_with_variance = window_core.predict_with_variance


def handle_of(arrays: WindowArrays) -> IntArray:
    """(48,) addresses, then two sizes each. Valid as long as these very arrays live: whoever keeps one keeps both.

    Raises TypeError where an array is not what `window_state.allocate` makes.
    """
    handle = np.zeros(3 * _FIELDS, dtype=np.int64)
    for i, array in enumerate(arrays):
        if not array.flags.c_contiguous or array.dtype not in (np.float64, np.int64):
            raise TypeError(f"{WindowArrays._fields[i]}: a C-ordered array of float64 or int64 is needed")
        handle[i] = array.ctypes.data
        handle[_FIELDS + 2 * i : _FIELDS + 2 * i + array.ndim] = array.shape
    return handle


def _to_pointer(context: Any, address: Any) -> Any:
    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], target.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


_pointer: Any = intrinsic(_to_pointer)


@compiled
def _matrix(h: IntArray, i: int) -> FloatArray:  # pragma: no cover - compiled
    return carray(_pointer(h[i]), (h[_FIELDS + 2 * i], h[_FIELDS + 2 * i + 1]), np.float64)


@compiled
def _vector(h: IntArray, i: int) -> FloatArray:  # pragma: no cover - compiled
    return carray(_pointer(h[i]), (h[_FIELDS + 2 * i],), np.float64)


@compiled
def _integers(h: IntArray, i: int) -> IntArray:  # pragma: no cover - compiled
    return carray(_pointer(h[i]), (h[_FIELDS + 2 * i],), np.int64)


@compiled
def arrays_of(h: IntArray) -> WindowArrays:  # pragma: no cover - compiled
    """The window behind a handle, in the order of `WindowArrays`."""
    return WindowArrays(
        _matrix(h, 0), _matrix(h, 1), _matrix(h, 2), _matrix(h, 3), _vector(h, 4), _matrix(h, 5), _matrix(h, 6),
        _matrix(h, 7), _vector(h, 8), _integers(h, 9), _matrix(h, 10), _matrix(h, 11), _vector(h, 12),
        _integers(h, 13), _integers(h, 14), _matrix(h, 15),
    )  # fmt: skip


@compiled
def predict(handle: IntArray, x: FloatArray) -> float:  # pragma: no cover - compiled
    """`window_core.predict`."""
    return _predict(arrays_of(handle), x)


@compiled
def predict_with_variance(handle: IntArray, x: FloatArray) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """`window_core.predict_with_variance`."""
    return _predict_with_variance(arrays_of(handle), x)
