"""What both forms of the window share: taking a sample in, the linear part, keeping and restoring, residuals."""

from __future__ import annotations

import numpy as np

from adaptive.compiled import compiled_reassociating
from adaptive.kernels import rbf_column
from adaptive.types import FloatArray
from adaptive.window.arithmetic import add_scaled, bounded, dot, factor_small, finite, solve_small
from adaptive.window.arrays import (
    ALPHA,
    BITS,
    COLUMN,
    COUNT,
    CURSOR,
    GAMMA,
    LAST_WORST,
    LEAST_PRECISION,
    MOST,
    MOST_PRECISION,
    RESIDUAL,
    RESIDUALS_EXCEEDED,
    ROUND_OFF,
    ROUND_WORST,
    ROUNDS,
    SY,
    TOLERANCE,
    UNDO,
    UNDO_SLOT,
    UNDO_W,
    UNDO_Y,
    W,
    WindowArrays,
    Y,
)


@compiled_reassociating
def acceptable_weight(A: WindowArrays, w: float) -> bool:
    """True where the sample's noise variance 1/(gamma w) is one that double precision can tell from the kernel."""
    precision: float = A.F[GAMMA] * w
    return precision >= LEAST_PRECISION and precision <= MOST_PRECISION


@compiled_reassociating
def acceptable(A: WindowArrays, x: FloatArray, y: float, w: float) -> bool:
    """Features and target that are numbers of at most MOST, a weight as above."""
    return bounded(x, x.shape[0], MOST) and abs(y) <= MOST and acceptable_weight(A, w)


@compiled_reassociating
def kernel_column(A: WindowArrays, x: FloatArray, out: FloatArray) -> None:
    """K of the samples in use with the point ``x`` (d,) into ``out`` (N,)."""
    d = A.X.shape[0]
    scaled = A.small[0, :d]
    for i in range(d):
        scaled[i] = x[i] * A.inverse_widths[i]
    rbf_column(A.scaled, A.C[COUNT], scaled, out, A.V[BITS])


@compiled_reassociating
def design_value(A: WindowArrays, x: FloatArray, c: int) -> float:
    """Element c of the design row of the point ``x``."""
    value: float = 1.0 if c == 0 else x[A.linear[c - 1]]
    return value


@compiled_reassociating
def write_sample(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> None:
    """Put a sample into a slot, its kernel column (in COLUMN, with the slot's own element left out) into R."""
    column, row, n = A.V[COLUMN], A.R[slot], A.C[COUNT]
    for j in range(n):
        row[j] = column[j]
        A.R[j, slot] = column[j]
    A.R[slot, slot] = 1.0 + 1.0 / (A.F[GAMMA] * w)
    for i in range(x.shape[0]):
        A.X[i, slot] = x[i]
        A.scaled[i, slot] = x[i] * A.inverse_widths[i]
    for c in range(A.H.shape[0]):
        A.H[c, slot] = design_value(A, x, c)
    A.V[Y, slot] = y
    A.V[W, slot] = w


@compiled_reassociating
def keep_for_undo(A: WindowArrays, slot: int, kind: int) -> None:
    """Copy into U what a step on ``slot`` overwrites, all but P."""
    p, n = A.H.shape[0], A.C[COUNT]
    for c in range(p):
        for j in range(n):
            A.U[c, j] = A.S[c, j]
    for j in range(n):
        A.U[p, j] = A.V[SY, j]
        A.U[p + 1, j] = A.V[ALPHA, j]
        A.U[p + 2, j] = A.R[slot, j]
    for c in range(p):
        A.U[p + 3, c] = A.beta[c]
    for i in range(A.X.shape[0]):
        A.U[p + 3, p + i] = A.X[i, slot]
    A.F[UNDO_Y] = A.V[Y, slot]
    A.F[UNDO_W] = A.V[W, slot]
    A.C[UNDO] = kind
    A.C[UNDO_SLOT] = slot


@compiled_reassociating
def restore_solution(A: WindowArrays) -> None:
    """S, Sy, beta and alpha as `keep_for_undo` found them."""
    p, n = A.H.shape[0], A.C[COUNT]
    for c in range(p):
        for j in range(n):
            A.S[c, j] = A.U[c, j]
        A.beta[c] = A.U[p + 3, c]
    for j in range(n):
        A.V[SY, j] = A.U[p, j]
        A.V[ALPHA, j] = A.U[p + 1, j]


@compiled_reassociating
def restore_sample(A: WindowArrays) -> None:
    """The sample of the slot, and its row of R, as `keep_for_undo` found them."""
    p, n, slot = A.H.shape[0], A.C[COUNT], A.C[UNDO_SLOT]
    for j in range(n):
        A.R[slot, j] = A.U[p + 2, j]
        A.R[j, slot] = A.U[p + 2, j]
    for i in range(A.X.shape[0]):
        A.X[i, slot] = A.U[p + 3, p + i]
        A.scaled[i, slot] = A.X[i, slot] * A.inverse_widths[i]
    for c in range(p):
        A.H[c, slot] = 1.0 if c == 0 else A.X[A.linear[c - 1], slot]
    A.V[Y, slot] = A.F[UNDO_Y]
    A.V[W, slot] = A.F[UNDO_W]


@compiled_reassociating
def factor_gram(A: WindowArrays, left: FloatArray) -> bool:
    """G <- the factor of ``left`` S', (p, N) both. False where that is not finite."""
    p, n, good = A.H.shape[0], A.C[COUNT], True
    for c in range(p):
        for r in range(c, p):
            A.G[r, c] = dot(left[r], A.S[c], n)
            good = good and np.isfinite(A.G[r, c])
    factor_small(A.G)
    return good


@compiled_reassociating
def solve_linear(A: WindowArrays, left: FloatArray, rest: FloatArray) -> bool:
    """G anew, beta <- G^-1 ``left`` Sy and ``rest`` (N,) <- Sy - beta S. False where something is not finite."""
    p, n, sy = A.H.shape[0], A.C[COUNT], A.V[SY]
    good = factor_gram(A, left)
    for c in range(p):
        A.beta[c] = dot(left[c], sy, n)
    # Before it is solved for: a pivot of zero would hide it.
    good = good and finite(A.beta, p)
    solve_small(A.G, A.beta)
    for j in range(n):
        rest[j] = sy[j]
    for c in range(p):
        add_scaled(rest, -A.beta[c], A.S[c], n)
    return good and finite(A.beta, p) and finite(rest, n)


@compiled_reassociating
def row_residual(A: WindowArrays, i: int) -> float:
    """y_i - h_i'beta - R_i alpha: zero but for the error of the recursion. In units of the target."""
    fitted = dot(A.R[i], A.V[ALPHA], A.C[COUNT]) + dot(A.H[:, i], A.beta, A.beta.shape[0])
    residual: float = A.V[Y, i] - fitted
    return residual


@compiled_reassociating
def rotate_residual(A: WindowArrays) -> bool:
    """Check the next row of the round. False where its residual exceeds the tolerance or is not a number.

    The row of the newest sample is blind to the error of P, any other row sees it; a round of N steps has
    seen all rows. A residual r shows as an error gamma r of alpha, so the tolerance is a share of the training
    errors' size, rms(alpha)/gamma, and thereby the relative error of alpha that is put up with; what the
    scalar product itself rounds off is allowed on top.
    """
    n = A.C[COUNT]
    i = A.C[CURSOR]
    if i >= n:
        i = 0
    residual = abs(row_residual(A, i))
    A.F[RESIDUAL] = residual
    if not residual <= A.F[ROUND_WORST]:
        A.F[ROUND_WORST] = residual
    i += 1
    if i >= n:
        i = 0
        A.F[LAST_WORST] = A.F[ROUND_WORST]
        A.F[ROUND_WORST] = 0.0
        A.C[ROUNDS] += 1
    A.C[CURSOR] = i
    length = np.sqrt(dot(A.V[ALPHA], A.V[ALPHA], n))
    allowed = A.F[TOLERANCE] * length / (np.sqrt(n) * A.F[GAMMA])
    good: bool = residual <= allowed + ROUND_OFF * (abs(A.V[Y, i]) + abs(A.beta[0]) + length)
    if not good:
        A.C[RESIDUALS_EXCEEDED] += 1
    return good


@compiled_reassociating
def move_sample(A: WindowArrays, source: int, target: int) -> None:
    """Slot ``target`` takes over the sample of slot ``source``; R follows. P and S are the caller's."""
    n = A.C[COUNT]
    for i in range(A.X.shape[0]):
        A.X[i, target] = A.X[i, source]
        A.scaled[i, target] = A.scaled[i, source]
    for c in range(A.H.shape[0]):
        A.H[c, target] = A.H[c, source]
    A.V[Y, target] = A.V[Y, source]
    A.V[W, target] = A.V[W, source]
    own = A.R[source, source]
    for j in range(n):
        if j != source and j != target:
            A.R[target, j] = A.R[source, j]
            A.R[j, target] = A.R[source, j]
    A.R[target, target] = own
