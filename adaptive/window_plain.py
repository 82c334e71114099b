"""The window in numpy and BLAS, nothing compiled: the inverse form behind the names of `adaptive.window_core`.

For machines without a compiler's runtime, and to read: it is the same recursion, one BLAS call a line. Slots
that are not in use are zero in every array, so that BLAS runs over all of them in place. The rank-2 term is
pending while a step is checked and applied when it is adopted; `undo` takes it off again.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas

from adaptive import window_state as ws
from adaptive.types import FloatArray
from adaptive.window_state import WindowArrays

_SCHUR_SHARE = 0.5
_PIVOT_SHARE = 1e-11
_ROUND_OFF = 1e-15
_UNDETERMINED = 1e-13


def _multiply(A: WindowArrays, b: FloatArray) -> FloatArray:
    """P b, with what is pending; Fortran sees the lower triangle of P as the upper one of its transpose."""
    z = np.asarray(blas.dsymv(1.0, A.P.T, b, lower=0), dtype=np.float64)
    if A.C[ws.PENDING]:
        minus, plus = A.V[ws.MINUS], A.V[ws.PLUS]
        z += (plus @ b) * plus - (minus @ b) * minus
    return z


def _rank_one(A: WindowArrays, factor: float, v: FloatArray) -> None:
    """P <- P + factor v v', in place, one triangle."""
    blas.dsyr(factor, v, a=A.P.T, lower=0, overwrite_a=1)


def _column(A: WindowArrays, slot: int) -> FloatArray:
    p = np.empty(A.P.shape[0])
    p[: slot + 1] = A.P[slot, : slot + 1]
    p[slot + 1 :] = A.P[slot + 1 :, slot]
    return p


def _set_column(A: WindowArrays, slot: int, p: FloatArray | float) -> None:
    A.P[slot, : slot + 1] = p if isinstance(p, float) else p[: slot + 1]
    A.P[slot + 1 :, slot] = p if isinstance(p, float) else p[slot + 1 :]


def _kernel(A: WindowArrays, x: FloatArray) -> FloatArray:
    difference = A.scaled - (x * A.inverse_widths)[:, None]
    k = np.exp(-np.einsum("ij,ij->j", difference, difference))
    k[A.C[ws.COUNT] :] = 0.0
    return np.asarray(k, dtype=np.float64)


def _design(A: WindowArrays, x: FloatArray) -> FloatArray:
    return np.concatenate([[1.0], x[A.linear]])


def _factor_design(A: WindowArrays) -> bool:
    G = A.H @ A.S.T
    factor = A.G
    factor[:] = 0.0
    if not np.all(np.isfinite(G)):
        return False
    for j in range(G.shape[0]):
        t = G[j, j] - factor[j, :j] @ factor[j, :j]
        if t > _PIVOT_SHARE * G[j, j]:
            factor[j, j] = np.sqrt(t)
            factor[j + 1 :, j] = (G[j + 1 :, j] - factor[j + 1 :, :j] @ factor[j, :j]) / factor[j, j]
    return True


def _half_small(A: WindowArrays, rhs: FloatArray) -> FloatArray:
    """The solution of G u = rhs, (p, m), zero where a pivot is."""
    u = np.zeros_like(rhs)
    for i in range(rhs.shape[0]):
        if A.G[i, i] > 0:
            u[i] = (rhs[i] - A.G[i, :i] @ u[:i]) / A.G[i, i]
    return u


def _solve_small(A: WindowArrays, rhs: FloatArray) -> FloatArray:
    u = _half_small(A, rhs)
    for i in reversed(range(rhs.shape[0])):
        u[i] = (u[i] - A.G[i + 1 :, i] @ u[i + 1 :]) / A.G[i, i] if A.G[i, i] > 0 else 0.0
    return u


def _finish(A: WindowArrays) -> bool:
    good = _factor_design(A)
    A.beta[:] = _solve_small(A, A.H @ A.V[ws.SY])
    A.V[ws.ALPHA] = A.V[ws.SY] - A.beta @ A.S
    return good and bool(np.all(np.isfinite(A.beta)) and np.all(np.isfinite(A.V[ws.ALPHA])))


def _keep(A: WindowArrays, slot: int, kind: int) -> None:
    p, n, d = A.H.shape[0], A.P.shape[0], A.X.shape[0]
    A.U[:p, :n], A.U[p, :n], A.U[p + 1, :n], A.U[p + 2, :n] = A.S, A.V[ws.SY], A.V[ws.ALPHA], A.R[slot]
    A.U[p + 3, :p], A.U[p + 3, p : p + d] = A.beta, A.X[:, slot]
    A.F[ws.UNDO_Y], A.F[ws.UNDO_W] = A.V[ws.Y, slot], A.V[ws.W, slot]
    A.C[ws.UNDO], A.C[ws.UNDO_SLOT] = kind, slot


def _write(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float, row: FloatArray) -> None:
    A.R[slot] = A.R[:, slot] = row
    A.X[:, slot], A.scaled[:, slot] = x, x * A.inverse_widths
    A.H[:, slot] = _design(A, x)
    A.V[ws.Y, slot], A.V[ws.W, slot] = y, w


def _clear(A: WindowArrays, slot: int) -> None:
    A.R[slot] = A.R[:, slot] = 0.0
    _set_column(A, slot, 0.0)
    A.X[:, slot] = A.scaled[:, slot] = A.H[:, slot] = A.S[:, slot] = 0.0
    A.V[[ws.Y, ws.W, ws.ALPHA, ws.SY], slot] = 0.0


def _restore(A: WindowArrays) -> None:
    """Everything but P as `_keep` found it."""
    p, n, d, slot = A.H.shape[0], A.P.shape[0], A.X.shape[0], A.C[ws.UNDO_SLOT]
    if A.C[ws.UNDO] == ws.UNDO_REPLACE:
        x = A.U[p + 3, p : p + d].copy()
        _write(A, slot, x, A.F[ws.UNDO_Y], A.F[ws.UNDO_W], A.U[p + 2, :n].copy())
    else:
        _clear(A, slot)
    A.S[:], A.V[ws.SY], A.V[ws.ALPHA] = A.U[:p, :n], A.U[p, :n], A.U[p + 1, :n]
    A.beta[:] = A.U[p + 3, :p]
    _factor_design(A)
    A.C[ws.UNDO] = ws.UNDO_NOTHING


def _acceptable(A: WindowArrays, x: FloatArray, y: float, w: float) -> bool:
    precision = float(A.F[ws.GAMMA]) * w
    good = ws.LEAST_PRECISION <= precision <= ws.MOST_PRECISION
    good = bool(good and np.all(np.abs(x) <= ws.MOST) and abs(y) <= ws.MOST)
    A.C[ws.BAD_INPUTS] += not good
    return good


def _take_out(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """S and Sy lose the term p p'/p_kk, the slot's elements exactly."""
    A.S[...] -= np.outer(A.S[:, slot] / p[slot], p)
    A.V[ws.SY] -= (A.V[ws.SY, slot] / p[slot]) * p
    A.S[:, slot], A.V[ws.SY, slot] = 0.0, 0.0


def _take_in(A: WindowArrays, slot: int, b: FloatArray, q: FloatArray, x: FloatArray, y: float, w: float) -> bool:
    """The second half of a step: S, Sy and, pending, P gain q q'/s. False if that is bad."""
    noise = 1.0 / (A.F[ws.GAMMA] * w)
    s = 1.0 + noise - b @ q
    if not (s > _SCHUR_SHARE * noise and np.isfinite(q @ q / s)):
        return False
    q[slot] = -1.0
    row = b.copy()
    row[slot] = 1.0 + noise
    _write(A, slot, x, y, w, row)
    A.S[...] += np.outer(A.H @ q / s, q)
    A.V[ws.SY] += (A.V[ws.Y] @ q / s) * q
    A.V[ws.PLUS] = q / np.sqrt(s)
    A.C[ws.PENDING] = 1
    return _finish(A)


def _row_residual(A: WindowArrays, i: int) -> float:
    return float(abs(A.V[ws.Y, i] - A.R[i] @ A.V[ws.ALPHA] - A.H[:, i] @ A.beta))


def _rotated(A: WindowArrays) -> bool:
    """As `window_core._checked`: look at the next row, refine where it is off. False where that did not help."""
    n, i = A.C[ws.COUNT], A.C[ws.CURSOR]
    i = 0 if i >= n else i
    residual = _row_residual(A, i)
    size = abs(A.V[ws.Y, i]) + abs(A.beta[0]) + np.sqrt(A.V[ws.ALPHA] @ A.V[ws.ALPHA])
    allowed = A.F[ws.TOLERANCE] * np.sqrt(A.V[ws.ALPHA] @ A.V[ws.ALPHA]) / (np.sqrt(n) * A.F[ws.GAMMA])
    if not residual <= allowed + _ROUND_OFF * size:
        A.C[ws.RESIDUALS_EXCEEDED] += 1
        # As in the core: a refinement that does not contract shows an inverse gone wrong.
        if not (refine(A) and _row_residual(A, i) <= max(ws.CONTRACTION * residual, ws.NEGLIGIBLE * size)):
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
        _restore(A)
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    if A.C[ws.UNDO] == ws.UNDO_REPLACE:
        _rank_one(A, -1.0, A.V[ws.MINUS])
        _set_column(A, A.C[ws.UNDO_SLOT], 0.0)
    _rank_one(A, 1.0, A.V[ws.PLUS])
    A.C[ws.STEPS] += 1
    return ws.ACCEPTED


def _exchange(A: WindowArrays, slot: int, b: FloatArray, x: FloatArray, y: float, w: float) -> int:
    """The sample of ``slot`` makes way for one whose kernel column is ``b``."""
    _keep(A, slot, ws.UNDO_REPLACE)
    b[slot] = 0.0
    p = _column(A, slot)
    own = float(p[slot])
    if not (own > 0.0 and np.isfinite(p @ p / own)):
        return _conclude(A, False)
    q = _multiply(A, b) - (p @ b / own) * p
    q[slot] = 0.0
    A.V[ws.PK], A.V[ws.MINUS] = p, p / np.sqrt(own)
    _take_out(A, slot, p)
    return _conclude(A, _take_in(A, slot, b, q, x, y, w))


def replace(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float) -> int:
    """As `window_core.replace`."""
    if not _acceptable(A, x, y, w):
        return ws.BAD_INPUT
    if not 0 <= slot < A.C[ws.COUNT]:
        return ws.NO_SLOT
    return _exchange(A, slot, _kernel(A, x), x, y, w)


def append(A: WindowArrays, x: FloatArray, y: float, w: float) -> int:
    """As `window_core.append`."""
    slot = int(A.C[ws.COUNT])
    if not _acceptable(A, x, y, w):
        return ws.BAD_INPUT
    if slot >= A.P.shape[0]:
        return ws.NO_SLOT
    _keep(A, slot, ws.UNDO_APPEND)
    b = _kernel(A, x)
    A.V[ws.MINUS] = 0.0
    A.C[ws.COUNT] = slot + 1
    return _conclude(A, _take_in(A, slot, b, _multiply(A, b), x, y, w))


def undo(A: WindowArrays) -> int:
    """As `window_core.undo`; P to round-off, what is held and its solution to the last bit."""
    kind = A.C[ws.UNDO]
    if kind == ws.UNDO_NOTHING:
        return ws.NOTHING_TO_UNDO
    _rank_one(A, -1.0, A.V[ws.PLUS])
    if kind == ws.UNDO_REPLACE:
        _rank_one(A, 1.0, A.V[ws.MINUS])
        _set_column(A, A.C[ws.UNDO_SLOT], A.V[ws.PK])
    else:
        A.C[ws.COUNT] -= 1
    _restore(A)
    A.C[ws.UNDONE] += 1
    return ws.ACCEPTED


def remove(A: WindowArrays, slot: int) -> int:
    """As `window_core.remove`."""
    last = int(A.C[ws.COUNT]) - 1
    if not 0 <= slot <= last:
        return ws.NO_SLOT
    p = _column(A, slot)
    _keep(A, slot, ws.UNDO_REPLACE)
    good = bool(p[slot] > 0.0 and np.isfinite(p @ p / p[slot]))
    if good:
        _take_out(A, slot, p)
        good = _finish(A)
    if not good:
        _restore(A)
        A.C[ws.ILL_STEPS] += 1
        return ws.ILL_CONDITIONED
    _rank_one(A, -1.0 / p[slot], p)
    if slot != last:
        moved, row = _column(A, last), A.R[last].copy()
        moved[slot], row[slot] = moved[last], row[last]
        moved[last] = row[last] = 0.0
        _set_column(A, slot, moved)
        _write(A, slot, A.X[:, last].copy(), A.V[ws.Y, last], A.V[ws.W, last], row)
        A.S[:, slot], A.V[ws.SY, slot], A.V[ws.ALPHA, slot] = A.S[:, last], A.V[ws.SY, last], A.V[ws.ALPHA, last]
    _clear(A, last)
    A.C[ws.COUNT], A.C[ws.UNDO] = last, ws.UNDO_NOTHING
    return ws.ACCEPTED


def reweight(A: WindowArrays, slot: int, w: float) -> int:
    """As `window_core.reweight`."""
    if not 0 <= slot < A.C[ws.COUNT]:
        return ws.NO_SLOT
    x = A.X[:, slot].copy()
    if not _acceptable(A, x, 0.0, w):
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
    A.V[ws.SY] += _multiply(A, delta)
    if not _finish(A):
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
        A.S[c] += _multiply(A, A.H[c] - A.R @ A.S[c])
    A.V[ws.SY] += _multiply(A, A.V[ws.Y] - A.R @ A.V[ws.SY])
    return _finish(A)


def resum(A: WindowArrays) -> bool:
    """As `window_core.resum`."""
    for c in range(A.H.shape[0]):
        A.S[c] = _multiply(A, A.H[c])
    A.V[ws.SY] = _multiply(A, A.V[ws.Y])
    return _finish(A)


def predict(A: WindowArrays, x: FloatArray) -> float:
    """As `window_core.predict`."""
    return float(_kernel(A, x) @ A.V[ws.ALPHA] + _design(A, x) @ A.beta)


def predict_with_variance(A: WindowArrays, x: FloatArray) -> tuple[float, float, float]:
    """As `window_core.predict_with_variance`."""
    k, h = _kernel(A, x), _design(A, x)
    half = _half_small(A, h - A.S @ k)
    latent = 1.0 - k @ _multiply(A, k) + half @ half
    return float(k @ A.V[ws.ALPHA] + h @ A.beta), max(float(latent), 0.0), scale(A)


def scale(A: WindowArrays) -> float:
    """As `window_core.scale`."""
    degrees = int(A.C[ws.COUNT]) - A.beta.size
    return max(float(A.V[ws.Y] @ A.V[ws.ALPHA]), 0.0) / degrees if degrees > 0 else 0.0


def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """As `window_core.leave_one_out`."""
    n = A.C[ws.COUNT]
    half = _half_small(A, A.S[:, :n])
    diagonal = np.diag(A.P)[:n]
    without = diagonal - np.sum(half * half, axis=0)
    known = without > _UNDETERMINED * diagonal
    out[:n] = np.where(known, A.V[ws.ALPHA, :n] / np.where(known, without, 1.0), np.nan)


def worst_residual(A: WindowArrays) -> float:
    """As `window_core.worst_residual`."""
    n = A.C[ws.COUNT]
    return float(np.max(np.abs(A.V[ws.Y, :n] - A.R[:n] @ A.V[ws.ALPHA] - A.beta @ A.H[:, :n]), initial=0.0))
