"""What a step of `adaptive.window.plain` is made of: products with P, small solves, samples in and out of a slot."""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas

from adaptive.types import FloatArray
from adaptive.window import arrays as ws
from adaptive.window.arrays import WindowArrays


def multiply(A: WindowArrays, b: FloatArray) -> FloatArray:
    """P b, with what is pending; Fortran sees the lower triangle of P as the upper one of its transpose."""
    z = np.asarray(blas.dsymv(1.0, A.P.T, b, lower=0), dtype=np.float64)
    if A.C[ws.PENDING]:
        minus, plus = A.V[ws.MINUS], A.V[ws.PLUS]
        z += (plus @ b) * plus - (minus @ b) * minus
    return z


def rank_one(A: WindowArrays, factor: float, v: FloatArray) -> None:
    """P <- P + factor v v', in place, one triangle."""
    blas.dsyr(factor, v, a=A.P.T, lower=0, overwrite_a=1)


def column(A: WindowArrays, slot: int) -> FloatArray:
    p = np.empty(A.P.shape[0])
    p[: slot + 1] = A.P[slot, : slot + 1]
    p[slot + 1 :] = A.P[slot + 1 :, slot]
    return p


def set_column(A: WindowArrays, slot: int, p: FloatArray | float) -> None:
    A.P[slot, : slot + 1] = p if isinstance(p, float) else p[: slot + 1]
    A.P[slot + 1 :, slot] = p if isinstance(p, float) else p[slot + 1 :]


def kernel(A: WindowArrays, x: FloatArray) -> FloatArray:
    difference = A.scaled - (x * A.inverse_widths)[:, None]
    k = np.exp(-np.einsum("ij,ij->j", difference, difference))
    k[A.C[ws.COUNT] :] = 0.0
    return np.asarray(k, dtype=np.float64)


def design(A: WindowArrays, x: FloatArray) -> FloatArray:
    return np.concatenate([[1.0], x[A.linear]])


def factor_design(A: WindowArrays) -> bool:
    G = A.H @ A.S.T
    factor = A.G
    factor[:] = 0.0
    if not np.all(np.isfinite(G)):
        return False
    for j in range(G.shape[0]):
        t = G[j, j] - factor[j, :j] @ factor[j, :j]
        if t > ws.PIVOT_SHARE * G[j, j]:
            factor[j, j] = np.sqrt(t)
            factor[j + 1 :, j] = (G[j + 1 :, j] - factor[j + 1 :, :j] @ factor[j, :j]) / factor[j, j]
    return True


def half_small(A: WindowArrays, rhs: FloatArray) -> FloatArray:
    """The solution of G u = rhs, (p, m), zero where a pivot is."""
    u = np.zeros_like(rhs)
    for i in range(rhs.shape[0]):
        if A.G[i, i] > 0:
            u[i] = (rhs[i] - A.G[i, :i] @ u[:i]) / A.G[i, i]
    return u


def solve_small(A: WindowArrays, rhs: FloatArray) -> FloatArray:
    u = half_small(A, rhs)
    for i in reversed(range(rhs.shape[0])):
        u[i] = (u[i] - A.G[i + 1 :, i] @ u[i + 1 :]) / A.G[i, i] if A.G[i, i] > 0 else 0.0
    return u


def finish(A: WindowArrays) -> bool:
    good = factor_design(A)
    A.beta[:] = solve_small(A, A.H @ A.V[ws.SY])
    A.V[ws.ALPHA] = A.V[ws.SY] - A.beta @ A.S
    return good and bool(np.all(np.isfinite(A.beta)) and np.all(np.isfinite(A.V[ws.ALPHA])))


def keep(A: WindowArrays, slot: int, kind: int) -> None:
    p, n, d = A.H.shape[0], A.P.shape[0], A.X.shape[0]
    A.U[:p, :n], A.U[p, :n], A.U[p + 1, :n], A.U[p + 2, :n] = A.S, A.V[ws.SY], A.V[ws.ALPHA], A.R[slot]
    A.U[p + 3, :p], A.U[p + 3, p : p + d] = A.beta, A.X[:, slot]
    A.F[ws.UNDO_Y], A.F[ws.UNDO_W] = A.V[ws.Y, slot], A.V[ws.W, slot]
    A.C[ws.UNDO], A.C[ws.UNDO_SLOT] = kind, slot


def write(A: WindowArrays, slot: int, x: FloatArray, y: float, w: float, row: FloatArray) -> None:
    A.R[slot] = A.R[:, slot] = row
    A.X[:, slot], A.scaled[:, slot] = x, x * A.inverse_widths
    A.H[:, slot] = design(A, x)
    A.V[ws.Y, slot], A.V[ws.W, slot] = y, w


def clear(A: WindowArrays, slot: int) -> None:
    A.R[slot] = A.R[:, slot] = 0.0
    set_column(A, slot, 0.0)
    A.X[:, slot] = A.scaled[:, slot] = A.H[:, slot] = A.S[:, slot] = 0.0
    A.V[[ws.Y, ws.W, ws.ALPHA, ws.SY], slot] = 0.0


def restore(A: WindowArrays) -> None:
    """Everything but P as `keep` found it."""
    p, n, d, slot = A.H.shape[0], A.P.shape[0], A.X.shape[0], A.C[ws.UNDO_SLOT]
    if A.C[ws.UNDO] == ws.UNDO_REPLACE:
        x = A.U[p + 3, p : p + d].copy()
        write(A, slot, x, A.F[ws.UNDO_Y], A.F[ws.UNDO_W], A.U[p + 2, :n].copy())
    else:
        clear(A, slot)
    A.S[:], A.V[ws.SY], A.V[ws.ALPHA] = A.U[:p, :n], A.U[p, :n], A.U[p + 1, :n]
    A.beta[:] = A.U[p + 3, :p]
    factor_design(A)
    A.C[ws.UNDO] = ws.UNDO_NOTHING


def acceptable(A: WindowArrays, x: FloatArray, y: float, w: float) -> bool:
    precision = float(A.F[ws.GAMMA]) * w
    good = ws.LEAST_PRECISION <= precision <= ws.MOST_PRECISION
    good = bool(good and np.all(np.abs(x) <= ws.MOST) and abs(y) <= ws.MOST)
    A.C[ws.BAD_INPUTS] += not good
    return good


def take_out(A: WindowArrays, slot: int, p: FloatArray) -> None:
    """S and Sy lose the term p p'/p_kk, the slot's elements exactly."""
    A.S[...] -= np.outer(A.S[:, slot] / p[slot], p)
    A.V[ws.SY] -= (A.V[ws.SY, slot] / p[slot]) * p
    A.S[:, slot], A.V[ws.SY, slot] = 0.0, 0.0


def take_in(A: WindowArrays, slot: int, b: FloatArray, q: FloatArray, x: FloatArray, y: float, w: float) -> bool:
    """The second half of a step: S, Sy and, pending, P gain q q'/s. False if that is bad."""
    noise = 1.0 / (A.F[ws.GAMMA] * w)
    s = 1.0 + noise - b @ q
    if not (s > ws.SCHUR_SHARE * noise and np.isfinite(q @ q / s)):
        return False
    q[slot] = -1.0
    row = b.copy()
    row[slot] = 1.0 + noise
    write(A, slot, x, y, w, row)
    A.S[...] += np.outer(A.H @ q / s, q)
    A.V[ws.SY] += (A.V[ws.Y] @ q / s) * q
    A.V[ws.PLUS] = q / np.sqrt(s)
    A.C[ws.PENDING] = 1
    return finish(A)


def row_residual(A: WindowArrays, i: int) -> float:
    return float(abs(A.V[ws.Y, i] - A.R[i] @ A.V[ws.ALPHA] - A.H[:, i] @ A.beta))
