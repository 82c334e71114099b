"""The least-squares support vector machine and its direct solver, the oracle for the recursive window.

The dual system (2.27):

    y = b + K alpha,      [ 0   1'              ] [  b  ]   [0]
                          [ 1   Omega + 1/gamma ] [alpha] = [y]

With R the lower right block and P = R^-1: S = P 1, Sy = P y, b = 1'Sy/(1'S) (2.29), alpha = Sy - b S.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
import scipy.linalg  # noqa: F401 - it loads scipy's BLAS, which `_pools` must find
from numba.extending import get_cython_function_address
from scipy.linalg import solve_triangular
from threadpoolctl import ThreadpoolController

from dehyst.adaptive import features
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray

# --- Factorisations that release the interpreter's lock while they run.
#
# ``scipy.linalg.lapack`` holds it for the whole call, which would block queries for milliseconds. The same routines,
# taken from scipy's C interface and called through ctypes, do not. Matrices are C-ordered and symmetric; only one
# triangle is read and written, which Fortran sees as the other one.
#
# `one_thread` limits the BLAS below numpy and scipy, for functions that are called from programs that set no limit.


_INT = ctypes.POINTER(ctypes.c_int)
_DOUBLES = ctypes.POINTER(ctypes.c_double)
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


@cache
def _pools() -> Any:
    return ThreadpoolController()


def one_thread(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """``function`` with one BLAS thread, whatever the environment says; the limit before is restored after it.

    Beside other work the threads of a BLAS wait for each other: two made a search three hundred times slower. The last
    bits of a result depend on their number, too.
    """

    @wraps(function)
    def limited(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with _pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _routine(name: str) -> Callable[..., Any]:
    address = get_cython_function_address("scipy.linalg.cython_lapack", name)
    return ctypes.CFUNCTYPE(None, ctypes.c_char_p, _INT, _DOUBLES, _INT, _INT)(address)


def _call(name: str, matrix: FloatArray, count: int, triangle: bytes = b"U") -> int:
    if matrix.dtype != np.float64 or not matrix.flags.c_contiguous or matrix.ndim != 2 or not matrix.flags.writeable:
        raise TypeError(f"{name}: a writeable C-ordered (N, N) float64 matrix is needed")
    n, leading, info = ctypes.c_int(count), ctypes.c_int(matrix.shape[1]), ctypes.c_int(0)
    data = matrix.ctypes.data_as(_DOUBLES)
    _routine(name)(triangle, ctypes.byref(n), data, ctypes.byref(leading), ctypes.byref(info))
    return int(info.value)


def cholesky_lower(matrix: FloatArray, count: int | None = None) -> None:
    """Lower triangle of ``matrix[:count, :count]`` -> its Cholesky factor L, R = L L', in place (potrf).

    Raises
    ------
    NumericsError : the matrix is not positive definite in double precision.
    """
    _cholesky(matrix, matrix.shape[0] if count is None else count, b"U")


def cholesky_upper(matrix: FloatArray, count: int | None = None) -> None:
    """Upper triangle of ``matrix[:count, :count]`` -> L', R = L L', in place. Raises as `cholesky_lower`."""
    _cholesky(matrix, matrix.shape[0] if count is None else count, b"L")


def _cholesky(matrix: FloatArray, n: int, triangle: bytes) -> None:
    info = _call("dpotrf", matrix, n, triangle) if n else 0
    if info != 0:
        raise NumericsError(
            f"kernel matrix: pivot {info} of {n} is not positive, expected positive definite; "
            "lower gamma, narrow the kernel, or drop duplicated samples"
        )


def inverse_from_cholesky(matrix: FloatArray, count: int | None = None) -> None:
    """Lower triangle L of ``matrix[:count, :count]`` -> lower triangle of (L L')^-1, in place (potri)."""
    n = matrix.shape[0] if count is None else count
    info = _call("dpotri", matrix, n) if n else 0
    if info != 0:
        raise NumericsError(f"kernel matrix: diagonal element {info} of its factor is zero; lower gamma")


# --- The direct solution.


def check_gamma(gamma: float) -> float:
    """Gamma as a float; raises InputError unless it is positive and finite."""
    if not (np.isfinite(gamma) and gamma > 0):
        raise InputError(f"gamma: got {gamma!r}, expected a positive finite number (the chapter starts from 100)")
    return float(gamma)


@dataclass(frozen=True, slots=True)
class LssvmModel:
    """An immutable LSSVM, everything a prediction needs (2.32). All dimensionless.

    Attributes
    ----------
    X : (N, d) support vectors.  alpha : (N,) dual weights.  bias : b.  widths : (d,) kernel widths sigma.
    scale : variance of the kernel process, 1/mu of (2.33); that of the noise is scale/gamma.
    """

    X: FloatArray
    alpha: FloatArray
    bias: float
    widths: FloatArray
    scale: float

    def predict(self, X: FloatArray) -> FloatArray:
        """Mean at the points ``X`` (M, d): (M,). Raises InputError on another number of features."""
        if X.ndim != 2 or X.shape[1] != self.X.shape[1]:
            raise InputError(f"X: got shape {X.shape}, expected (M, {self.X.shape[1]}), one row a point")
        return np.asarray(features.gram(X, self.X, self.widths) @ self.alpha + self.bias, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LssvmFit:
    """A model with what it was solved from: L (N, N), lower Cholesky factor of R, S (N, 1) = P 1, G (1, 1) = 1'P 1."""

    model: LssvmModel
    L: FloatArray
    S: FloatArray
    G: FloatArray

    def leave_one_out(self) -> FloatArray:
        """y_i minus the prediction of the model trained without sample i, exact: alpha_i / (P_ii - S_i²/G), (N,)."""
        P = self.L.copy()
        inverse_from_cholesky(P)
        diagonal = np.diag(P) - np.sum(self.S * np.linalg.solve(self.G, self.S.T).T, axis=1)
        return np.asarray(self.model.alpha / diagonal, dtype=np.float64)


@one_thread
def fit(X: FloatArray, y: FloatArray, widths: object, gamma: float) -> LssvmFit:
    """Solve (2.27) by one Cholesky factorisation.

    Parameters
    ----------
    X : (N, d) normalised features.  y : (N,) normalised targets.
    widths : kernel width sigma, one for all or (d,).  gamma : regularisation, > 0.

    Raises
    ------
    InputError : shapes, non-finite samples or hyper-parameters out of range.
    NumericsError : R is singular in double precision.
    """
    X, y = np.ascontiguousarray(X, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    if X.ndim != 2 or y.shape != (X.shape[0],):
        raise InputError(f"X, y: got shapes {X.shape} and {y.shape}, expected (N, d) and (N,)")
    n, dimension = X.shape
    if n < 2:
        raise InputError(f"X: got {n} samples, expected at least 2")
    if not (np.all(np.isfinite(X)) and np.all(np.isfinite(y))):
        raise InputError("X, y: got values that are not finite, expected finite samples; drop those rows")
    sigma, gamma = features.as_widths(widths, dimension), check_gamma(gamma)
    L = features.gram(X, None, sigma)
    L[np.diag_indices(n)] += 1.0 / gamma
    cholesky_lower(L)
    L = np.tril(L)
    half = solve_triangular(L, np.column_stack([np.ones(n), y]), lower=True, check_finite=False)
    both = solve_triangular(L, half, lower=True, trans=1, check_finite=False)
    q, r = np.linalg.qr(half[:, :-1])
    bias = solve_triangular(r, q.T @ half[:, -1], lower=False)
    alpha = solve_triangular(L, half[:, -1] - half[:, :-1] @ bias, lower=True, trans=1, check_finite=False)
    model = LssvmModel(X.copy(), alpha, float(bias[0]), sigma, max(float(y @ alpha), 0.0) / (n - 1))
    return LssvmFit(model, L, np.ascontiguousarray(both[:, :-1]), r.T @ r)
