"""The steps of the sliding window, compiled: its prediction, and one sample in or out.

Replacing slot k in the inverse form, with the kernel column b of the new sample (b_k := 0) and p = P e_k:

    z = P b,  q = z - p (p'b)/p_kk,  q_k := 0,  s = 1 + 1/gamma - b'q,  q_k := -1,
    P <- P - p p'/p_kk + q q'/s.

S = P 1 and Sy = P y follow in O(N). The solution is (2.29): b = 1'Sy/(1'S) and alpha = Sy - b S. The Cholesky form is
described in `adaptive.window.arrays`.

Every function takes the arrays of the window and returns a `Status` as int, or a number. Nothing allocates and nothing
raises. A step with a result that is not finite is refused, counted and taken back: samples, alpha and bias are then
what they were to the last bit, and so is the factor of the Cholesky form. P of the inverse form may have taken in the
rank-2 term that was pending, so that it is the same up to rounding.
"""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.compiled import compiled, compiled_reassociating, dot
from dehyst.adaptive.features import rbf_column
from dehyst.adaptive.types import FloatArray, IntArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window.arrays import WindowArrays, arrays_of

# --- The kernel column of a point, and what the window predicts there.


@compiled_reassociating
def _kernel_column(A: WindowArrays, x: FloatArray, out: FloatArray) -> None:
    """K, (2.31), of the samples in use with the point ``x`` (d,) into ``out`` (N,)."""
    for i in range(A.X.shape[0]):
        A.point[i] = x[i] * A.inverse_widths[i]
    rbf_column(A.scaled, A.C[ws.COUNT], A.point, out, A.V[ws.BITS])


@compiled_reassociating
def predict(A: WindowArrays, x: FloatArray) -> float:
    """Mean at one point, (2.32). O(N d). Its scratch is the window's: one thread at a time."""
    k = A.V[ws.K]
    _kernel_column(A, x, k)
    mean: float = dot(k, A.V[ws.ALPHA], A.C[ws.COUNT]) + A.F[ws.BETA]
    return mean


@compiled
def predict_by_handle(handle: IntArray, x: FloatArray) -> float:  # pragma: no cover - compiled
    """`predict` of the window behind a handle."""
    return predict(arrays_of(handle), x)


@compiled_reassociating
def nearest(A: WindowArrays, x: FloatArray) -> tuple[int, float]:
    """Slot of the sample with the largest kernel value to ``x`` (d,), and that value; (-1, 0) while it is empty."""
    n, k = A.C[ws.COUNT], A.V[ws.K]
    _kernel_column(A, x, k)
    slot, most = -1, -1.0
    for j in range(n):
        if k[j] > most:
            slot, most = j, k[j]
    return slot, max(most, 0.0)


@compiled_reassociating
def scale(A: WindowArrays) -> float:
    """Variance of the kernel process by its likelihood, y'alpha/(N - 1): the unit of variances; 0 while N <= 1."""
    n = A.C[ws.COUNT]
    if n <= 1:
        return 0.0
    total: float = max(dot(A.V[ws.Y], A.V[ws.ALPHA], n), 0.0)
    degrees: float = n - 1
    return total / degrees


# --- A sample in a slot, and what a refused step restores.


@compiled_reassociating
def acceptable(A: WindowArrays, x: FloatArray, y: float) -> bool:
    """Features and target finite and at most MOST."""
    good = abs(y) <= ws.MOST
    for j in range(x.shape[0]):
        good = good and abs(x[j]) <= ws.MOST
    return good


@compiled_reassociating
def _write_sample(A: WindowArrays, slot: int, x: FloatArray, y: float) -> None:
    """Put a sample into a slot, and its kernel column (in COLUMN, but for the slot's own element) into R."""
    column, row, n = A.V[ws.COLUMN], A.R[slot], A.C[ws.COUNT]
    for j in range(n):
        row[j] = column[j]
        A.R[j, slot] = column[j]
    A.R[slot, slot] = 1.0 + 1.0 / A.F[ws.GAMMA]
    for i in range(x.shape[0]):
        A.X[i, slot] = x[i]
        A.scaled[i, slot] = x[i] * A.inverse_widths[i]
    A.V[ws.Y, slot] = y


@compiled_reassociating
def _keep_for_undo(A: WindowArrays, slot: int, kind: int) -> None:
    """Copy into U what a step on ``slot`` overwrites, all but P."""
    for j in range(A.C[ws.COUNT]):
        A.U[ws.UNDO_S, j] = A.S[j]
        A.U[ws.UNDO_SY, j] = A.V[ws.SY, j]
        A.U[ws.UNDO_ALPHA, j] = A.V[ws.ALPHA, j]
        A.U[ws.UNDO_R, j] = A.R[slot, j]
    A.U[ws.UNDO_POINT, 0] = A.F[ws.BETA]
    for i in range(A.X.shape[0]):
        A.U[ws.UNDO_POINT, 1 + i] = A.X[i, slot]
    A.F[ws.UNDO_Y] = A.V[ws.Y, slot]
    A.C[ws.UNDO] = kind
    A.C[ws.UNDO_SLOT] = slot


@compiled_reassociating
def _restore_solution(A: WindowArrays) -> None:
    """S, Sy, bias and alpha as `_keep_for_undo` found them. Nothing is left to undo then."""
    for j in range(A.C[ws.COUNT]):
        A.S[j] = A.U[ws.UNDO_S, j]
        A.V[ws.SY, j] = A.U[ws.UNDO_SY, j]
        A.V[ws.ALPHA, j] = A.U[ws.UNDO_ALPHA, j]
    A.F[ws.BETA] = A.U[ws.UNDO_POINT, 0]
    _factor_gram(A)
    A.C[ws.UNDO] = ws.UNDO_NOTHING


@compiled_reassociating
def _restore_sample(A: WindowArrays) -> None:
    """The sample of the slot, and its row of R, as `_keep_for_undo` found them."""
    slot = A.C[ws.UNDO_SLOT]
    for j in range(A.C[ws.COUNT]):
        A.R[slot, j] = A.U[ws.UNDO_R, j]
        A.R[j, slot] = A.U[ws.UNDO_R, j]
    for i in range(A.X.shape[0]):
        A.X[i, slot] = A.U[ws.UNDO_POINT, 1 + i]
        A.scaled[i, slot] = A.X[i, slot] * A.inverse_widths[i]
    A.V[ws.Y, slot] = A.F[ws.UNDO_Y]


# --- The solution (2.29) from S and Sy.


@compiled_reassociating
def finite(a: FloatArray, n: int) -> bool:
    """True where the first n elements are all finite."""
    total = 0.0
    for j in range(n):
        total += a[j] * 0.0
    return total == 0.0


@compiled_reassociating
def _add_up(a: FloatArray, n: int) -> float:
    """Sum of the first n elements."""
    total = 0.0
    for j in range(n):
        total += a[j]
    return total


@compiled_reassociating
def _factor_gram(A: WindowArrays) -> bool:
    """GRAM <- sqrt(1'P 1), 0 where that is not positive. False where it is not finite."""
    n = A.C[ws.COUNT]
    gram = _add_up(A.S, n) if A.C[ws.FORM] == ws.INVERSE_FORM else dot(A.S, A.S, n)
    A.F[ws.GRAM] = np.sqrt(gram) if gram > 0.0 else 0.0
    return bool(np.isfinite(gram))


@compiled_reassociating
def _solve_bias(A: WindowArrays, moment: float) -> float:
    """moment/(1'P 1): the bias for the moment 1'P y; 0 where no sample determines it."""
    root = A.F[ws.GRAM]
    return moment / root / root if root > 0.0 else 0.0


@compiled_reassociating
def finish(A: WindowArrays) -> bool:
    """Bias and alpha from S and Sy, (2.29). False, with both spoilt, where they are not finite."""
    n, sy, inverse_form = A.C[ws.COUNT], A.V[ws.SY], A.C[ws.FORM] == ws.INVERSE_FORM
    good = _factor_gram(A)
    moment = _add_up(sy, n) if inverse_form else dot(A.S, sy, n)
    # Before it is solved for: a vanishing 1'P 1 would hide it.
    good = good and bool(np.isfinite(moment))
    A.F[ws.BETA] = _solve_bias(A, moment)
    rest = A.V[ws.ALPHA] if inverse_form else A.V[ws.Z]
    for j in range(n):
        rest[j] = sy[j]
    ws.add_scaled(rest, -A.F[ws.BETA], A.S, n)
    good = good and bool(np.isfinite(A.F[ws.BETA])) and finite(rest, n)
    if inverse_form:
        return good
    ws.backward(A, rest)
    for i in range(n):
        A.V[ws.ALPHA, A.order[i]] = rest[i]
    return good and finite(rest, n)


# --- One sample in and out in the inverse form. The kernel column of the new sample is in COLUMN.


@compiled_reassociating
def _scale_into(target: FloatArray, source: FloatArray, factor: float, n: int) -> None:
    for j in range(n):
        target[j] = source[j] * factor


@compiled_reassociating
def _take_out_inverse(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """S and Sy lose the term p p'/p_kk, the slot's elements exactly."""
    n = A.C[ws.COUNT]
    ws.add_scaled(A.S, -A.S[slot] / p[slot], p, n)
    A.S[slot] = 0.0
    ws.add_scaled(A.V[ws.SY], -A.V[ws.SY, slot] / p[slot], p, n)
    A.V[ws.SY, slot] = 0.0


@compiled_reassociating
def _take_in_inverse(A: WindowArrays, q: FloatArray, s: float) -> None:
    """S and Sy gain the term q q'/s; q_slot = -1 and the slot's sample are in place."""
    n = A.C[ws.COUNT]
    ws.add_scaled(A.S, _add_up(q, n) / s, q, n)
    ws.add_scaled(A.V[ws.SY], dot(q, A.V[ws.Y], n) / s, q, n)


@compiled_reassociating
def _replace_inverse(A: WindowArrays, slot: int, x: FloatArray, y: float) -> int:
    n = A.C[ws.COUNT]
    b, z, p, q = A.V[ws.COLUMN], A.V[ws.Z], A.V[ws.PK], A.V[ws.TRIAL]
    b[slot] = 0.0
    ws.multiply(A, b, z)
    _keep_for_undo(A, slot, ws.UNDO_REPLACE)
    ws.lift_column(A, slot, p)
    pkk = p[slot]
    factor = dot(p, b, n) / pkk if pkk > 0.0 else 0.0
    for j in range(n):
        q[j] = z[j] - factor * p[j]
    q[slot] = 0.0
    noise = 1.0 / A.F[ws.GAMMA]
    s = 1.0 + noise - dot(b, q, n)
    # What P gains and loses on its diagonal bounds what it does elsewhere.
    good = pkk > 0.0 and s > ws.SCHUR_SHARE * noise and np.isfinite(dot(p, p, n) / pkk + dot(q, q, n) / s)
    if good:
        q[slot] = -1.0
        _take_out_inverse(A, slot, p)
        _write_sample(A, slot, x, y)
        _take_in_inverse(A, q, s)
        good = finish(A)
    if not good:
        # _write_sample may not have run: restoring writes the same values again.
        _restore_solution(A)
        _restore_sample(A)
        ws.lower_column(A, slot, p)
        return ws.ILL_CONDITIONED
    _scale_into(A.V[ws.MINUS], p, 1.0 / np.sqrt(pkk), n)
    A.V[ws.MINUS, slot] = 0.0
    _scale_into(A.V[ws.PLUS], q, 1.0 / np.sqrt(s), n)
    A.C[ws.PENDING] = 1
    return ws.ACCEPTED


@compiled_reassociating
def _append_inverse(A: WindowArrays, x: FloatArray, y: float) -> int:
    n = A.C[ws.COUNT]
    b, q = A.V[ws.COLUMN], A.V[ws.TRIAL]
    ws.multiply(A, b, q)
    noise = 1.0 / A.F[ws.GAMMA]
    s = 1.0 + noise - dot(b, q, n)
    _keep_for_undo(A, n, ws.UNDO_APPEND)
    good = s > ws.SCHUR_SHARE * noise and np.isfinite(dot(q, q, n) / s)
    if good:
        q[n] = -1.0
        A.S[n] = 0.0
        A.V[ws.SY, n] = 0.0
        for j in range(n + 1):
            A.P[n, j] = 0.0
        _write_sample(A, n, x, y)
        A.C[ws.COUNT] = n + 1
        _take_in_inverse(A, q, s)
        good = finish(A)
        A.C[ws.COUNT] = n
    if not good:
        _restore_solution(A)
        return ws.ILL_CONDITIONED
    A.C[ws.COUNT] = n + 1
    for j in range(n + 1):
        A.V[ws.MINUS, j] = 0.0
    _scale_into(A.V[ws.PLUS], q, 1.0 / np.sqrt(s), n + 1)
    A.C[ws.PENDING] = 1
    return ws.ACCEPTED


# --- The same in the Cholesky form.


@compiled_reassociating
def _replace_cholesky(A: WindowArrays, slot: int, x: FloatArray, y: float) -> int:
    n = A.C[ws.COUNT]
    column, half = A.V[ws.COLUMN], A.V[ws.TRIAL]
    place = ws.position_of(A, slot)
    _keep_for_undo(A, slot, ws.UNDO_REPLACE)
    for i in range(place):
        half[i] = column[A.order[i]]
    for i in range(place + 1, n):
        half[i - 1] = column[A.order[i]]
    ws.delete(A, place, half)
    noise = 1.0 / A.F[ws.GAMMA]
    s = 1.0 + noise - dot(half, half, n - 1)
    good = s > ws.SCHUR_SHARE * noise
    if good:
        A.C[ws.COUNT] = n
        _write_sample(A, slot, x, y)
        A.C[ws.COUNT] = n - 1
        ws.add(A, slot, half, np.sqrt(s))
        good = finish(A)
    if not good:
        A.C[ws.COUNT] = n
        _restore_replaced_cholesky(A)
        return ws.ILL_CONDITIONED
    return ws.ACCEPTED


@compiled_reassociating
def _restore_replaced_cholesky(A: WindowArrays) -> None:
    """The window as it was before the sample of UNDO_SLOT was replaced, to the last bit. COUNT is what it was."""
    ws.restore_factor(A)
    _restore_solution(A)
    _restore_sample(A)


@compiled_reassociating
def _append_cholesky(A: WindowArrays, x: FloatArray, y: float) -> int:
    n = A.C[ws.COUNT]
    half = A.V[ws.TRIAL]
    ws.gather(A, A.V[ws.COLUMN], half)
    ws.forward(A, half)
    noise = 1.0 / A.F[ws.GAMMA]
    s = 1.0 + noise - dot(half, half, n)
    if not s > ws.SCHUR_SHARE * noise:
        return ws.ILL_CONDITIONED
    _keep_for_undo(A, n, ws.UNDO_APPEND)
    _write_sample(A, n, x, y)
    ws.append_row(A, half)
    ws.add(A, n, half, np.sqrt(s))
    if not finish(A):
        take_back(A)
        return ws.ILL_CONDITIONED
    return ws.ACCEPTED


# --- Checks: one row's residual after each step, and iterative refinement where it is too large.


@compiled_reassociating
def _row_residual(A: WindowArrays, i: int) -> float:
    """y_i - b - R_i alpha: zero but for the error of the recursion. In units of the target."""
    fitted = dot(A.R[i], A.V[ws.ALPHA], A.C[ws.COUNT]) + A.F[ws.BETA]
    residual: float = A.V[ws.Y, i] - fitted
    return residual


@compiled_reassociating
def _rotate_residual(A: WindowArrays) -> bool:
    """Check the next row of the round. False where its residual exceeds the tolerance or is not a number.

    The row of the newest sample does not see the error of P, every other row does; a round of N steps has checked all
    rows. A residual r is an error gamma r of alpha. The tolerance is therefore a share of the size of the training
    errors, rms(alpha)/gamma, and thereby the allowed relative error of alpha; the rounding of the scalar product
    itself is added.
    """
    n = A.C[ws.COUNT]
    i = A.C[ws.CURSOR]
    if i >= n:
        i = 0
    residual = abs(_row_residual(A, i))
    A.F[ws.RESIDUAL] = residual
    if not residual <= A.F[ws.ROUND_WORST]:
        A.F[ws.ROUND_WORST] = residual
    i += 1
    if i >= n:
        i = 0
        A.F[ws.LAST_WORST] = A.F[ws.ROUND_WORST]
        A.F[ws.ROUND_WORST] = 0.0
        A.C[ws.ROUNDS] += 1
    A.C[ws.CURSOR] = i
    length = np.sqrt(dot(A.V[ws.ALPHA], A.V[ws.ALPHA], n))
    allowed = A.F[ws.TOLERANCE] * length / (np.sqrt(n) * A.F[ws.GAMMA])
    good: bool = residual <= allowed + ws.ROUND_OFF * (abs(A.V[ws.Y, i]) + abs(A.F[ws.BETA]) + length)
    if not good:
        A.C[ws.RESIDUALS_EXCEEDED] += 1
    return good


@compiled_reassociating
def resum(A: WindowArrays) -> bool:
    """S, Sy, bias and alpha anew from the inverse or factor as it stands. O(N²). False where they are not finite."""
    n, ones = A.C[ws.COUNT], A.V[ws.COLUMN]
    for j in range(n):
        ones[j] = 1.0
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        ws.solve(A, ones, A.S)
        ws.solve(A, A.V[ws.Y], A.V[ws.SY])
    else:
        ws.gather(A, ones, A.S)
        ws.forward(A, A.S)
        ws.gather(A, A.V[ws.Y], A.V[ws.SY])
        ws.forward(A, A.V[ws.SY])
    return finish(A)


@compiled_reassociating
def _refine_inverse(A: WindowArrays) -> bool:
    """One step of iterative refinement of S and Sy."""
    n, residual, z, sy = A.C[ws.COUNT], A.V[ws.COLUMN], A.V[ws.Z], A.V[ws.SY]
    for i in range(n):
        residual[i] = 1.0 - dot(A.R[i], A.S, n)
    ws.solve(A, residual, z)
    ws.add_scaled(A.S, 1.0, z, n)
    for i in range(n):
        residual[i] = A.V[ws.Y, i] - dot(A.R[i], sy, n)
    ws.solve(A, residual, z)
    ws.add_scaled(sy, 1.0, z, n)
    return finish(A)


@compiled_reassociating
def _refine_cholesky(A: WindowArrays) -> bool:
    """S and Sy anew, and one step of iterative refinement of bias and alpha."""
    n, good, t = A.C[ws.COUNT], resum(A), A.V[ws.MINUS]
    for i in range(n):
        t[i] = _row_residual(A, A.order[i])
    ws.forward(A, t)
    correction = _solve_bias(A, dot(A.S, t, n))
    ws.add_scaled(t, -correction, A.S, n)
    A.F[ws.BETA] += correction
    ws.backward(A, t)
    for i in range(n):
        A.V[ws.ALPHA, A.order[i]] += t[i]
    return good and bool(np.isfinite(A.F[ws.BETA])) and finite(A.V[ws.ALPHA], n)


@compiled_reassociating
def refine(A: WindowArrays) -> bool:
    """One step of iterative refinement of bias and alpha with R, counted. O(N²). False where it left the finite."""
    A.C[ws.REFINEMENTS] += 1
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        return _refine_inverse(A)
    return _refine_cholesky(A)


@compiled_reassociating
def _refined(A: WindowArrays) -> bool:
    """Refine after a row's residual was found too large. False where that did not reduce the same row's residual.

    Refinement contracts by the error of P. Where it does not contract, the coming steps would diverge: the step is
    refused.
    """
    row = A.C[ws.CURSOR] - 1
    if row < 0:
        row = A.C[ws.COUNT] - 1
    before = A.F[ws.RESIDUAL]
    good = refine(A)
    n = A.C[ws.COUNT]
    size = abs(A.V[ws.Y, row]) + abs(A.F[ws.BETA]) + np.sqrt(dot(A.V[ws.ALPHA], A.V[ws.ALPHA], n))
    return good and abs(_row_residual(A, row)) <= max(ws.CONTRACTION * before, ws.NEGLIGIBLE * size)


@compiled_reassociating
def take_back(A: WindowArrays) -> None:
    """Take back the last replacement or appended sample, which has just been made."""
    kind, slot = A.C[ws.UNDO], A.C[ws.UNDO_SLOT]
    if kind == ws.UNDO_APPEND:
        A.C[ws.COUNT] -= 1
        _restore_solution(A)
    elif A.C[ws.FORM] == ws.INVERSE_FORM:
        _restore_solution(A)
        _restore_sample(A)
        ws.lower_column(A, slot, A.V[ws.PK])
    else:
        _restore_replaced_cholesky(A)
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        for j in range(A.C[ws.COUNT]):
            A.V[ws.MINUS, j] = 0.0
            A.V[ws.PLUS, j] = 0.0
        A.C[ws.PENDING] = 0


@compiled_reassociating
def _checked(A: WindowArrays, status: int) -> int:
    """Status of a step after the next row of the round was checked.

    A refused step is counted. Its row is checked again next time: the residual was that of a solution which is gone.
    """
    if status == ws.ACCEPTED:
        residual, worst, last = A.F[ws.RESIDUAL], A.F[ws.ROUND_WORST], A.F[ws.LAST_WORST]
        cursor, rounds = A.C[ws.CURSOR], A.C[ws.ROUNDS]
        if not _rotate_residual(A) and not _refined(A):
            take_back(A)
            A.F[ws.RESIDUAL], A.F[ws.ROUND_WORST], A.F[ws.LAST_WORST] = residual, worst, last
            A.C[ws.CURSOR], A.C[ws.ROUNDS] = cursor, rounds
            status = ws.ILL_CONDITIONED
    if status == ws.ILL_CONDITIONED:
        A.C[ws.ILL_STEPS] += 1
    return status


# --- The steps.


@compiled_reassociating
def replace(A: WindowArrays, slot: int, x: FloatArray, y: float) -> int:
    """The sample in ``slot`` makes way for (x, y). O(N²).

    Checks one rotating row's residual afterwards and refines where it exceeds the tolerance.
    """
    if not acceptable(A, x, y):
        A.C[ws.BAD_INPUTS] += 1
        return ws.BAD_INPUT
    if slot < 0 or slot >= A.C[ws.COUNT]:
        return ws.NO_SLOT
    _kernel_column(A, x, A.V[ws.COLUMN])
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        status = _checked(A, _replace_inverse(A, slot, x, y))
    else:
        status = _checked(A, _replace_cholesky(A, slot, x, y))
    A.C[ws.STEPS] += status == ws.ACCEPTED
    return status


@compiled_reassociating
def append(A: WindowArrays, x: FloatArray, y: float) -> int:
    """One more slot, for (x, y). O(N²)."""
    if not acceptable(A, x, y):
        A.C[ws.BAD_INPUTS] += 1
        return ws.BAD_INPUT
    if A.C[ws.COUNT] >= A.P.shape[0]:
        return ws.NO_SLOT
    _kernel_column(A, x, A.V[ws.COLUMN])
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        status = _checked(A, _append_inverse(A, x, y))
    else:
        status = _checked(A, _append_cholesky(A, x, y))
    A.C[ws.STEPS] += status == ws.ACCEPTED
    return status


# --- Leave-one-out.


@compiled_reassociating
def leave_one_out(A: WindowArrays, out: FloatArray) -> None:
    """Exact leave-one-out residuals alpha_i/(P_ii - S_i²/(1'S)) into ``out`` (N,); NaN for a single sample.

    O(N) in the inverse form, O(N³) in the Cholesky form.
    """
    n, root = A.C[ws.COUNT], A.F[ws.GRAM]
    if A.C[ws.FORM] == ws.INVERSE_FORM:
        ws.inverse_diagonal(A, out)
        alpha, s = A.V[ws.ALPHA], A.S
        for i in range(n):
            half = s[i] / root if root > 0.0 else 0.0
            out[i] = _left_out(alpha[i], out[i], out[i] - half * half)
        return
    ws.cholesky_diagonal(A, out)
    t, factor = A.V[ws.TRIAL], 1.0 / root if root > 0.0 else 0.0
    for i in range(n):
        t[i] = factor * A.S[i]
    ws.backward(A, t)
    for i in range(n):
        slot = A.order[i]
        out[slot] = _left_out(A.V[ws.ALPHA, slot], out[slot], out[slot] - t[i] * t[i])


@compiled_reassociating
def _left_out(alpha: float, diagonal: float, without: float) -> float:
    """The leave-one-out residual alpha/without; NaN where the other samples do not determine the bias."""
    return alpha / without if without > ws.UNDETERMINED * diagonal else np.nan
