"""The explicit state of a sliding window: plain arrays that compiled code takes and steps in place.

A window of N slots with d features is one `WindowArrays`, a tuple of arrays. There is no hidden state: a copy of the
arrays is a copy of the window. Only the first ``C[COUNT]`` slots are in use. The names below index the rows of ``V``
and ``U``, and the elements of ``F`` and ``C``.

A call from Python costs some 0.15 µs for each array that it hands over, which is more than half of a prediction. The
*handle* of a window is one array that holds the addresses and sizes of all of them.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray, IntArray


class WindowArrays(NamedTuple):
    """State of a window. R is the kernel matrix of (2.27) with the noise variances, P its inverse.

    P : (N, N). Inverse form: the lower triangle is R^-1 *before* the pending rank-2 term P - m m' + q q' (rows MINUS
        and PLUS of V). Cholesky form: L with R = L L', in the order of ``order``; L[i, j] is P[order[j], i - j].
    R : (N, N) Omega + 1/gamma, both triangles.
    X : (d, N) features.  scaled : (d, N) features divided by their widths.  inverse_widths : (d,).
    S : (N,) P 1; in the Cholesky form L^-1 1, by position.
    V : (ROWS, N) vectors.  U : (UNDO_ROWS, max(N, 1 + d)) what a refused step restores.  F : floats.  C : counters.
    order : (N,) slot at each position of the factor (Cholesky form).  point : (d,) scratch.
    kept : what a refused step of the Cholesky form begins at, see there: (N (N + 1)/2,) the factor as it was some steps
        ago, then KEPT_STEPS times (N + 1,). No part of the state: where LOGGED is 0 it holds nothing.
    """

    P: FloatArray
    R: FloatArray
    X: FloatArray
    scaled: FloatArray
    inverse_widths: FloatArray
    S: FloatArray
    V: FloatArray
    U: FloatArray
    F: FloatArray
    C: IntArray
    order: IntArray
    point: FloatArray
    kept: FloatArray


# Rows of V. Y: targets. ALPHA: dual weights. SY: P y (Cholesky form: L^-1 y, by position). MINUS,
# PLUS: the pending rank-2 term. PK: the column that the last replacement took out of P. The others are scratch.
Y, ALPHA, SY, MINUS, PLUS, COLUMN, Z, PK, BITS, TRIAL, K = range(11)
ROWS = 11

# Rows of U. UNDO_POINT: beta, then the features of the slot.
UNDO_S, UNDO_SY, UNDO_ALPHA, UNDO_R, UNDO_POINT = range(5)
UNDO_ROWS = 5

# Elements of F. BETA: the bias b of (2.29). GRAM: square root of 1'P 1.
GAMMA, RESIDUAL, ROUND_WORST, LAST_WORST, UNDO_Y, TOLERANCE, BETA, GRAM = range(8)
FLOATS = 8

# Elements of C. UNDO: kind of the step that can be taken back.
(
    COUNT,
    FORM,
    PENDING,
    UNDO,
    UNDO_SLOT,
    CURSOR,
    STEPS,
    BAD_INPUTS,
    ILL_STEPS,
    RESIDUALS_EXCEEDED,
    REFINEMENTS,
    REFRESHES,
    UNDONE,
    ROUNDS,
) = range(14)
COUNTERS = 14
#: In the Cholesky form, which has no pending term: replacements since the factor was copied to ``kept``; 0 without one.
LOGGED = PENDING
#: So many replacements share a copy of the factor. A refused step makes all but the last of them once more.
KEPT_STEPS = 16

#: The counters that add up over a window's life.
EVENTS = slice(STEPS, COUNTERS)

#: Largest size of a feature or a target that is taken. They are normalised, of order 1.
MOST = 1e9
#: Range of gamma, one over a sample's noise variance. Outside, double precision cannot tell noise from kernel.
LEAST_PRECISION, MOST_PRECISION = 1e-15, 1e15

#: A refinement that leaves more than this share of the residual that called for it shows a wrong factorisation ...
CONTRACTION = 0.5
#: ... unless the residual is below this share of target and weights: then it is rounding.
NEGLIGIBLE = 1e-13
#: The Schur complement of a new sample is at least its noise variance 1/gamma. Below this share of it, P is wrong.
SCHUR_SHARE = 0.5
#: Where a sample alone determines the bias, no more than this share of its diagonal element is left.
UNDETERMINED = 1e-13
#: A few units in the last place of the terms of a row's residual.
ROUND_OFF = 1e-15

# Values of C[UNDO].
UNDO_NOTHING, UNDO_REPLACE, UNDO_APPEND = range(3)

# Values of C[FORM].
INVERSE_FORM, CHOLESKY_FORM = range(2)


class Status(IntEnum):
    """Result of a step of the window. After all but ACCEPTED the window is as it was before."""

    ACCEPTED = 0
    #: A value that is not finite or larger than MOST.
    BAD_INPUT = 1
    #: The step would have left the finite numbers or lost positive definiteness.
    ILL_CONDITIONED = 2
    #: No such slot: out of range, or no free slot in a full window.
    NO_SLOT = 3


ACCEPTED, BAD_INPUT, ILL_CONDITIONED, NO_SLOT = range(4)


def allocate(capacity: int, widths: FloatArray, gamma: float, tolerance: float, form: int) -> WindowArrays:
    """An empty window of ``capacity`` slots. All arrays are C-ordered; steps allocate nothing.

    ``widths`` (d,), ``tolerance``: relative error of alpha from which a step is followed by a refinement.
    """
    dimension = widths.size
    F = np.zeros(FLOATS)
    F[GAMMA], F[TOLERANCE] = gamma, tolerance
    C = np.zeros(COUNTERS, dtype=np.int64)
    C[FORM] = form
    return WindowArrays(
        P=np.zeros((capacity, capacity)),
        R=np.zeros((capacity, capacity)),
        X=np.zeros((dimension, capacity)),
        scaled=np.zeros((dimension, capacity)),
        inverse_widths=1.0 / widths,
        S=np.zeros(capacity),
        V=np.zeros((ROWS, capacity)),
        U=np.zeros((UNDO_ROWS, max(capacity, 1 + dimension))),
        F=F,
        C=C,
        order=np.arange(capacity, dtype=np.int64),
        point=np.zeros(dimension),
        kept=np.zeros(kept_size(capacity)),
    )


def kept_size(capacity: int) -> int:
    """Elements of ``kept``. Fresh zeros take no memory before they are written: in the inverse form, never."""
    return capacity * (capacity + 1) // 2 + KEPT_STEPS * (capacity + 1)


def forget_kept(arrays: WindowArrays) -> None:
    """Give up the copy of the factor in ``kept``: the next replacement makes one. No result depends on this."""
    if arrays.C[FORM] == CHOLESKY_FORM:
        arrays.C[LOGGED] = 0


def duplicate(arrays: WindowArrays) -> WindowArrays:
    """An independent copy of the whole state."""
    fields = {name: field.copy() for name, field in arrays._asdict().items() if name != "kept"}
    copied = WindowArrays(**fields, kept=np.zeros(arrays.kept.size))
    forget_kept(copied)
    return copied


def take_over(arrays: WindowArrays, source: WindowArrays) -> None:
    """Write the state of ``source``, a window of the same sizes, into ``arrays`` in place."""
    for name, field, other in zip(arrays._fields, arrays, source, strict=True):
        if name != "kept":
            field[...] = other
    forget_kept(arrays)


# --- The handle of a window: one array in place of all of them.

_FIELDS = len(WindowArrays._fields)


def handle_of(arrays: WindowArrays) -> IntArray:
    """(39,) addresses of all arrays, then two sizes of each. Valid only while these arrays live: keep both together.

    Raises TypeError where an array is not C-ordered float64 or int64, as `allocate` makes them.
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
        _matrix(h, 0), _matrix(h, 1), _matrix(h, 2), _matrix(h, 3), _vector(h, 4), _vector(h, 5), _matrix(h, 6),
        _matrix(h, 7), _vector(h, 8), _integers(h, 9), _integers(h, 10), _vector(h, 11),
        _vector(h, 12),
    )  # fmt: skip
