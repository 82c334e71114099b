"""One compiled step of either form of the window, with its checks: what `Window` and other compiled code call.

Every function takes the window's arrays and returns a status (`window_state.Status`) or a number. Nothing
allocates, nothing raises, and no step leaves the window non-finite: one that would is refused, counted and taken back.
What it holds and its solution are then what they were to the last bit; so is the factor of the Cholesky form, while
the inverse form's P may have taken in the rank-2 term that was pending, which is its value but for rounding.
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window import cholesky_form as cholesky
from adaptive.window import inverse_form as inverse
from adaptive.window.arithmetic import add_scaled, bounded, dot
from adaptive.window.arrays import (
    ACCEPTED,
    ALPHA,
    BAD_INPUT,
    BAD_INPUTS,
    COLUMN,
    CONTRACTION,
    COUNT,
    CURSOR,
    FORM,
    ILL_CONDITIONED,
    ILL_STEPS,
    INVERSE_FORM,
    LAST_WORST,
    LEAST_FACTOR,
    MOST,
    MOST_FACTOR,
    NEGLIGIBLE,
    NO_SLOT,
    NOTHING_TO_UNDO,
    REFINEMENTS,
    RESIDUAL,
    ROUND_WORST,
    ROUNDS,
    STEPS,
    SY,
    UNDO,
    UNDO_NOTHING,
    UNDONE,
    K,
    WindowArrays,
    Y,
    Z,
)
from adaptive.window.common import (
    acceptable,
    acceptable_weight,
    design_value,
    keep_for_undo,
    kernel_column,
    restore_solution,
    rotate_residual,
    row_residual,
)

# --- What either form of the window answers: means, variances, leave-one-out residuals, what is left of its rows.


@compiled_reassociating
def predict(A: WindowArrays, x: FloatArray) -> float:
    """Mean at one point. O(N d). Its scratch is the window's: one thread at a time."""
    k = A.V[K]
    kernel_column(A, x, k)
    mean: float = dot(k, A.V[ALPHA], A.C[COUNT])
    for c in range(A.beta.shape[0]):
        mean += A.beta[c] * design_value(A, x, c)
    return mean


@compiled_reassociating
def scale(A: WindowArrays) -> float:
    """Variance of the kernel process by its likelihood, y'alpha/(N - p): the unit of variances; 0 while N <= p."""
    n, p = A.C[COUNT], A.beta.shape[0]
    if n <= p:
        return 0.0
    total: float = max(dot(A.V[Y], A.V[ALPHA], n), 0.0)
    degrees: float = n - p
    return total / degrees


@compiled_reassociating
def predict_with_variance(A: WindowArrays, x: FloatArray) -> tuple[float, float, float]:
    """Mean, variance of the function in units of `scale`, and `scale`, at one point: one call for all. O(N²)."""
    k, p = A.V[K], A.beta.shape[0]
    kernel_column(A, x, k)
    mean: float = dot(k, A.V[ALPHA], A.C[COUNT])
    u = A.small[1, :p]
    for c in range(p):
        u[c] = design_value(A, x, c)
        mean += A.beta[c] * u[c]
    if A.C[FORM] == INVERSE_FORM:
        return mean, inverse.variance(A, k, u), scale(A)
    return mean, cholesky.variance(A, k, u), scale(A)


@compiled_reassociating
def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """Exact leave-one-out residuals into ``out`` (N,). O(N p²); in the Cholesky form as `window_diagonal` says."""
    if A.C[FORM] == INVERSE_FORM:
        inverse.leave_one_out(A, out)
    else:
        cholesky.leave_one_out(A, out)


@compiled_reassociating
def worst_residual(A: WindowArrays) -> float:
    """Largest residual of all rows, in units of the target. O(N²)."""
    n, worst = A.C[COUNT], 0.0
    for i in range(n):
        residual = abs(row_residual(A, i))
        if not residual <= worst:
            worst = residual
    return worst


# --- The targets of either form of the window moved all at once: as a gain and an offset, or each by its own amount.


@compiled_reassociating
def rescale_targets(A: WindowArrays, gain: float, offset: float) -> int:
    """All targets y <- (1 + gain) y + offset, in O(N p): the offset lies in the span of the unpenalised part."""
    n, y, sy, alpha, first = A.C[COUNT], A.V[Y], A.V[SY], A.V[ALPHA], A.S[0]
    factor, most, total = 1.0 + gain, abs(offset), 0.0
    if factor >= LEAST_FACTOR and factor <= MOST_FACTOR and most <= MOST:
        for j in range(n):
            most = max(most, abs(factor * y[j] + offset))
            total += (factor * sy[j] + offset * first[j]) * 0.0 + factor * alpha[j] * 0.0
    else:
        most = np.inf
    if not most <= MOST:
        A.C[BAD_INPUTS] += 1
        return BAD_INPUT
    for c in range(A.beta.shape[0]):
        total += factor * A.beta[c] * 0.0
    if total != 0.0:
        A.C[ILL_STEPS] += 1
        return ILL_CONDITIONED
    for j in range(n):
        y[j] = factor * y[j] + offset
        sy[j] = factor * sy[j] + offset * first[j]
        alpha[j] *= factor
    for c in range(A.beta.shape[0]):
        A.beta[c] *= factor
    A.beta[0] += offset
    A.C[UNDO] = UNDO_NOTHING
    return ACCEPTED


@compiled_reassociating
def shift_targets(A: WindowArrays, delta: FloatArray) -> int:
    """All targets y <- y + delta, (N,) by slot. O(N²): one product."""
    n, shifted = A.C[COUNT], A.V[COLUMN]
    for j in range(n):
        shifted[j] = A.V[Y, j] + delta[j]
    if not bounded(shifted, n, MOST):
        A.C[BAD_INPUTS] += 1
        return BAD_INPUT
    keep_for_undo(A, 0, UNDO_NOTHING)
    if A.C[FORM] == INVERSE_FORM:
        inverse.solve(A, delta, A.V[Z])
        add_scaled(A.V[SY], 1.0, A.V[Z], n)
        good = inverse.finish(A)
    else:
        cholesky.shift_targets(A, delta)
        good = cholesky.finish(A)
    if not good:
        restore_solution(A)
        factor_design(A)
        A.C[ILL_STEPS] += 1
        return ILL_CONDITIONED
    for j in range(n):
        A.V[Y, j] = shifted[j]
    return ACCEPTED


@compiled_reassociating
def factor_design(A: WindowArrays) -> bool:
    """G anew from S."""
    if A.C[FORM] == INVERSE_FORM:
        return inverse.factor_design(A)
    return cholesky.factor_design(A)


@compiled_reassociating
def refine(A: WindowArrays) -> bool:
    """One step of iterative refinement of beta and alpha, counted. O(N² p). False where it left the finite."""
    A.C[REFINEMENTS] += 1
    if A.C[FORM] == INVERSE_FORM:
        return inverse.refine(A)
    return cholesky.refine(A)


@compiled_reassociating
def _refined(A: WindowArrays) -> bool:
    """Refine after a row's residual was found too large. False where that did not bring the same row down.

    Refinement contracts by the error of P. An inverse that is wrong enough for it not to contract is one that
    the coming steps would blow up: the step is better refused.
    """
    row = A.C[CURSOR] - 1
    if row < 0:
        row = A.C[COUNT] - 1
    before = A.F[RESIDUAL]
    good = refine(A)
    n = A.C[COUNT]
    size = abs(A.V[Y, row]) + abs(A.beta[0]) + np.sqrt(dot(A.V[ALPHA], A.V[ALPHA], n))
    return good and abs(row_residual(A, row)) <= max(CONTRACTION * before, NEGLIGIBLE * size)


@compiled_reassociating
def _take_back(A: WindowArrays) -> None:
    if A.C[FORM] == INVERSE_FORM:
        inverse.undo(A)
    else:
        cholesky.undo(A)


@compiled_reassociating
def _checked(A: WindowArrays, status: int) -> int:
    """What a step comes to once the next row of the round is looked at. A refused one is counted, the row looked at
    again next time: the residual of what was taken back is not the window's."""
    if status == ACCEPTED:
        residual, worst, last = A.F[RESIDUAL], A.F[ROUND_WORST], A.F[LAST_WORST]
        cursor, rounds = A.C[CURSOR], A.C[ROUNDS]
        if not rotate_residual(A) and not _refined(A):
            _take_back(A)
            A.F[RESIDUAL], A.F[ROUND_WORST], A.F[LAST_WORST] = residual, worst, last
            A.C[CURSOR], A.C[ROUNDS] = cursor, rounds
            status = ILL_CONDITIONED
    if status == ILL_CONDITIONED:
        A.C[ILL_STEPS] += 1
    return status


@compiled_reassociating
def _conclude(A: WindowArrays, status: int) -> int:
    status = _checked(A, status)
    if status == ACCEPTED:
        A.C[STEPS] += 1
    return status


@compiled_reassociating
def replace(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> int:
    """The sample in ``slot`` makes way for (x, y) of noise weight w. O(N²).

    Checks one rotating row's residual afterwards and refines where it exceeds the tolerance.
    """
    if not acceptable(A, x, y, w):
        A.C[BAD_INPUTS] += 1
        return BAD_INPUT
    if slot < 0 or slot >= A.C[COUNT]:
        return NO_SLOT
    kernel_column(A, x, A.V[COLUMN])
    if A.C[FORM] == INVERSE_FORM:
        return _conclude(A, inverse.replace(A, slot, x, y, w))
    return _conclude(A, cholesky.replace(A, slot, x, y, w))


@compiled_reassociating
def append(A: WindowArrays, x: FloatArray, y: float, w: float) -> int:
    """One more slot, for (x, y) of noise weight w. O(N²)."""
    if not acceptable(A, x, y, w):
        A.C[BAD_INPUTS] += 1
        return BAD_INPUT
    if A.C[COUNT] >= A.P.shape[0]:
        return NO_SLOT
    kernel_column(A, x, A.V[COLUMN])
    if A.C[FORM] == INVERSE_FORM:
        return _conclude(A, inverse.append(A, x, y, w))
    return _conclude(A, cholesky.append(A, x, y, w))


@compiled_reassociating
def undo(A: WindowArrays) -> int:
    """Take back the last `replace` or `append`, if nothing but predictions happened since. O(N), or O(N²)."""
    if A.C[UNDO] == UNDO_NOTHING:
        return NOTHING_TO_UNDO
    _take_back(A)
    A.C[UNDONE] += 1
    return ACCEPTED


@compiled_reassociating
def remove(A: WindowArrays, slot: int) -> int:
    """Empty ``slot``; the sample of the last slot moves into it. O(N²)."""
    if slot < 0 or slot >= A.C[COUNT]:
        return NO_SLOT
    if A.C[FORM] == INVERSE_FORM:
        status = inverse.remove(A, slot)
    else:
        status = cholesky.remove(A, slot)
    if status != ACCEPTED:
        A.C[ILL_STEPS] += 1
    return status


@compiled_reassociating
def reweight(A: WindowArrays, slot: int, w: float) -> int:
    """Give the sample in ``slot`` the noise weight w: out and in again, which stays exact for any change. O(N²)."""
    if slot < 0 or slot >= A.C[COUNT]:
        return NO_SLOT
    if not acceptable_weight(A, w):
        A.C[BAD_INPUTS] += 1
        return BAD_INPUT
    x = A.small[0, : A.X.shape[0]]
    for i in range(x.shape[0]):
        x[i] = A.X[i, slot]
    for j in range(A.C[COUNT]):
        A.V[COLUMN, j] = A.R[slot, j]
    if A.C[FORM] == INVERSE_FORM:
        status = _checked(A, inverse.replace(A, slot, x, A.V[Y, slot], w))
    else:
        status = _checked(A, cholesky.replace(A, slot, x, A.V[Y, slot], w))
    A.C[UNDO] = UNDO_NOTHING
    return status


@compiled_reassociating
def resum(A: WindowArrays) -> bool:
    """S, Sy, beta and alpha anew from the inverse or factor as it stands. O(N² p)."""
    if A.C[FORM] == INVERSE_FORM:
        return inverse.resum(A)
    return cholesky.resum(A)
