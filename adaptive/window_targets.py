"""The targets of either form of the window moved all at once: as a gain and an offset, or each by its own amount."""

from __future__ import annotations

import numpy as np

from adaptive import window_cholesky_factor as cholesky
from adaptive import window_inverse_parts as inverse
from adaptive.compiled import compiled_reassociating
from adaptive.types import FloatArray
from adaptive.window_common import keep_for_undo, restore_solution
from adaptive.window_small import add_scaled, bounded
from adaptive.window_state import (
    ACCEPTED,
    ALPHA,
    BAD_INPUT,
    BAD_INPUTS,
    COLUMN,
    COUNT,
    FORM,
    ILL_CONDITIONED,
    ILL_STEPS,
    INVERSE_FORM,
    LEAST_FACTOR,
    MOST,
    MOST_FACTOR,
    SY,
    UNDO,
    UNDO_NOTHING,
    WindowArrays,
    Y,
    Z,
)


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
