"""The window in numpy and BLAS, nothing compiled: the inverse form behind the names of `adaptive.window.steps`.

For machines without a compiler's runtime, and to read: it is the same recursion, one BLAS call a line. Slots
that are not in use are zero in every array, so that BLAS runs over all of them in place. The rank-2 term is
pending while a step is checked and applied when it is adopted; `undo` takes it off again.
"""

from __future__ import annotations

import numpy as np

from adaptive.types import FloatArray
from adaptive.window import arrays as ws
from adaptive.window.arrays import WindowArrays
from adaptive.window.plain_answers import leave_one_out, predict, predict_with_variance, scale, worst_residual
from adaptive.window.plain_parts import (
    acceptable,
    clear,
    column,
    finish,
    keep,
    kernel,
    multiply,
    rank_one,
    restore,
    row_residual,
    set_column,
    take_in,
    take_out,
    write,
)

__all__ = [
    "append", "leave_one_out", "predict", "predict_with_variance", "refine", "remove", "replace", "rescale_targets",
    "resum", "reweight", "scale", "shift_targets", "undo", "worst_residual",
]  # fmt: skip


def _rotated(A: WindowArrays) -> bool:
    """As `window_core._checked`: look at the next row, refine where it is off. False where that did not help."""
    n, i = A.C[ws.COUNT], A.C[ws.CURSOR]
    i = 0 if i >= n else i
    residual = row_residual(A, i)
    size = abs(A.V[ws.Y, i]) + abs(A.beta[0]) + np.sqrt(A.V[ws.ALPHA] @ A.V[ws.ALPHA])
    allowed = A.F[ws.TOLERANCE] * np.sqrt(A.V[ws.ALPHA] @ A.V[ws.ALPHA]) / (np.sqrt(n) * A.F[ws.GAMMA])
    if not residual <= allowed + ws.ROUND_OFF * size:
        A.C[ws.RESIDUALS_EXCEEDED] += 1
        # As in the core: a refinement that does not contract shows an inverse gone wrong.
        if not (refine(A) and row_residual(A, i) <= max(ws.CONTRACTION * residual, ws.NEGLIGIBLE * size)):
            return False
    A.F[ws.RESIDUAL] = residual
    A.F[ws.ROUND_WORST] = max(A.F[ws.ROUND_WORST], residual)
    A.C[ws.CURSOR] = i + 1
    if i + 1 >= n:
        A.C[ws.CURSOR] = 0
        A.F[ws.LAST_WORST], A.F[ws.ROUND_WORST] = A.F[ws.ROUND_WORST], 0.0
        A.C[ws.ROUNDS] += 1
    return True


def _conclude(A: WindowArrays, good: bool) -> int:
    """Adopt what is pending, or refuse the step: P has not been touched."""
    good = good and _rotated(A)
    A.C[ws.PENDING] = 0
    if not good:
        A.C[ws.COUNT] -= A.C[ws.UNDO] == ws.UNDO_APPEND
        restore(A)
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    if A.C[ws.UNDO] == ws.UNDO_REPLACE:
        rank_one(A, -1.0, A.V[ws.MINUS])
        set_column(A, A.C[ws.UNDO_SLOT], 0.0)
    rank_one(A, 1.0, A.V[ws.PLUS])
    A.C[ws.STEPS] += 1
    return ws.ACCEPTED


def _exchange(A: WindowArrays, slot: int, b: FloatArray, x: FloatArray, y: float, w: float) -> int:
    """The sample of ``slot`` makes way for one whose kernel column is ``b``."""
    keep(A, slot, ws.UNDO_REPLACE)
    b[slot] = 0.0
    p = column(A, slot)
    own = float(p[slot])
    if not (own > 0.0 and np.isfinite(p @ p / own)):
        return _conclude(A, False)
    q = multiply(A, b) - (p @ b / own) * p
    q[slot] = 0.0
    A.V[ws.PK], A.V[ws.MINUS] = p, p / np.sqrt(own)
    take_out(A, slot, p)
    return _conclude(A, take_in(A, slot, b, q, x, y, w))


def replace(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> int:
    """As `window_core.replace`."""
    if not acceptable(A, x, y, w):
        return ws.BAD_INPUT
    if not 0 <= slot < A.C[ws.COUNT]:
        return ws.NO_SLOT
    return _exchange(A, slot, kernel(A, x), x, y, w)


def append(A: WindowArrays, x: FloatArray, y: float, w: float) -> int:
    """As `window_core.append`."""
    slot = int(A.C[ws.COUNT])
    if not acceptable(A, x, y, w):
        return ws.BAD_INPUT
    if slot >= A.P.shape[0]:
        return ws.NO_SLOT
    keep(A, slot, ws.UNDO_APPEND)
    b = kernel(A, x)
    A.V[ws.MINUS] = 0.0
    A.C[ws.COUNT] = slot + 1
    return _conclude(A, take_in(A, slot, b, multiply(A, b), x, y, w))


def undo(A: WindowArrays) -> int:
    """As `window_core.undo`; P to round-off, what is held and its solution to the last bit."""
    kind = A.C[ws.UNDO]
    if kind == ws.UNDO_NOTHING:
        return ws.NOTHING_TO_UNDO
    rank_one(A, -1.0, A.V[ws.PLUS])
    if kind == ws.UNDO_REPLACE:
        rank_one(A, 1.0, A.V[ws.MINUS])
        set_column(A, A.C[ws.UNDO_SLOT], A.V[ws.PK])
    else:
        A.C[ws.COUNT] -= 1
    restore(A)
    A.C[ws.UNDONE] += 1
    return ws.ACCEPTED


def remove(A: WindowArrays, slot: int) -> int:
    """As `window_core.remove`."""
    last = int(A.C[ws.COUNT]) - 1
    if not 0 <= slot <= last:
        return ws.NO_SLOT
    p = column(A, slot)
    keep(A, slot, ws.UNDO_REPLACE)
    good = bool(p[slot] > 0.0 and np.isfinite(p @ p / p[slot]))
    if good:
        take_out(A, slot, p)
        good = finish(A)
    if not good:
        restore(A)
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    rank_one(A, -1.0 / p[slot], p)
    if slot != last:
        moved, row = column(A, last), A.R[last].copy()
        moved[slot], row[slot] = moved[last], row[last]
        moved[last] = row[last] = 0.0
        set_column(A, slot, moved)
        write(A, slot, A.X[:, last].copy(), A.V[ws.Y, last], A.V[ws.W, last], row)
        A.S[:, slot], A.V[ws.SY, slot], A.V[ws.ALPHA, slot] = A.S[:, last], A.V[ws.SY, last], A.V[ws.ALPHA, last]
    clear(A, last)
    A.C[ws.COUNT], A.C[ws.UNDO] = last, ws.UNDO_NOTHING
    return ws.ACCEPTED


def reweight(A: WindowArrays, slot: int, w: float) -> int:
    """As `window_core.reweight`."""
    if not 0 <= slot < A.C[ws.COUNT]:
        return ws.NO_SLOT
    x = A.X[:, slot].copy()
    if not acceptable(A, x, 0.0, w):
        return ws.BAD_INPUT
    status = _exchange(A, slot, A.R[slot].copy(), x, float(A.V[ws.Y, slot]), w)
    A.C[ws.STEPS] -= status == ws.ACCEPTED
    A.C[ws.UNDO] = ws.UNDO_NOTHING
    return status


def rescale_targets(A: WindowArrays, gain: float, offset: float) -> int:
    """As `window_core.rescale_targets`."""
    n, factor = A.C[ws.COUNT], 1.0 + gain
    good = ws.LEAST_FACTOR <= factor <= ws.MOST_FACTOR and abs(offset) <= ws.MOST
    if not (good and np.all(np.abs(factor * A.V[ws.Y, :n] + offset) <= ws.MOST)):
        A.C[ws.BAD_INPUTS] += 1
        return ws.BAD_INPUT
    sy, alpha, beta = factor * A.V[ws.SY] + offset * A.S[0], factor * A.V[ws.ALPHA], factor * A.beta
    if not np.all(np.isfinite(np.concatenate([sy, alpha, beta]))):
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    A.V[ws.Y, :n] = factor * A.V[ws.Y, :n] + offset
    A.V[ws.SY], A.V[ws.ALPHA], A.beta[:] = sy, alpha, beta
    A.beta[0] += offset
    A.C[ws.UNDO] = ws.UNDO_NOTHING
    return ws.ACCEPTED


def shift_targets(A: WindowArrays, delta: FloatArray) -> int:
    """As `window_core.shift_targets`."""
    shifted = A.V[ws.Y] + delta
    if not np.all(np.abs(shifted) <= ws.MOST):
        A.C[ws.BAD_INPUTS] += 1
        return ws.BAD_INPUT
    before = A.V[ws.SY].copy(), A.V[ws.ALPHA].copy(), A.beta.copy()
    A.V[ws.SY] += multiply(A, delta)
    if not finish(A):
        A.V[ws.SY], A.V[ws.ALPHA], A.beta[:] = before
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    A.V[ws.Y] = shifted
    A.C[ws.UNDO] = ws.UNDO_NOTHING
    return ws.ACCEPTED


def refine(A: WindowArrays) -> bool:
    """As `window_core.refine`."""
    A.C[ws.REFINEMENTS] += 1
    for c in range(A.H.shape[0]):
        A.S[c] += multiply(A, A.H[c] - A.R @ A.S[c])
    A.V[ws.SY] += multiply(A, A.V[ws.Y] - A.R @ A.V[ws.SY])
    return finish(A)


def resum(A: WindowArrays) -> bool:
    """As `window_core.resum`."""
    for c in range(A.H.shape[0]):
        A.S[c] = multiply(A, A.H[c])
    A.V[ws.SY] = multiply(A, A.V[ws.Y])
    return finish(A)
