"""The Cholesky form of the window: the factor R = L L', samples out of it and into it, and the diagonal of R^-1.

The sample that leaves is a rank-1 *update* of the factor behind it, a chain of rotations, which is stable. The new
sample goes to the end of the factor, by one forward solve. T = L^-1 [1 y] (S and SY) goes through the same rotations.
The error of alpha grows with cond(R), not with its square as in the inverse form, for about twice the time.

Column j of L is row j of ``P`` (contiguous). *Positions* are the order of the factor; ``order`` holds the slot at each
position. The slot of a sample does not influence the numerics. Rotations cannot be reversed to the last bit, so a step
first copies the factor into the free triangle of P.
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating, dot
from adaptive.types import FloatArray
from adaptive.window.arrays import (
    BITS,
    CARRIED,
    COUNT,
    CURSOR,
    DIAGONAL,
    MINUS,
    PK,
    PLUS,
    SY,
    UNDO_PLACE,
    UNDO_SLOT,
    K,
    WindowArrays,
    Y,
)

# --- The O(N²) passes over the factor.


@compiled_reassociating
def _forward_columns(P: FloatArray, n: int, b: FloatArray) -> None:
    """b <- L^-1 b in place, L' in the upper triangle of P[:n, :n]; two columns at a time."""
    k = 0
    while k + 1 < n:
        r0, r1 = P[k], P[k + 1]
        t0 = b[k] / r0[k]
        t1 = (b[k + 1] - r0[k + 1] * t0) / r1[k + 1]
        b[k] = t0
        b[k + 1] = t1
        a0, a1, rest = r0[k + 2 : n], r1[k + 2 : n], b[k + 2 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a0[i] * t0 + a1[i] * t1
        k += 2
    if k < n:
        b[k] /= P[k, k]


@compiled_reassociating
def _backward_columns(P: FloatArray, n: int, b: FloatArray) -> None:
    """b <- L'^-1 b in place, L' in the upper triangle of P[:n, :n]; two rows at a time."""
    k = n - 1
    while k >= 1:
        r0, r1 = P[k - 1], P[k]
        s0, s1 = 0.0, 0.0
        a0, a1, rest = r0[k + 1 : n], r1[k + 1 : n], b[k + 1 : n]
        for i in range(rest.shape[0]):
            s0 += a0[i] * rest[i]
            s1 += a1[i] * rest[i]
        b[k] = (b[k] - s1) / r1[k]
        b[k - 1] = (b[k - 1] - s0 - r0[k] * b[k]) / r0[k - 1]
        k -= 2
    if k == 0:
        r0, s0 = P[0], 0.0
        for i in range(1, n):
            s0 += r0[i] * b[i]
        b[0] = (b[0] - s0) / r0[0]


@compiled_reassociating
def _shift_columns(P: FloatArray, n: int, position: int, b: FloatArray) -> None:
    """The columns of L before ``position`` lose that row, and take their part in b <- L^-1 b."""
    for k in range(position):
        row = P[k]
        t = b[k] / row[k]
        b[k] = t
        a, rest = row[k + 1 : position], b[k + 1 : position]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * t
        to, rest = row[position : n - 1], b[position : n - 1]
        for i in range(rest.shape[0]):
            to[i] = row[position + 1 + i]
        for i in range(rest.shape[0]):
            rest[i] -= to[i] * t


@compiled_reassociating
def _rotate_column(
    old: FloatArray, new: FloatArray, x: FloatArray, b: FloatArray, cosine: float, sine: float, t: float
) -> None:
    """One rotation of the rank-1 update over the rest of a column, and that column's part in b <- L^-1 b."""
    for i in range(x.shape[0]):
        before, other = old[i], x[i]
        after = cosine * before + sine * other
        x[i] = cosine * other - sine * before
        new[i] = after
        b[i] -= after * t


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
    _forward_columns(A.P, A.C[COUNT], b)


@compiled_reassociating
def backward(A: WindowArrays, b: FloatArray) -> None:
    """b <- L'^-1 b in place, by position."""
    _backward_columns(A.P, A.C[COUNT], b)


@compiled_reassociating
def delete(A: WindowArrays, position: int, b: FloatArray) -> None:
    """Take the sample at ``position`` out of the factor, and b <- L^-1 b with the new factor in the same pass.

    ``b`` is by position without the one that leaves. COUNT is one less afterwards.
    """
    n, x = A.C[COUNT], A.V[PLUS]
    row = A.P[position]
    for i in range(position + 1, n):
        x[i] = row[i]
    _shift_columns(A.P, n, position, b)
    tau, tau_y = A.S[position], A.V[SY, position]
    for k in range(position + 1, n):
        old, new = A.P[k], A.P[k - 1]
        r = np.sqrt(old[k] * old[k] + x[k] * x[k])
        cosine, sine = old[k] / r, x[k] / r
        new[k - 1] = r
        t = b[k - 1] / r
        b[k - 1] = t
        _rotate_column(old[k + 1 : n], new[k : n - 1], x[k + 1 : n], b[k : n - 1], cosine, sine, t)
        value = A.S[k]
        A.S[k - 1] = cosine * value + sine * tau
        tau = cosine * tau - sine * value
        value = A.V[SY, k]
        A.V[SY, k - 1] = cosine * value + sine * tau_y
        tau_y = cosine * tau_y - sine * value
        A.order[k - 1] = A.order[k]
    A.C[COUNT] = n - 1


@compiled_reassociating
def add(A: WindowArrays, slot: int, half: FloatArray, diagonal: float) -> None:
    """Put the sample of ``slot``, already written, at the end; ``half`` is L^-1 of its column. COUNT is one more."""
    n = A.C[COUNT]
    for k in range(n):
        A.P[k, n] = half[k]
    A.P[n, n] = diagonal
    A.S[n] = (1.0 - dot(half, A.S, n)) / diagonal
    A.V[SY, n] = (A.V[Y, slot] - dot(half, A.V[SY], n)) / diagonal
    A.order[n] = slot
    A.C[COUNT] = n + 1


@compiled_reassociating
def keep_factor(A: WindowArrays) -> None:
    """Copy the factor into the strictly lower triangle of P, last row first, and its diagonal into PK."""
    n = A.C[COUNT]
    for i in range(n):
        A.V[PK, i] = A.P[i, i]
        source, target = A.P[i, i + 1 : n], A.P[n - 1 - i]
        for j in range(source.shape[0]):
            target[j] = source[j]


@compiled_reassociating
def restore_factor(A: WindowArrays) -> None:
    """The factor and its order as `keep_factor` found them, to the last bit. COUNT is what it was then."""
    n, place = A.C[COUNT], A.C[UNDO_PLACE]
    for i in range(n):
        source, target = A.P[n - 1 - i], A.P[i, i + 1 : n]
        for j in range(target.shape[0]):
            target[j] = source[j]
    for i in range(n):
        A.P[i, i] = A.V[PK, i]
    for r in range(n - 1 - place):
        A.order[n - 1 - r] = A.order[n - 2 - r]
    A.order[place] = A.C[UNDO_SLOT]


# --- The diagonal of R^-1 for leave-one-out, (Pc)_ii. From the factor alone it takes O(N³). Once known it follows a
# step in O(N²), with the column c = R^-1 e_k of the sample k:
#
#     it leaves:  d_i <- d_i - c_i²/c_k  (c of the factor before),
#     it comes:   d_i <- d_i + c_i²/c_k, d_k = c_k  (c of the factor after).
#
# Each such step also computes one element anew from the factor, in turn, so that no element is older than a round of
# the window and errors do not add up. The diagonal is dropped when nobody has asked for it for a round.


@compiled_reassociating
def _half_column(A: WindowArrays, place: int, t: FloatArray) -> float:
    """t <- L^-1 e_place, by position: zero above ``place``. Returns its square, the diagonal element of R^-1."""
    n, total = A.C[COUNT], 0.0
    for i in range(n):
        t[i] = 0.0
    t[place] = 1.0
    for k in range(place, n):
        row = A.P[k]
        half = t[k] / row[k]
        t[k] = half
        total += half * half
        a, rest = row[k + 1 : n], t[k + 1 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * half
    return total


@compiled_reassociating
def _column(A: WindowArrays, place: int, out: FloatArray) -> None:
    """out <- R^-1 e, by slot, of the sample at ``place``."""
    t = A.V[MINUS]
    _half_column(A, place, t)
    _backward_columns(A.P, A.C[COUNT], t)
    for i in range(A.C[COUNT]):
        out[A.order[i]] = t[i]


@compiled_reassociating
def before_leaving(A: WindowArrays, place: int) -> None:
    """Before the sample at ``place`` leaves the factor: put its column of R^-1 into BITS."""
    if A.C[CARRIED] > 0:
        _column(A, place, A.V[BITS])


@compiled_reassociating
def after_leaving(A: WindowArrays, slot: int, n: int) -> None:
    """Follow the diagonal after the sample of ``slot``, one of n, has left the factor."""
    if A.C[CARRIED] > 0:
        c, d = A.V[BITS], A.V[DIAGONAL]
        own = c[slot]
        for j in range(n):
            d[j] -= c[j] * c[j] / own


@compiled_reassociating
def after_coming(A: WindowArrays, slot: int) -> None:
    """Follow the diagonal after the sample of ``slot`` has come to the end of the factor; one element is made anew."""
    n = A.C[COUNT]
    if A.C[CARRIED] > 0:
        A.C[CARRIED] -= 1
        c, d = A.V[K], A.V[DIAGONAL]
        _column(A, n - 1, c)
        own = c[slot]
        for j in range(n):
            d[j] += c[j] * c[j] / own
        d[slot] = own
        turn = A.C[CURSOR] if A.C[CURSOR] < n else 0
        for place in range(n):
            if A.order[place] == turn:
                d[turn] = _half_column(A, place, A.V[MINUS])


@compiled_reassociating
def diagonal(A: WindowArrays) -> FloatArray:
    """The diagonal of R^-1 by slot; it is carried along for the next N steps. O(N³) where it is not known yet."""
    n = A.C[COUNT]
    d: FloatArray = A.V[DIAGONAL]
    if A.C[CARRIED] == 0:
        for place in range(n):
            d[A.order[place]] = _half_column(A, place, A.V[MINUS])
    A.C[CARRIED] = n
    return d
