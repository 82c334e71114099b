"""The Cholesky form of the window: the factor R = L L', samples out of it and into it, and the diagonal of R^-1.

The sample that leaves is a rank-1 *update* of the factor behind it, a chain of rotations, which is stable. The new
sample goes to the end of the factor, by one forward solve. T = L^-1 [1 y] (S and SY) goes through the same rotations.
The error of alpha grows with cond(R), not with its square as in the inverse form, for about twice the time.

*Positions* are the order of the factor; ``order`` holds the slot at each position. The slot of a sample does not
influence the numerics.

Rotations cannot be reversed to the last bit, so a refused step needs the factor from before it. A replacement therefore
reads the factor from one triangle of P and writes the new one into the other, in one pass: to take it back is to go
back to the first triangle. Column j of L is contiguous in both: behind the diagonal in row j of P, or, in the lower
triangle (C[LOWER] is 1), from the beginning of row N - 1 - j. Its diagonal element is P[j, j] in both, and the one from
before is in row PK of V.
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
    LOWER,
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
def _place(N: int, lower: bool, k: int) -> int:
    """Where in the flat P, of N rows, element 0 of column ``k`` of L would be: element i > k is i further on."""
    return (N - 1 - k) * N - k - 1 if lower else k * N


@compiled_reassociating
def _forward_columns(A: WindowArrays, n: int, b: FloatArray) -> None:
    """b <- L^-1 b in place; two columns at a time."""
    P, N, lower = A.P, A.P.shape[0], A.C[LOWER] != 0
    flat = P.reshape(N * N)
    k = 0
    while k + 1 < n:
        c0, c1 = _place(N, lower, k), _place(N, lower, k + 1)
        t0 = b[k] / P[k, k]
        t1 = (b[k + 1] - flat[c0 + k + 1] * t0) / P[k + 1, k + 1]
        b[k] = t0
        b[k + 1] = t1
        a0, a1, rest = flat[c0 + k + 2 : c0 + n], flat[c1 + k + 2 : c1 + n], b[k + 2 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a0[i] * t0 + a1[i] * t1
        k += 2
    if k < n:
        b[k] /= P[k, k]


@compiled_reassociating
def _backward_columns(A: WindowArrays, n: int, b: FloatArray) -> None:
    """b <- L'^-1 b in place; four columns of L at a time."""
    P, N, lower = A.P, A.P.shape[0], A.C[LOWER] != 0
    flat = P.reshape(N * N)
    k = n - 1
    while k >= 3:
        c0, c1 = _place(N, lower, k - 3), _place(N, lower, k - 2)
        c2, c3 = _place(N, lower, k - 1), _place(N, lower, k)
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        a0, a1 = flat[c0 + k + 1 : c0 + n], flat[c1 + k + 1 : c1 + n]
        a2, a3, rest = flat[c2 + k + 1 : c2 + n], flat[c3 + k + 1 : c3 + n], b[k + 1 : n]
        for i in range(rest.shape[0]):
            x = rest[i]
            s0 += a0[i] * x
            s1 += a1[i] * x
            s2 += a2[i] * x
            s3 += a3[i] * x
        x3 = (b[k] - s3) / P[k, k]
        x2 = (b[k - 1] - s2 - flat[c2 + k] * x3) / P[k - 1, k - 1]
        x1 = (b[k - 2] - s1 - flat[c1 + k - 1] * x2 - flat[c1 + k] * x3) / P[k - 2, k - 2]
        x0 = b[k - 3] - s0 - flat[c0 + k - 2] * x1 - flat[c0 + k - 1] * x2 - flat[c0 + k] * x3
        b[k], b[k - 1], b[k - 2], b[k - 3] = x3, x2, x1, x0 / P[k - 3, k - 3]
        k -= 4
    while k >= 0:
        c0, s0 = _place(N, lower, k), 0.0
        for i in range(k + 1, n):
            s0 += flat[c0 + i] * b[i]
        b[k] = (b[k] - s0) / P[k, k]
        k -= 1


@compiled_reassociating
def _shift_columns(A: WindowArrays, n: int, position: int, b: FloatArray) -> None:
    """The columns before ``position`` go to the other triangle without that row, and take part in b <- L^-1 b."""
    P, N, lower = A.P, A.P.shape[0], A.C[LOWER] != 0
    flat = P.reshape(N * N)
    for k in range(position):
        c, to = _place(N, lower, k), _place(N, not lower, k)
        t = b[k] / P[k, k]
        b[k] = t
        old, new, rest = flat[c + k + 1 : c + position], flat[to + k + 1 : to + position], b[k + 1 : position]
        for i in range(rest.shape[0]):
            value = old[i]
            new[i] = value
            rest[i] -= value * t
        old, new, rest = flat[c + position + 1 : c + n], flat[to + position : to + n - 1], b[position : n - 1]
        for i in range(rest.shape[0]):
            value = old[i]
            new[i] = value
            rest[i] -= value * t


@compiled_reassociating
def _rotate_columns(A: WindowArrays, n: int, position: int, x: FloatArray, b: FloatArray) -> None:
    """The columns behind ``position`` take in the rank-1 term x x' by rotations, which T goes through too.

    The new columns go to the other triangle, one place further to the front, and take part in b <- L^-1 b. Two columns
    at a time. ``x`` is used up.
    """
    P, N, lower = A.P, A.P.shape[0], A.C[LOWER] != 0
    flat, S, sy = P.reshape(N * N), A.S, A.V[SY]
    tau, tau_y = S[position], sy[position]
    k = position + 1
    while k < n:
        c0, to0 = _place(N, lower, k), _place(N, not lower, k - 1)
        diagonal0 = P[k, k]
        r0 = np.sqrt(diagonal0 * diagonal0 + x[k] * x[k])
        cosine0, sine0 = diagonal0 / r0, x[k] / r0
        P[k - 1, k - 1] = r0
        t0 = b[k - 1] / r0
        b[k - 1] = t0
        value = S[k]
        S[k - 1] = cosine0 * value + sine0 * tau
        tau = cosine0 * tau - sine0 * value
        value = sy[k]
        sy[k - 1] = cosine0 * value + sine0 * tau_y
        tau_y = cosine0 * tau_y - sine0 * value
        if k + 1 == n:
            return
        c1, to1 = _place(N, lower, k + 1), _place(N, not lower, k)
        before, other = flat[c0 + k + 1], x[k + 1]
        after = cosine0 * before + sine0 * other
        other = cosine0 * other - sine0 * before
        flat[to0 + k] = after
        diagonal1 = P[k + 1, k + 1]
        r1 = np.sqrt(diagonal1 * diagonal1 + other * other)
        cosine1, sine1 = diagonal1 / r1, other / r1
        P[k, k] = r1
        t1 = (b[k] - after * t0) / r1
        b[k] = t1
        value = S[k + 1]
        S[k] = cosine1 * value + sine1 * tau
        tau = cosine1 * tau - sine1 * value
        value = sy[k + 1]
        sy[k] = cosine1 * value + sine1 * tau_y
        tau_y = cosine1 * tau_y - sine1 * value
        old0, old1 = flat[c0 + k + 2 : c0 + n], flat[c1 + k + 2 : c1 + n]
        new0, new1 = flat[to0 + k + 1 : to0 + n - 1], flat[to1 + k + 1 : to1 + n - 1]
        xs, rest = x[k + 2 : n], b[k + 1 : n - 1]
        for i in range(rest.shape[0]):
            before, other = old0[i], xs[i]
            first = cosine0 * before + sine0 * other
            other = cosine0 * other - sine0 * before
            before = old1[i]
            second = cosine1 * before + sine1 * other
            xs[i] = cosine1 * other - sine1 * before
            new0[i] = first
            new1[i] = second
            rest[i] -= first * t0 + second * t1
        k += 2


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
def delete(A: WindowArrays, position: int, b: FloatArray) -> None:
    """Take the sample at ``position`` out of the factor, and b <- L^-1 b with the new factor in the same pass.

    ``b`` is by position without the one that leaves. COUNT is one less afterwards; `restore_factor` takes it back.
    """
    n, N, x = A.C[COUNT], A.P.shape[0], A.V[PLUS]
    flat, column = A.P.reshape(N * N), _place(N, A.C[LOWER] != 0, position)
    for i in range(position + 1, n):
        x[i] = flat[column + i]
    for i in range(n):
        A.V[PK, i] = A.P[i, i]
    _shift_columns(A, n, position, b)
    _rotate_columns(A, n, position, x, b)
    for k in range(position + 1, n):
        A.order[k - 1] = A.order[k]
    A.C[LOWER] = 1 - A.C[LOWER]
    A.C[COUNT] = n - 1


@compiled_reassociating
def add(A: WindowArrays, slot: int, half: FloatArray, diagonal: float) -> None:
    """Put the sample of ``slot``, already written, at the end; ``half`` is L^-1 of its column. COUNT is one more."""
    n, N, lower = A.C[COUNT], A.P.shape[0], A.C[LOWER] != 0
    flat = A.P.reshape(N * N)
    for k in range(n):
        flat[_place(N, lower, k) + n] = half[k]
    A.P[n, n] = diagonal
    A.S[n] = (1.0 - dot(half, A.S, n)) / diagonal
    A.V[SY, n] = (A.V[Y, slot] - dot(half, A.V[SY], n)) / diagonal
    A.order[n] = slot
    A.C[COUNT] = n + 1


@compiled_reassociating
def restore_factor(A: WindowArrays) -> None:
    """The factor and its order as `delete` found them, to the last bit. COUNT is what it was then."""
    n, place = A.C[COUNT], A.C[UNDO_PLACE]
    A.C[LOWER] = 1 - A.C[LOWER]
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
    n, N, lower, total = A.C[COUNT], A.P.shape[0], A.C[LOWER] != 0, 0.0
    flat = A.P.reshape(N * N)
    for i in range(n):
        t[i] = 0.0
    t[place] = 1.0
    for k in range(place, n):
        column = _place(N, lower, k)
        half = t[k] / A.P[k, k]
        t[k] = half
        total += half * half
        a, rest = flat[column + k + 1 : column + n], t[k + 1 : n]
        for i in range(rest.shape[0]):
            rest[i] -= a[i] * half
    return total


@compiled_reassociating
def _column(A: WindowArrays, place: int, out: FloatArray) -> None:
    """out <- R^-1 e, by slot, of the sample at ``place``."""
    t = A.V[MINUS]
    _half_column(A, place, t)
    _backward_columns(A, A.C[COUNT], t)
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
