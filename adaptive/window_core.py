"""One compiled step of either form of the window, with its checks: what `Window` and other compiled code call.

Every function takes the window's arrays and returns a status (`window_state.Status`) or a number. Nothing
allocates, nothing raises, and no step leaves the window non-finite: one that would is refused, counted and taken back.
What it holds and its solution are then what they were to the last bit; so is the factor of the Cholesky form, while
the inverse form's P may have taken in the rank-2 term that was pending, which is its value but for rounding.
"""

from __future__ import annotations

import numpy as np

from adaptive import window_cholesky as cholesky
from adaptive import window_inverse as inverse
from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_answers import leave_one_out, predict, predict_with_variance, scale, worst_residual
from adaptive.window_common import acceptable, acceptable_weight, kernel_column, rotate_residual, row_residual
from adaptive.window_small import dot
from adaptive.window_state import (
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
    NEGLIGIBLE,
    NO_SLOT,
    NOTHING_TO_UNDO,
    REFINEMENTS,
    RESIDUAL,
    ROUND_WORST,
    ROUNDS,
    STEPS,
    UNDO,
    UNDO_NOTHING,
    UNDONE,
    WindowArrays,
    Y,
)
from adaptive.window_targets import rescale_targets, shift_targets

__all__ = [
    "append", "leave_one_out", "predict", "predict_with_variance", "refine", "remove", "replace", "rescale_targets",
    "resum", "reweight", "scale", "shift_targets", "undo", "worst_residual",
]  # fmt: skip


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
