"""The sliding window by the inverse P = R^-1: one kernel column and one fused pass over one triangle a step.

Replacing slot k, with the new kernel column b (b_k := 0) and p = P e_k:

    z = P b,  q = z - p (p'b)/p_kk,  q_k := 0,  s = 1 + 1/(gamma w) - b'q,  q_k := -1,
    P <- P - p p'/p_kk + q q'/s.

The rank-2 term of a step stays *pending* until the next one and is then applied in the same pass over
memory that computes z: P is read and written once a step, one triangle of it. A step that turns out bad is
refused by not adopting its pending term, which makes rolling back free. S = P H and Sy = P y ride along in
O(N p). Only one triangle exists, so that P can't lose its symmetry, which is what makes such recursions explode.
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window.arithmetic import add_scaled, dot, half_norm_small, left_out
from adaptive.window.arrays import (
    ACCEPTED,
    ALPHA,
    COLUMN,
    COUNT,
    GAMMA,
    ILL_CONDITIONED,
    MINUS,
    PENDING,
    PK,
    PLUS,
    SCHUR_SHARE,
    SY,
    TRIAL,
    UNDO,
    UNDO_APPEND,
    UNDO_NOTHING,
    UNDO_REPLACE,
    UNDO_SLOT,
    WindowArrays,
    Y,
    Z,
)
from adaptive.window.common import (
    factor_gram,
    keep_for_undo,
    move_sample,
    restore_sample,
    restore_solution,
    solve_linear,
    write_sample,
)
from adaptive.window.passes import advance, product, quadratic

# --- What a step of `adaptive.window.inverse_form` is made of: products with P and what is pending, S and Sy, columns
# of P.


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


@compiled_reassociating
def replace(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> int:
    """The sample of ``slot`` makes way for a new one whose kernel column is in COLUMN. Returns a status."""
    n = A.C[COUNT]
    b, z, p, q = A.V[COLUMN], A.V[Z], A.V[PK], A.V[TRIAL]
    b[slot] = 0.0
    multiply(A, b, z)
    keep_for_undo(A, slot, UNDO_REPLACE)
    lift_column(A, slot, p)
    pkk = p[slot]
    factor = dot(p, b, n) / pkk if pkk > 0.0 else 0.0
    for j in range(n):
        q[j] = z[j] - factor * p[j]
    q[slot] = 0.0
    noise = 1.0 / (A.F[GAMMA] * w)
    s = 1.0 + noise - dot(b, q, n)
    # What P gains and loses on its diagonal bounds what it does elsewhere.
    good = pkk > 0.0 and s > SCHUR_SHARE * noise and np.isfinite(dot(p, p, n) / pkk + dot(q, q, n) / s)
    if good:
        q[slot] = -1.0
        take_out(A, slot, p)
        write_sample(A, slot, x, y, w)
        take_in(A, slot, q, s)
        good = finish(A)
    if not good:
        # write_sample may not have run: restoring writes the same values again.
        restore_solution(A)
        restore_sample(A)
        factor_design(A)
        lower_column(A, slot, p)
        A.C[UNDO] = UNDO_NOTHING
        return ILL_CONDITIONED
    pend(A.V[MINUS], p, 1.0 / np.sqrt(pkk), n)
    A.V[MINUS, slot] = 0.0
    pend(A.V[PLUS], q, 1.0 / np.sqrt(s), n)
    A.C[PENDING] = 1
    return ACCEPTED


@compiled_reassociating
def append(A: WindowArrays, x: FloatArray, y: float, w: float) -> int:
    """A new slot takes a sample whose kernel column is in COLUMN. Returns a status."""
    n = A.C[COUNT]
    b, q = A.V[COLUMN], A.V[TRIAL]
    multiply(A, b, q)
    noise = 1.0 / (A.F[GAMMA] * w)
    s = 1.0 + noise - dot(b, q, n)
    keep_for_undo(A, n, UNDO_APPEND)
    good = s > SCHUR_SHARE * noise and np.isfinite(dot(q, q, n) / s)
    if good:
        q[n] = -1.0
        for c in range(A.H.shape[0]):
            A.S[c, n] = 0.0
        A.V[SY, n] = 0.0
        for j in range(n + 1):
            A.P[n, j] = 0.0
        write_sample(A, n, x, y, w)
        A.C[COUNT] = n + 1
        take_in(A, n, q, s)
        good = finish(A)
        A.C[COUNT] = n
    if not good:
        restore_solution(A)
        factor_design(A)
        A.C[UNDO] = UNDO_NOTHING
        return ILL_CONDITIONED
    A.C[COUNT] = n + 1
    for j in range(n + 1):
        A.V[MINUS, j] = 0.0
    pend(A.V[PLUS], q, 1.0 / np.sqrt(s), n + 1)
    A.C[PENDING] = 1
    return ACCEPTED


@compiled_reassociating
def undo(A: WindowArrays) -> None:
    """Take back the last replace or append; the caller has seen that there is one."""
    kind, slot = A.C[UNDO], A.C[UNDO_SLOT]
    if kind == UNDO_APPEND:
        A.C[COUNT] -= 1
    restore_solution(A)
    if kind == UNDO_REPLACE:
        restore_sample(A)
        lower_column(A, slot, A.V[PK])
    factor_design(A)
    for j in range(A.C[COUNT]):
        A.V[MINUS, j] = 0.0
        A.V[PLUS, j] = 0.0
    A.C[PENDING] = 0
    A.C[UNDO] = UNDO_NOTHING


@compiled_reassociating
def remove(A: WindowArrays, slot: int) -> int:
    """Empty a slot; the last slot's sample moves into it. Returns a status."""
    flush(A)
    n, p = A.C[COUNT], A.V[PK]
    keep_for_undo(A, slot, UNDO_NOTHING)
    lift_column(A, slot, p)
    pkk = p[slot]
    good = pkk > 0.0 and np.isfinite(dot(p, p, n) / pkk)
    if good:
        take_out(A, slot, p)
        good = finish(A)
    if not good:
        restore_solution(A)
        factor_design(A)
        lower_column(A, slot, p)
        return ILL_CONDITIONED
    pend(A.V[MINUS], p, 1.0 / np.sqrt(pkk), n)
    A.V[MINUS, slot] = 0.0
    A.C[PENDING] = 1
    flush(A)
    last = n - 1
    if slot != last:
        own = A.P[last, last]
        for j in range(slot):
            A.P[slot, j] = A.P[last, j]
        for i in range(slot + 1, last):
            A.P[i, slot] = A.P[last, i]
        A.P[slot, slot] = own
        for c in range(A.H.shape[0]):
            A.S[c, slot] = A.S[c, last]
        A.V[SY, slot] = A.V[SY, last]
        A.V[ALPHA, slot] = A.V[ALPHA, last]
        move_sample(A, last, slot)
    for j in range(n):
        A.P[last, j] = 0.0
    A.C[COUNT] = last
    return ACCEPTED


@compiled_reassociating
def refine(A: WindowArrays) -> bool:
    """One step of iterative refinement on S, Sy and with them on beta and alpha, by R as it is kept. O(N² p)."""
    n, p = A.C[COUNT], A.H.shape[0]
    residual, z = A.V[COLUMN], A.V[Z]
    for c in range(p + 1):
        known = A.H[c] if c < p else A.V[Y]
        unknown = A.S[c] if c < p else A.V[SY]
        for i in range(n):
            residual[i] = known[i] - dot(A.R[i], unknown, n)
        solve(A, residual, z)
        add_scaled(unknown, 1.0, z, n)
    return finish(A)


@compiled_reassociating
def resum(A: WindowArrays) -> bool:
    """S = P H and Sy = P y anew, and all that follows from them. O(N² p)."""
    for c in range(A.H.shape[0]):
        solve(A, A.H[c], A.S[c])
    solve(A, A.V[Y], A.V[SY])
    return finish(A)


@compiled_reassociating
def variance(A: WindowArrays, k: FloatArray, u: FloatArray) -> float:
    """1 - k'Pk + u'G^-1 u with the design row h of the point in ``u``, which is overwritten. In units of scale."""
    n = A.C[COUNT]
    latent = 1.0 - quadratic(A.P, n, k)
    if A.C[PENDING] != 0:
        latent += dot(A.V[MINUS], k, n) ** 2 - dot(A.V[PLUS], k, n) ** 2
    for c in range(u.shape[0]):
        u[c] -= dot(A.S[c], k, n)
    return max(latent + half_norm_small(A.G, u), 0.0)


@compiled_reassociating
def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """alpha_i / (P_ii - S_i G^-1 S_i') into ``out``."""
    p = A.H.shape[0]
    u = A.small[1, :p]
    for i in range(A.C[COUNT]):
        diagonal = A.P[i, i]
        if A.C[PENDING] != 0:
            diagonal += A.V[PLUS, i] ** 2 - A.V[MINUS, i] ** 2
        for c in range(p):
            u[c] = A.S[c, i]
        out[i] = left_out(A.V[ALPHA, i], diagonal, diagonal - half_norm_small(A.G, u))
