"""Factorisations that release the interpreter's lock while they run.

``scipy.linalg.lapack`` holds it for the whole call, which would block queries for milliseconds. The same
routines, taken from scipy's C interface and called through ctypes, do not. Matrices are C-ordered and
symmetric; only one triangle is read and written, which Fortran sees as the other one.

`one_thread` limits the BLAS below numpy and scipy, for functions that are called from programs that set no limit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
import scipy.linalg  # noqa: F401 - it loads scipy's BLAS, which `_pools` must find
from numba.extending import get_cython_function_address
from threadpoolctl import ThreadpoolController

from dehyst.adaptive.errors import NumericsError
from dehyst.adaptive.types import FloatArray

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
