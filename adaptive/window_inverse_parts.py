"""What a step of `adaptive.window_inverse` is made of: products with P and what is pending, S and Sy, columns of P."""

from __future__ import annotations

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_common import factor_gram, solve_linear
from adaptive.window_pass import advance, product
from adaptive.window_small import add_scaled, dot
from adaptive.window_state import ALPHA, COUNT, MINUS, PENDING, PLUS, SY, TRIAL, UNDO, UNDO_NOTHING, WindowArrays, Y, Z


@compiled_reassociating
def multiply(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """Apply what is pending, and z <- P b over the slots in use. The last step can't be undone after this."""
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
def flush(A: WindowArrays) -> None:
    """Apply what is pending; P is then R^-1 itself."""
    if A.C[PENDING] != 0:
        trial = A.V[TRIAL]
        for j in range(A.C[COUNT]):
            trial[j] = 0.0
        multiply(A, trial, A.V[Z])
    A.C[UNDO] = UNDO_NOTHING


@compiled_reassociating
def solve(A: WindowArrays, b: FloatArray, z: FloatArray) -> None:
    """z <- R^-1 b without applying what is pending."""
    n = A.C[COUNT]
    product(A.P, n, b, z)
    if A.C[PENDING] != 0:
        minus, plus = A.V[MINUS], A.V[PLUS]
        add_scaled(z, -dot(minus, b, n), minus, n)
        add_scaled(z, dot(plus, b, n), plus, n)


@compiled_reassociating
def factor_design(A: WindowArrays) -> bool:
    """G <- the factor of H'PH. False where that is not finite."""
    return factor_gram(A, A.H)


@compiled_reassociating
def finish(A: WindowArrays) -> bool:
    """beta and alpha from S and Sy, (2.29). False, with both spoilt, where they are not finite."""
    return solve_linear(A, A.H, A.V[ALPHA])


@compiled_reassociating
def lift_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """p <- P e_slot, and zero that row and column: the pass then writes the new ones exactly."""
    n, row = A.C[COUNT], A.P[slot]
    for j in range(slot + 1):
        p[j] = row[j]
        row[j] = 0.0
    for i in range(slot + 1, n):
        p[i] = A.P[i, slot]
        A.P[i, slot] = 0.0


@compiled_reassociating
def lower_column(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """Write a lifted column back."""
    for j in range(slot + 1):
        A.P[slot, j] = p[j]
    for i in range(slot + 1, A.C[COUNT]):
        A.P[i, slot] = p[i]


@compiled_reassociating
def take_out(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """S and Sy lose the term p p'/p_kk, the slot's elements exactly."""
    n = A.C[COUNT]
    for c in range(A.H.shape[0]):
        add_scaled(A.S[c], -A.S[c, slot] / p[slot], p, n)
        A.S[c, slot] = 0.0
    add_scaled(A.V[SY], -A.V[SY, slot] / p[slot], p, n)
    A.V[SY, slot] = 0.0


@compiled_reassociating
def take_in(A: WindowArrays, slot: int, q: FloatArray, s: float) -> None:
    """S and Sy gain the term q q'/s; q_slot = -1 and the slot's sample are in place."""
    n = A.C[COUNT]
    for c in range(A.H.shape[0]):
        add_scaled(A.S[c], dot(q, A.H[c], n) / s, q, n)
    add_scaled(A.V[SY], dot(q, A.V[Y], n) / s, q, n)


@compiled_reassociating
def pend(target: FloatArray, source: FloatArray, scale: float, n: int) -> None:
    for j in range(n):
        target[j] = source[j] * scale
