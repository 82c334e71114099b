"""The explicit state of a sliding window: plain arrays that compiled code takes and steps in place.

A window of N slots with d features is one `WindowArrays`, a tuple of arrays. There is no hidden state: a copy of the
arrays is a copy of the window. Only the first ``C[COUNT]`` slots are in use. The names below index the rows of ``V``
and ``U``, and the elements of ``F`` and ``C``.

A call from Python costs some 0.15 µs for each array that it hands over, which is more than half of a prediction. The
*handle* of a window is one array that holds the addresses and sizes of all of them.

The two forms are the inverse of the kernel matrix R, and its Cholesky factor; their passes over it are here too.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from dehyst.adaptive.compiled import compiled, compiled_reassociating, dot
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


# --- The handle of arrays: one array in place of all of them.


def handle_of(arrays: Any) -> IntArray:
    """(3 n,) address and two sizes of each of n arrays, a tuple with names. Keep both together: only these are valid.

    Raises TypeError where an array is not C-ordered float64 or int64, of one or two dimensions.
    """
    handle = np.zeros(3 * len(arrays), dtype=np.int64)
    for i, array in enumerate(arrays):
        if not array.flags.c_contiguous or array.dtype not in (np.float64, np.int64) or array.ndim > 2:
            raise TypeError(f"{arrays._fields[i]}: a C-ordered array of float64 or int64 is needed")
        handle[3 * i] = array.ctypes.data
        handle[3 * i + 1 : 3 * i + 1 + array.ndim] = array.shape
    return handle


def _to_pointer(context: Any, address: Any) -> Any:
    def generate(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], target.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


_pointer: Any = intrinsic(_to_pointer)


@compiled
def matrix_of(h: IntArray, i: int) -> FloatArray:  # pragma: no cover - compiled
    """Array i of a handle, of two dimensions."""
    return carray(_pointer(h[3 * i]), (h[3 * i + 1], h[3 * i + 2]), np.float64)


@compiled
def vector_of(h: IntArray, i: int) -> FloatArray:  # pragma: no cover - compiled
    """Array i of a handle, of one dimension."""
    return carray(_pointer(h[3 * i]), (h[3 * i + 1],), np.float64)


@compiled
def integers_of(h: IntArray, i: int) -> IntArray:  # pragma: no cover - compiled
    """Array i of a handle, of integers."""
    return carray(_pointer(h[3 * i]), (h[3 * i + 1],), np.int64)


@compiled
def arrays_of(h: IntArray) -> WindowArrays:  # pragma: no cover - compiled
    """The window behind a handle, in the order of `WindowArrays`."""
    return WindowArrays(
        matrix_of(h, 0), matrix_of(h, 1), matrix_of(h, 2), matrix_of(h, 3), vector_of(h, 4), vector_of(h, 5),
        matrix_of(h, 6), matrix_of(h, 7), vector_of(h, 8), integers_of(h, 9), integers_of(h, 10), vector_of(h, 11),
        vector_of(h, 12),
    )  # fmt: skip


# --- The inverse form: products with P = R^-1, of which only the lower triangle is stored.
# The rank-2 change of P that a step brings stays *pending*, as the vectors m (MINUS) and q (PLUS), until the next
# step multiplies by P. One pass over the triangle then applies the change and multiplies, so that P is read and
# written once a step. A step is refused by dropping its pending term. With a single triangle P cannot lose its
# symmetry, which is what makes such recursions diverge.


#: From this size on four rows at a time are faster than two.
_FOUR_ROWS = 400

# --- The O(N²) passes over the triangle. Two or four rows go together, so that the vectors beside the matrix are read
# once for all of them. The order of the sums is fixed. Inner loops run from 0, some over slices: an index that could
# be negative would be checked for wrapping round, and the loop would not vectorise.


@compiled_reassociating
def advance(P: FloatArray, n: int, m: FloatArray, q: FloatArray, b: FloatArray, z: FloatArray) -> None:
    """P <- P - m m' + q q' and z <- P b with the new P, in one pass over its lower triangle, [:n, :n].

    Written out in one function: a call for each group of rows would cost a third of the time at N = 500.
    """
    for i in range(n):
        z[i] = 0.0
    i = 0
    if n >= _FOUR_ROWS:
        while i + 3 < n:
            m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
            m1, q1, b1, s1 = -m[i + 1], q[i + 1], b[i + 1], 0.0
            m2, q2, b2, s2 = -m[i + 2], q[i + 2], b[i + 2], 0.0
            m3, q3, b3, s3 = -m[i + 3], q[i + 3], b[i + 3], 0.0
            r0, r1, r2, r3 = P[i], P[i + 1], P[i + 2], P[i + 3]
            for j in range(i):
                mj, qj, bj = m[j], q[j], b[j]
                v0 = r0[j] + m0 * mj + q0 * qj
                v1 = r1[j] + m1 * mj + q1 * qj
                v2 = r2[j] + m2 * mj + q2 * qj
                v3 = r3[j] + m3 * mj + q3 * qj
                r0[j] = v0
                r1[j] = v1
                r2[j] = v2
                r3[j] = v3
                s0 += v0 * bj
                s1 += v1 * bj
                s2 += v2 * bj
                s3 += v3 * bj
                z[j] += v0 * b0 + v1 * b1 + v2 * b2 + v3 * b3
            z[i] += s0
            z[i + 1] += s1
            z[i + 2] += s2
            z[i + 3] += s3
            for k in range(i, i + 4):
                for j in range(i, k + 1):
                    v = P[k, j] - m[k] * m[j] + q[k] * q[j]
                    P[k, j] = v
                    z[k] += v * b[j]
                    if j < k:
                        z[j] += v * b[k]
            i += 4
    while i + 1 < n:
        m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
        m1, q1, b1, s1 = -m[i + 1], q[i + 1], b[i + 1], 0.0
        r0, r1 = P[i], P[i + 1]
        for j in range(i):
            mj, qj, bj = m[j], q[j], b[j]
            v0 = r0[j] + m0 * mj + q0 * qj
            v1 = r1[j] + m1 * mj + q1 * qj
            r0[j] = v0
            r1[j] = v1
            s0 += v0 * bj
            s1 += v1 * bj
            z[j] += v0 * b0 + v1 * b1
        v0 = r0[i] + m0 * m[i] + q0 * q[i]
        v1 = r1[i] + m1 * m[i] + q1 * q[i]
        v2 = r1[i + 1] + m1 * m[i + 1] + q1 * q[i + 1]
        r0[i] = v0
        r1[i] = v1
        r1[i + 1] = v2
        z[i] += s0 + v0 * b0 + v1 * b1
        z[i + 1] += s1 + v1 * b0 + v2 * b1
        i += 2
    if i < n:
        m0, q0, b0, s0 = -m[i], q[i], b[i], 0.0
        r0 = P[i]
        for j in range(i):
            v0 = r0[j] + m0 * m[j] + q0 * q[j]
            r0[j] = v0
            s0 += v0 * b[j]
            z[j] += v0 * b0
        v0 = r0[i] + m0 * m[i] + q0 * q[i]
        r0[i] = v0
        z[i] += s0 + v0 * b0


@compiled_reassociating
def product(P: FloatArray, n: int, b: FloatArray, z: FloatArray) -> None:
    """z <- P b from the lower triangle of P[:n, :n]; P is only read."""
    for i in range(n):
        z[i] = 0.0
    i = 0
    while i + 1 < n:
        b0, b1, s0, s1 = b[i], b[i + 1], 0.0, 0.0
        r0, r1 = P[i], P[i + 1]
        for j in range(i):
            s0 += r0[j] * b[j]
            s1 += r1[j] * b[j]
            z[j] += r0[j] * b0 + r1[j] * b1
        z[i] += s0 + r0[i] * b0 + r1[i] * b1
        z[i + 1] += s1 + r1[i] * b0 + r1[i + 1] * b1
        i += 2
    if i < n:
        b0, s0 = b[i], 0.0
        r0 = P[i]
        for j in range(i):
            s0 += r0[j] * b[j]
            z[j] += r0[j] * b0
        z[i] += s0 + r0[i] * b0


# --- P with its pending change.


@compiled_reassociating
def add_scaled(a: FloatArray, factor: float, b: FloatArray, n: int) -> None:
    """a <- a + factor b over the first n elements."""
    for j in range(n):
        a[j] += factor * b[j]


@compiled_reassociating
def multiply(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """Apply the pending change, and z <- P b over the slots in use. The last step can't be undone after this."""
    n = A.C[COUNT]
    minus, plus = A.V[MINUS], A.V[PLUS]
    if A.C[PENDING] != 0:
        advance(A.P, n, minus, plus, b, z)
        for j in range(n):
            minus[j] = 0.0
            plus[j] = 0.0
        A.C[PENDING] = 0
    else:
        product(A.P, n, b, z)
    A.C[UNDO] = UNDO_NOTHING


@compiled_reassociating
def solve(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """z <- R^-1 b. The pending change is taken into account, but stays pending."""
    n = A.C[COUNT]
    product(A.P, n, b, z)
    if A.C[PENDING] != 0:
        minus, plus = A.V[MINUS], A.V[PLUS]
        add_scaled(z, -dot(minus, b, n), minus, n)
        add_scaled(z, dot(plus, b, n), plus, n)


@compiled_reassociating
def lift_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """p <- P e_slot, and set that row and column to zero: the next pass then writes the new ones exactly."""
    n, row = A.C[COUNT], A.P[slot]
    for j in range(slot + 1):
        p[j] = row[j]
        row[j] = 0.0
    for i in range(slot + 1, n):
        p[i] = A.P[i, slot]
        A.P[i, slot] = 0.0


@compiled_reassociating
def lower_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """Write back a column that `lift_column` took out."""
    for j in range(slot + 1):
        A.P[slot, j] = p[j]
    for i in range(slot + 1, A.C[COUNT]):
        A.P[i, slot] = p[i]


@compiled_reassociating
def inverse_diagonal(A: WindowArrays, out: FloatArray) -> None:
    """out <- the diagonal of R^-1 by slot, the pending change included."""
    P, minus, plus, pending = A.P, A.V[MINUS], A.V[PLUS], A.C[PENDING] != 0
    for i in range(A.C[COUNT]):
        out[i] = P[i, i]
        if pending:
            out[i] += plus[i] ** 2 - minus[i] ** 2


# --- The Cholesky form: the factor R = L L', samples out of it and into it, and the diagonal of R^-1.
#
# The sample that leaves is a rank-1 *update* of the factor behind it, a chain of rotations, which is stable. The new
# sample goes to the end of the factor, by one forward solve. T = L^-1 [1 y] (S and SY) goes through the same
# rotations. The error of alpha grows with cond(R), not with its square as in the inverse form, for one and a half to
# two times the time.
#
# *Positions* are the order of the factor; ``order`` holds the slot at each position. The slot of a sample does not
# influence the numerics.
#
# Each slot has its column of L in its own row of P, from the diagonal on: L[i, j] is P[order[j], i - j]. Where the
# sample at an earlier position leaves, both its row and its column do, so a column stays where it is in memory, and
# grows by one element at its end. A replacement therefore changes the factor in place, in one pass that also solves
# for the new row.
#
# Rotations cannot be reversed to the last bit. A refused step therefore begins at a copy of the factor, of at most
# `KEPT_STEPS` replacements ago, and makes those between once more. ``kept`` holds the copy, packed column by column,
# and behind it a record for each replacement since: the right-hand side of its solve, the position that left, and the
# new diagonal element. C[LOGGED] counts them; 0 means that there is no copy.


# --- The O(N²) passes over the factor. Several columns go together, so that the vectors beside it are read once for all
# of them. Inner loops run from 0 over slices, so that no index is checked for being negative.


@compiled_reassociating
def _forward_columns(A: WindowArrays, n: int, b: FloatArray) -> None:
    """b <- L^-1 b in place; two columns at a time."""
    P, order = A.P, A.order
    k = 0
    while k + 1 < n:
        c0, c1 = P[order[k]], P[order[k + 1]]
        t0 = b[k] / c0[0]
        t1 = (b[k + 1] - c0[1] * t0) / c1[0]
        b[k] = t0
        b[k + 1] = t1
        a0, a1, rest = c0[2 : n - k], c1[1 : n - k - 1], b[k + 2 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a0[i] * t0 + a1[i] * t1
        k += 2
    if k < n:
        b[k] /= P[order[k], 0]


@compiled_reassociating
def _backward_columns(A: WindowArrays, n: int, b: FloatArray) -> None:
    """b <- L'^-1 b in place; four columns of L at a time."""
    P, order = A.P, A.order
    k = n - 1
    while k >= 3:
        c0, c1, c2, c3 = P[order[k - 3]], P[order[k - 2]], P[order[k - 1]], P[order[k]]
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        a0, a1 = c0[4 : n - k + 3], c1[3 : n - k + 2]
        a2, a3, rest = c2[2 : n - k + 1], c3[1 : n - k], b[k + 1 : n]
        for i in range(rest.shape[0]):
            x = rest[i]
            s0 += a0[i] * x
            s1 += a1[i] * x
            s2 += a2[i] * x
            s3 += a3[i] * x
        x3 = (b[k] - s3) / c3[0]
        x2 = (b[k - 1] - s2 - c2[1] * x3) / c2[0]
        x1 = (b[k - 2] - s1 - c1[1] * x2 - c1[2] * x3) / c1[0]
        x0 = b[k - 3] - s0 - c0[1] * x1 - c0[2] * x2 - c0[3] * x3
        b[k], b[k - 1], b[k - 2], b[k - 3] = x3, x2, x1, x0 / c0[0]
        k -= 4
    while k >= 0:
        c0, s0 = P[order[k]], 0.0
        for i in range(1, n - k):
            s0 += c0[i] * b[k + i]
        b[k] = (b[k] - s0) / c0[0]
        k -= 1


@compiled_reassociating
def _shorten_columns(A: WindowArrays, n: int, place: int, b: FloatArray) -> None:
    """The columns before ``place`` lose that row, gain the new one, and take part in b <- L^-1 b; four at a time."""
    P, order = A.P, A.order
    k = 0
    while k + 3 < place:
        c0, c1, c2, c3 = P[order[k]], P[order[k + 1]], P[order[k + 2]], P[order[k + 3]]
        t0 = b[k] / c0[0]
        t1 = (b[k + 1] - c0[1] * t0) / c1[0]
        t2 = (b[k + 2] - c0[2] * t0 - c1[1] * t1) / c2[0]
        t3 = (b[k + 3] - c0[3] * t0 - c1[2] * t1 - c2[1] * t2) / c3[0]
        b[k], b[k + 1], b[k + 2], b[k + 3] = t0, t1, t2, t3
        before = place - k
        a0, a1, a2, a3 = c0[4:before], c1[3 : before - 1], c2[2 : before - 2], c3[1 : before - 3]
        rest = b[k + 4 : place]
        for i in range(rest.shape[0]):
            rest[i] -= a0[i] * t0 + a1[i] * t1 + a2[i] * t2 + a3[i] * t3
        a0, a1 = c0[before : n - k], c1[before - 1 : n - k - 1]
        a2, a3 = c2[before - 2 : n - k - 2], c3[before - 3 : n - k - 3]
        rest = b[place : n - 1]
        for i in range(rest.shape[0]):
            e0, e1, e2, e3 = a0[i + 1], a1[i + 1], a2[i + 1], a3[i + 1]
            a0[i], a1[i], a2[i], a3[i] = e0, e1, e2, e3
            rest[i] -= e0 * t0 + e1 * t1 + e2 * t2 + e3 * t3
        c0[n - 1 - k], c1[n - 2 - k], c2[n - 3 - k], c3[n - 4 - k] = t0, t1, t2, t3
        k += 4
    while k < place:
        c = P[order[k]]
        t = b[k] / c[0]
        b[k] = t
        a, rest = c[1 : place - k], b[k + 1 : place]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * t
        a, rest = c[place - k : n - k], b[place : n - 1]
        for i in range(rest.shape[0]):
            e = a[i + 1]
            a[i] = e
            rest[i] -= e * t
        c[n - 1 - k] = t
        k += 1


@compiled_reassociating
def _rotation(diagonal: float, x: float) -> tuple[float, float, float]:
    """Length, cosine and sine of the rotation that takes (diagonal, x) to (length, 0)."""
    length = np.sqrt(diagonal * diagonal + x * x)
    return length, diagonal / length, x / length


@compiled_reassociating
def _rotate_columns(A: WindowArrays, n: int, place: int, x: FloatArray, b: FloatArray) -> None:
    """The columns behind ``place`` take in the rank-1 term x x' by rotations, which T goes through too.

    They gain the new row, and take part in b <- L^-1 b. Four columns at a time. ``x`` is used up.
    """
    P, order, S, sy = A.P, A.order, A.S, A.V[SY]
    tau, tau_y = S[place], sy[place]
    k = place + 1
    while k + 3 < n:
        a0, a1, a2, a3 = P[order[k]], P[order[k + 1]], P[order[k + 2]], P[order[k + 3]]
        r0, cosine0, sine0 = _rotation(a0[0], x[k])
        t0 = b[k - 1] / r0
        f01 = cosine0 * a0[1] + sine0 * x[k + 1]
        f02 = cosine0 * a0[2] + sine0 * x[k + 2]
        f03 = cosine0 * a0[3] + sine0 * x[k + 3]
        x1 = cosine0 * x[k + 1] - sine0 * a0[1]
        x2 = cosine0 * x[k + 2] - sine0 * a0[2]
        x3 = cosine0 * x[k + 3] - sine0 * a0[3]
        r1, cosine1, sine1 = _rotation(a1[0], x1)
        t1 = (b[k] - f01 * t0) / r1
        f12 = cosine1 * a1[1] + sine1 * x2
        f13 = cosine1 * a1[2] + sine1 * x3
        x2 = cosine1 * x2 - sine1 * a1[1]
        x3 = cosine1 * x3 - sine1 * a1[2]
        r2, cosine2, sine2 = _rotation(a2[0], x2)
        t2 = (b[k + 1] - f02 * t0 - f12 * t1) / r2
        f23 = cosine2 * a2[1] + sine2 * x3
        x3 = cosine2 * x3 - sine2 * a2[1]
        r3, cosine3, sine3 = _rotation(a3[0], x3)
        t3 = (b[k + 2] - f03 * t0 - f13 * t1 - f23 * t2) / r3
        a0[0], a0[1], a0[2], a0[3] = r0, f01, f02, f03
        a1[0], a1[1], a1[2] = r1, f12, f13
        a2[0], a2[1], a3[0] = r2, f23, r3
        b[k - 1], b[k], b[k + 1], b[k + 2] = t0, t1, t2, t3
        e0, e1, e2, e3 = a0[4 : n - k], a1[3 : n - k - 1], a2[2 : n - k - 2], a3[1 : n - k - 3]
        xs, rest = x[k + 4 : n], b[k + 3 : n - 1]
        for i in range(rest.shape[0]):
            before, other = e0[i], xs[i]
            after = cosine0 * before + sine0 * other
            other = cosine0 * other - sine0 * before
            e0[i] = after
            total = after * t0
            before = e1[i]
            after = cosine1 * before + sine1 * other
            other = cosine1 * other - sine1 * before
            e1[i] = after
            total += after * t1
            before = e2[i]
            after = cosine2 * before + sine2 * other
            other = cosine2 * other - sine2 * before
            e2[i] = after
            total += after * t2
            before = e3[i]
            after = cosine3 * before + sine3 * other
            xs[i] = cosine3 * other - sine3 * before
            e3[i] = after
            rest[i] -= total + after * t3
        a0[n - k], a1[n - k - 1], a2[n - k - 2], a3[n - k - 3] = t0, t1, t2, t3
        tau, tau_y = _rotate_targets(S, sy, k, cosine0, sine0, tau, tau_y)
        tau, tau_y = _rotate_targets(S, sy, k + 1, cosine1, sine1, tau, tau_y)
        tau, tau_y = _rotate_targets(S, sy, k + 2, cosine2, sine2, tau, tau_y)
        tau, tau_y = _rotate_targets(S, sy, k + 3, cosine3, sine3, tau, tau_y)
        k += 4
    while k < n:
        cosine0, sine0 = _rotate_column(P[order[k]], n - k, x[k:n], b[k - 1 : n - 1])
        tau, tau_y = _rotate_targets(S, sy, k, cosine0, sine0, tau, tau_y)
        k += 1


@compiled_reassociating
def _rotate_column(a: FloatArray, rows: int, x: FloatArray, b: FloatArray) -> tuple[float, float]:
    """One column ``a`` of ``rows`` elements, as above; ``x`` and ``b`` begin at it. Returns cosine and sine."""
    length, cosine, sine = _rotation(a[0], x[0])
    t = b[0] / length
    a[0], b[0] = length, t
    for i in range(1, rows):
        before, other = a[i], x[i]
        after = cosine * before + sine * other
        x[i] = cosine * other - sine * before
        a[i] = after
        b[i] -= after * t
    a[rows] = t
    return cosine, sine


@compiled_reassociating
def _rotate_targets(
    S: FloatArray, sy: FloatArray, k: int, cosine: float, sine: float, tau: float, tau_y: float
) -> tuple[float, float]:
    """Element k of T, one position further to the front, after its rotation with ``tau``; returns what goes on."""
    s, t = S[k], sy[k]
    S[k - 1] = cosine * s + sine * tau
    sy[k - 1] = cosine * t + sine * tau_y
    return cosine * tau - sine * s, cosine * tau_y - sine * t


# --- The factor.


@compiled_reassociating
def position_of(A: WindowArrays, slot: int) -> int:
    """Position in the factor of a slot, -1 where it has none."""
    for i in range(A.C[COUNT]):
        if A.order[i] == slot:
            return i
    return -1


@compiled_reassociating
def gather(A: WindowArrays, by_slot: FloatArray, by_position: FloatArray) -> None:
    """Reorder a vector from slots to positions."""
    for i in range(A.C[COUNT]):
        by_position[i] = by_slot[A.order[i]]


@compiled_reassociating
def forward(A: WindowArrays, b: FloatArray) -> None:
    """b <- L^-1 b in place, by position."""
    _forward_columns(A, A.C[COUNT], b)


@compiled_reassociating
def backward(A: WindowArrays, b: FloatArray) -> None:
    """b <- L'^-1 b in place, by position."""
    _backward_columns(A, A.C[COUNT], b)


@compiled_reassociating
def _exchange(A: WindowArrays, place: int, b: FloatArray) -> None:
    """The sample at ``place`` leaves the factor, and b <- L^-1 b with the new one becomes its last row.

    ``b`` is by position without the one that leaves. Its slot goes to the end of ``order``; the diagonal element of
    the new sample is still missing.
    """
    n, x, order = A.C[COUNT], A.V[PLUS], A.order
    slot = order[place]
    own = A.P[slot]
    for i in range(place + 1, n):
        x[i] = own[i - place]
    _shorten_columns(A, n, place, b)
    _rotate_columns(A, n, place, x, b)
    for k in range(place + 1, n):
        order[k - 1] = order[k]
    order[n - 1] = slot


@compiled_reassociating
def delete(A: WindowArrays, place: int, b: FloatArray) -> None:
    """Take the sample at ``place`` out of the factor, and b <- L^-1 b with the new factor in the same pass.

    ``b`` is by position without the one that leaves, and becomes the row of the sample that `add` puts in its slot.
    COUNT is one less afterwards; `restore_factor` takes it back.
    """
    n, N = A.C[COUNT], A.P.shape[0]
    if A.C[LOGGED] == 0 or A.C[LOGGED] == KEPT_STEPS:
        _keep(A)
        A.C[LOGGED] = 0
    record = _record(A, A.C[LOGGED])
    for i in range(n - 1):
        record[i] = b[i]
    record[N - 1] = place
    A.C[LOGGED] += 1
    _exchange(A, place, b)
    A.C[COUNT] = n - 1


@compiled_reassociating
def add(A: WindowArrays, slot: int, half: FloatArray, diagonal: float) -> None:
    """The sample of ``slot``, already written, is the last one; ``half`` is its row of L. COUNT is one more."""
    n = A.C[COUNT]
    A.P[slot, 0] = diagonal
    A.S[n] = (1.0 - dot(half, A.S, n)) / diagonal
    A.V[SY, n] = (A.V[Y, slot] - dot(half, A.V[SY], n)) / diagonal
    A.order[n] = slot
    A.C[COUNT] = n + 1
    if A.C[LOGGED] > 0:
        _record(A, A.C[LOGGED] - 1)[A.P.shape[0]] = diagonal


@compiled_reassociating
def append_row(A: WindowArrays, half: FloatArray) -> None:
    """Write ``half``, L^-1 of a new sample's column, as the next row of L; `add` follows. No copy is kept of this."""
    n = A.C[COUNT]
    for k in range(n):
        A.P[A.order[k], n - k] = half[k]
    A.C[LOGGED] = 0


# --- The factor of before: a copy, and a record of each replacement since.


@compiled_reassociating
def _keep(A: WindowArrays) -> None:
    """Copy the factor, packed column by column."""
    n, at = A.C[COUNT], 0
    for k in range(n):
        a, to = A.P[A.order[k]], A.kept[at : at + n - k]
        for i in range(to.shape[0]):
            to[i] = a[i]
        at += n - k


@compiled_reassociating
def _record(A: WindowArrays, i: int) -> FloatArray:
    """(N + 1,) of replacement i since the copy: n - 1 elements of b, at N - 1 the position, at N the diagonal."""
    N = A.P.shape[0]
    first = N * (N + 1) // 2 + i * (N + 1)
    record: FloatArray = A.kept[first : first + N + 1]
    return record


@compiled_reassociating
def restore_factor(A: WindowArrays) -> None:
    """The factor and its order as `delete` found them, to the last bit. COUNT is what it was then.

    S and SY are spoilt. The next replacement begins with a new copy, so that it can be taken back at once.
    """
    n, N, order, b, steps = A.C[COUNT], A.P.shape[0], A.order, A.V[TRIAL], A.C[LOGGED] - 1
    for back in range(steps + 1):
        place = int(_record(A, steps - back)[N - 1])
        slot = order[n - 1]
        for r in range(n - 1 - place):
            order[n - 1 - r] = order[n - 2 - r]
        order[place] = slot
    at = 0
    for k in range(n):
        a, kept = A.P[order[k]], A.kept[at : at + n - k]
        for i in range(kept.shape[0]):
            a[i] = kept[i]
        at += n - k
    for step in range(steps):
        record = _record(A, step)
        for i in range(n - 1):
            b[i] = record[i]
        _exchange(A, int(record[N - 1]), b)
        A.P[order[n - 1], 0] = record[N]
    A.C[LOGGED] = 0


# --- The factor as a matrix.


@compiled_reassociating
def take_upper(A: WindowArrays, upper: FloatArray) -> None:
    """The factor from the upper triangle of ``upper`` (N, N), L' by position."""
    n = A.C[COUNT]
    for k in range(n):
        row, a = upper[k], A.P[A.order[k]]
        for i in range(n - k):
            a[i] = row[k + i]
    A.C[LOGGED] = 0


@compiled_reassociating
def write_upper(A: WindowArrays, upper: FloatArray) -> None:
    """The factor into the upper triangle of ``upper`` (N, N), L' by position."""
    n = A.C[COUNT]
    for k in range(n):
        row, a = upper[k], A.P[A.order[k]]
        for i in range(n - k):
            row[k + i] = a[i]


# --- The diagonal of R^-1 for leave-one-out.


@compiled_reassociating
def cholesky_diagonal(A: WindowArrays, out: FloatArray) -> None:
    """out <- the diagonal of R^-1 by slot. O(N³): that of position i is the square of L^-1 e_i."""
    n, t = A.C[COUNT], A.V[MINUS]
    for place in range(n):
        for i in range(n):
            t[i] = 0.0
        t[place] = 1.0
        total = 0.0
        for k in range(place, n):
            column = A.P[A.order[k]]
            half = t[k] / column[0]
            t[k] = half
            total += half * half
            a, rest = column[1 : n - k], t[k + 1 : n]
            for i in range(rest.shape[0]):
                rest[i] -= a[i] * half
        out[A.order[place]] = total
