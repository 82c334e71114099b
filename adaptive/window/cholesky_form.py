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

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window.arithmetic import add_scaled, dot, finite, half_norm_small, left_out, solve_small
from adaptive.window.arrays import (
    ACCEPTED,
    ALPHA,
    BITS,
    CARRIED,
    COLUMN,
    COUNT,
    CURSOR,
    DIAGONAL,
    GAMMA,
    ILL_CONDITIONED,
    MINUS,
    PK,
    PLUS,
    SCHUR_SHARE,
    SY,
    TRIAL,
    UNDO,
    UNDO_APPEND,
    UNDO_NOTHING,
    UNDO_PLACE,
    UNDO_REPLACE,
    UNDO_SLOT,
    K,
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
    row_residual,
    solve_linear,
    write_sample,
)
from adaptive.window.passes import backward_columns, forward_columns, rotate_column, shift_columns

# --- The factor of `adaptive.window.cholesky_form`: solves, a sample in and out of it, what follows from it, keeping
# it.


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


# --- The diagonal of R^-1 in the Cholesky form, which a factor does not know: what leave-one-out needs of it.
#
# From the factor alone it takes O(N³). Once known it follows a step in O(N²): with the column c = R^-1 e_k of a sample,
#
#     it leaves:  d_i <- d_i - c_i²/c_k  (c of the factor before),
#     it comes:   d_i <- d_i + c_i²/c_k, d_k = c_k  (c of the factor after).
#
# Each step that carries it along also takes one element anew from the factor, in turn, so that none is older than a
# round of the window and errors don't add up. Where nobody asks for a round it is let go, and steps are as fast as
# ever.


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
    backward_columns(A.P, A.C[COUNT], t)
    for i in range(A.C[COUNT]):
        out[A.order[i]] = t[i]


@compiled_reassociating
def prepare(A: WindowArrays, place: int) -> None:
    """Before the sample at ``place`` leaves the factor: its column, which `leave` needs, into BITS."""
    if A.C[CARRIED] > 0:
        _column(A, place, A.V[BITS])


@compiled_reassociating
def leave(A: WindowArrays, slot: int, n: int) -> None:
    """The sample of ``slot``, one of n, has left."""
    if A.C[CARRIED] > 0:
        c, d = A.V[BITS], A.V[DIAGONAL]
        own = c[slot]
        for j in range(n):
            d[j] -= c[j] * c[j] / own


@compiled_reassociating
def come(A: WindowArrays, slot: int) -> None:
    """A sample has come, into ``slot``, at the end of the factor. One element in turn is taken anew."""
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
def ask(A: WindowArrays) -> FloatArray:
    """The diagonal by slot; carried along from now on for as many steps as there are samples. O(N³) if not yet."""
    n = A.C[COUNT]
    d: FloatArray = A.V[DIAGONAL]
    if A.C[CARRIED] == 0:
        for place in range(n):
            d[A.order[place]] = _half_column(A, place, A.V[MINUS])
    A.C[CARRIED] = n
    return d


@compiled_reassociating
def _begin_to_take_out(A: WindowArrays, slot: int) -> int:
    """Keep all that `take_back` needs. Returns the position of ``slot``."""
    place = position_of(A, slot)
    keep_for_undo(A, slot, UNDO_REPLACE)
    A.C[UNDO_PLACE] = place
    keep_factor(A)
    prepare(A, place)
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
    leave(A, slot, n)
    come(A, slot)
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
    come(A, n)
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
    leave(A, slot, last + 1)
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
    d = ask(A)
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
