"""The sliding window by the Cholesky factor R = L L': for kernels too ill-conditioned for the inverse.

The sample that leaves is a rank-1 *update* of the factor behind it, a chain of rotations and hence stable;
the sample that comes goes to the end: one forward solve. T = L^-1 [H y] goes through the same rotations, so
that beta follows in O(N p) and alpha by one back solve. The error of alpha grows with cond(R), not with its
square as that of the inverse does, for about twice the time.

Column j of L is row j of ``P`` (contiguous). Positions are the order of the factor, ``order`` names their
slots: the slot a sample lies in never matters to the numerics. Rotations can't be turned back to the last bit, so a
step first copies the factor into the triangle of P that is free.
"""

from __future__ import annotations

import numpy as np

from adaptive import window_diagonal as diagonal
from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_cholesky_factor import (
    add,
    backward,
    delete,
    factor_design,
    finish,
    forward,
    gather,
    keep_factor,
    position_of,
    take_back,
)
from adaptive.window_common import keep_for_undo, move_sample, restore_solution, row_residual, write_sample
from adaptive.window_small import add_scaled, dot, finite, half_norm_small, left_out, solve_small
from adaptive.window_state import (
    ACCEPTED,
    ALPHA,
    CARRIED,
    COLUMN,
    COUNT,
    DIAGONAL,
    GAMMA,
    ILL_CONDITIONED,
    MINUS,
    SCHUR_SHARE,
    SY,
    TRIAL,
    UNDO,
    UNDO_APPEND,
    UNDO_NOTHING,
    UNDO_PLACE,
    UNDO_REPLACE,
    WindowArrays,
    Y,
)


@compiled_reassociating
def _begin_to_take_out(A: WindowArrays, slot: int) -> int:
    """Keep all that `take_back` needs. Returns the position of ``slot``."""
    place = position_of(A, slot)
    keep_for_undo(A, slot, UNDO_REPLACE)
    A.C[UNDO_PLACE] = place
    keep_factor(A)
    diagonal.prepare(A, place)
    return place


@compiled_reassociating
def replace(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> int:
    """The sample of ``slot`` makes way for a new one whose kernel column is in COLUMN. Returns a status."""
    n = A.C[COUNT]
    column, half = A.V[COLUMN], A.V[TRIAL]
    place = _begin_to_take_out(A, slot)
    for i in range(place):
        half[i] = column[A.order[i]]
    for i in range(place + 1, n):
        half[i - 1] = column[A.order[i]]
    delete(A, place, half)
    noise = 1.0 / (A.F[GAMMA] * w)
    s = 1.0 + noise - dot(half, half, n - 1)
    good = s > SCHUR_SHARE * noise
    if good:
        A.C[COUNT] = n
        write_sample(A, slot, x, y, w)
        A.C[COUNT] = n - 1
        add(A, slot, half, np.sqrt(s))
        good = finish(A)
    if not good:
        A.C[COUNT] = n
        take_back(A)
        return ILL_CONDITIONED
    diagonal.leave(A, slot, n)
    diagonal.come(A, slot)
    return ACCEPTED


@compiled_reassociating
def undo(A: WindowArrays) -> None:
    """Take back the last replace or append, to the last bit; the caller has seen that there is one."""
    if A.C[UNDO] == UNDO_REPLACE:
        take_back(A)
    else:
        A.C[COUNT] -= 1
        restore_solution(A)
        factor_design(A)
        A.C[UNDO] = UNDO_NOTHING
    A.C[CARRIED] = 0


@compiled_reassociating
def append(A: WindowArrays, x: FloatArray, y: float, w: float) -> int:
    """A new slot takes a sample whose kernel column is in COLUMN. Returns a status."""
    n = A.C[COUNT]
    half = A.V[TRIAL]
    gather(A, A.V[COLUMN], half)
    forward(A, half)
    noise = 1.0 / (A.F[GAMMA] * w)
    s = 1.0 + noise - dot(half, half, n)
    if not s > SCHUR_SHARE * noise:
        return ILL_CONDITIONED
    keep_for_undo(A, n, UNDO_APPEND)
    write_sample(A, n, x, y, w)
    add(A, n, half, np.sqrt(s))
    if not finish(A):
        undo(A)
        return ILL_CONDITIONED
    diagonal.come(A, n)
    return ACCEPTED


@compiled_reassociating
def remove(A: WindowArrays, slot: int) -> int:
    """Empty a slot; the last slot's sample moves into it. Returns a status."""
    last = A.C[COUNT] - 1
    scratch = A.V[TRIAL]
    place = _begin_to_take_out(A, slot)
    for i in range(last + 1):
        scratch[i] = 0.0
    delete(A, place, scratch)
    if not finish(A):
        A.C[COUNT] = last + 1
        take_back(A)
        return ILL_CONDITIONED
    diagonal.leave(A, slot, last + 1)
    if slot != last:
        A.C[COUNT] = last + 1
        move_sample(A, last, slot)
        A.C[COUNT] = last
        A.order[position_of(A, last)] = slot
        A.V[ALPHA, slot] = A.V[ALPHA, last]
        A.V[DIAGONAL, slot] = A.V[DIAGONAL, last]
    A.C[UNDO] = UNDO_NOTHING
    return ACCEPTED


@compiled_reassociating
def resum(A: WindowArrays) -> bool:
    """T = L^-1 [H y] anew, and all that follows from it. O(N² p)."""
    for c in range(A.H.shape[0]):
        gather(A, A.H[c], A.S[c])
        forward(A, A.S[c])
    gather(A, A.V[Y], A.V[SY])
    forward(A, A.V[SY])
    return finish(A)


@compiled_reassociating
def refine(A: WindowArrays) -> bool:
    """T anew, and one step of iterative refinement on beta and alpha, by R as it is kept. O(N² p)."""
    n, p = A.C[COUNT], A.H.shape[0]
    good = resum(A)
    t, correction = A.V[MINUS], A.small[2, :p]
    for i in range(n):
        t[i] = row_residual(A, A.order[i])
    forward(A, t)
    for c in range(p):
        correction[c] = dot(A.S[c], t, n)
    solve_small(A.G, correction)
    for c in range(p):
        add_scaled(t, -correction[c], A.S[c], n)
        A.beta[c] += correction[c]
    backward(A, t)
    for i in range(n):
        A.V[ALPHA, A.order[i]] += t[i]
    return good and finite(A.beta, p) and finite(A.V[ALPHA], n)


@compiled_reassociating
def variance(A: WindowArrays, k: FloatArray, u: FloatArray) -> float:
    """1 - k'Pk + u'G^-1 u with the design row h of the point in ``u``, which is overwritten. In units of scale."""
    n, half = A.C[COUNT], A.V[MINUS]
    gather(A, k, half)
    forward(A, half)
    latent = 1.0 - dot(half, half, n)
    for c in range(u.shape[0]):
        u[c] -= dot(A.S[c], half, n)
    return max(latent + half_norm_small(A.G, u), 0.0)


@compiled_reassociating
def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """alpha_i / (P_ii - S_i G^-1 S_i') into ``out``. O(N² p) where the diagonal of P is carried along, else O(N³).

    S_i G^-1 S_i' is the sum of squares of row i of L'^-1 T g'^-1, with g the factor of G.
    """
    n, p, t, u = A.C[COUNT], A.H.shape[0], A.V[TRIAL], A.small[1]
    d = diagonal.ask(A)
    for i in range(n):
        out[i] = d[i]
    for c in range(p):
        for r in range(n):
            t[r] = 0.0
        for k in range(c + 1):
            r = c - k
            u[r] = 1.0 if k == 0 else 0.0
            for j in range(r + 1, c + 1):
                u[r] -= A.G[j, r] * u[j]
            # A column that the samples do not tell apart has no part in it.
            u[r] = u[r] / A.G[r, r] if A.G[r, r] > 0.0 and A.G[c, c] > 0.0 else 0.0
            add_scaled(t, u[r], A.S[r], n)
        backward(A, t)
        for i in range(n):
            out[A.order[i]] -= t[i] * t[i]
    for i in range(n):
        out[i] = left_out(A.V[ALPHA, i], d[i], out[i])
