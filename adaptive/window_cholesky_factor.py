"""The factor of `adaptive.window_cholesky`: solves, a sample in and out of it, what follows from it, keeping it."""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_common import factor_gram, restore_sample, restore_solution, solve_linear
from adaptive.window_pass import backward_columns, forward_columns, rotate_column, shift_columns
from adaptive.window_small import add_scaled, dot, finite
from adaptive.window_state import (
    ALPHA,
    COUNT,
    PK,
    PLUS,
    SY,
    TRIAL,
    UNDO,
    UNDO_NOTHING,
    UNDO_PLACE,
    UNDO_SLOT,
    WindowArrays,
    Y,
    Z,
)


@compiled_reassociating
def position_of(A: WindowArrays, slot: int) -> int:
    """Where in the factor a slot stands."""
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
    forward_columns(A.P, A.C[COUNT], b)


@compiled_reassociating
def backward(A: WindowArrays, b: FloatArray) -> None:
    """b <- L'^-1 b in place, by position."""
    backward_columns(A.P, A.C[COUNT], b)


@compiled_reassociating
def delete(A: WindowArrays, position: int, b: FloatArray) -> None:
    """Take the sample at ``position`` out of the factor, and b <- L^-1 b with the new factor in the same pass.

    ``b`` is by position without the one that leaves. COUNT is one less afterwards.
    """
    n, p = A.C[COUNT], A.H.shape[0]
    x, tau = A.V[PLUS], A.small[2]
    row = A.P[position]
    for i in range(position + 1, n):
        x[i] = row[i]
    shift_columns(A.P, n, position, b)
    for c in range(p):
        tau[c] = A.S[c, position]
    tau_y = A.V[SY, position]
    for k in range(position + 1, n):
        old, new = A.P[k], A.P[k - 1]
        r = np.sqrt(old[k] * old[k] + x[k] * x[k])
        cosine, sine = old[k] / r, x[k] / r
        new[k - 1] = r
        t = b[k - 1] / r
        b[k - 1] = t
        rotate_column(old[k + 1 : n], new[k : n - 1], x[k + 1 : n], b[k : n - 1], cosine, sine, t)
        for c in range(p):
            value = A.S[c, k]
            A.S[c, k - 1] = cosine * value + sine * tau[c]
            tau[c] = cosine * tau[c] - sine * value
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
    for c in range(A.H.shape[0]):
        A.S[c, n] = (A.H[c, slot] - dot(half, A.S[c], n)) / diagonal
    A.V[SY, n] = (A.V[Y, slot] - dot(half, A.V[SY], n)) / diagonal
    A.order[n] = slot
    A.C[COUNT] = n + 1


@compiled_reassociating
def factor_design(A: WindowArrays) -> bool:
    """G <- the factor of T_H'T_H. False where that is not finite."""
    return factor_gram(A, A.S)


@compiled_reassociating
def finish(A: WindowArrays) -> bool:
    """beta and alpha from T = L^-1 [H y]. False, with both spoilt, where they are not finite."""
    n, t = A.C[COUNT], A.V[Z]
    good = solve_linear(A, A.S, t)
    backward(A, t)
    for i in range(n):
        A.V[ALPHA, A.order[i]] = t[i]
    return good and finite(t, n)


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
def take_back(A: WindowArrays) -> None:
    """The window as it was before the sample of UNDO_SLOT was taken out of the factor, to the last bit.

    COUNT is what it was then.
    """
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
    restore_solution(A)
    restore_sample(A)
    factor_design(A)
    A.C[UNDO] = UNDO_NOTHING


@compiled_reassociating
def shift_targets(A: WindowArrays, delta: FloatArray) -> None:
    """T_y gains L^-1 delta; ``delta`` is by slot."""
    t = A.V[TRIAL]
    gather(A, delta, t)
    forward(A, t)
    add_scaled(A.V[SY], 1.0, t, A.C[COUNT])
