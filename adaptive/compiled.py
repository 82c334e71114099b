"""Numba: the decorators of all compiled code, and the vector loops that several modules need.

All compiled code is cached on disk and runs without the interpreter's lock.

Without numba, as in a process that only evaluates a followed model, the loops run in the interpreter. Those over many
samples then have a version in numpy (`in_numpy`), which gives the same numbers to rounding.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from dehyst.adaptive.types import FloatArray

try:
    import numba
    from numba.extending import register_jitable
except ImportError:
    #: Whether the loops are compiled.
    COMPILES = False
else:
    COMPILES = True

F = TypeVar("F", bound=Callable[..., Any])


def _jit(function: F, fastmath: bool | set[str]) -> F:
    if not COMPILES:
        return _interpreted(function)
    jit = functools.partial(numba.njit, nogil=True, fastmath=fastmath)
    try:
        return cast(F, jit(cache=True)(function))
    except RuntimeError:  # numba found no folder to keep the machine code in
        _warn_that_nothing_is_kept()
        return cast(F, jit()(function))


@functools.cache
def _warn_that_nothing_is_kept() -> None:
    logging.getLogger("dehyst").warning(
        "machine code cannot be kept: got neither %s nor a home that can be written to, expected one of them; every "
        "start compiles anew, for minutes: set NUMBA_CACHE_DIR to a folder that can be written to",
        Path(__file__).parent,
    )


def _interpreted(function: F) -> F:
    """``function`` where overflows and the like give infinities and NaN without a warning, as in compiled code."""

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        with np.errstate(all="ignore"):
            return function(*arguments)

    return cast(F, run)


def shared(function: F) -> F:
    """A Python function that compiled code may call too: on a record with the fields of the object that it is given.

    So that the order of a sample is compiled and each rule is with the state that it changes. It uses attributes,
    numbers and other shared or compiled functions, and no methods.
    """
    return register_jitable(function) if COMPILES else function


def in_numpy(version: F) -> Callable[[F], F]:
    """Decorator above `compiled`: where nothing is compiled, ``version`` replaces the loop."""
    return lambda function: function if COMPILES else version


def compiled(function: F) -> F:
    """Compile a loop over samples or rows. The order of operations is kept, so results are reproducible."""
    return _jit(function, False)


def compiled_contracting(function: F) -> F:
    """As `compiled`, but a product and the sum it enters may be fused (FMA). The last bit depends on the processor."""
    return _jit(function, {"contract"})


def compiled_reassociating(function: F) -> F:
    """As `compiled_contracting`, and sums may be reordered so that they vectorise. NaN and infinities stay valid."""
    return _jit(function, {"reassoc", "contract", "nsz"})


def _dot(a: FloatArray, b: FloatArray, n: int) -> float:
    return float(a[:n] @ b[:n])


@in_numpy(_dot)
@compiled_reassociating
def dot(a: FloatArray, b: FloatArray, n: int) -> float:  # pragma: no cover - compiled
    """Scalar product of the first n elements."""
    total = 0.0
    for j in range(n):
        total += a[j] * b[j]
    return total


#: float64 has a single dtype object, so that ``is`` is enough, and ten times as fast as ``==``.
DOUBLE = np.dtype(np.float64)


def _all_finite(values: FloatArray) -> bool:
    return bool(np.isfinite(values).all())


@in_numpy(_all_finite)
@compiled
def all_finite_doubles(values: FloatArray) -> bool:  # pragma: no cover - compiled
    """`all_finite` of contiguous (n,) float64. Another kind of array would be compiled for, which takes seconds."""
    for i in range(values.shape[0]):  # noqa: SIM110  # a generator would not compile
        if not math.isfinite(values[i]):
            return False
    return True


def all_finite(values: FloatArray) -> bool:
    """True where no value of an array is NaN or infinite: ``np.isfinite(values).all()`` in a third of its time."""
    if values.flags.carray and values.ndim == 1 and values.dtype is DOUBLE:
        return bool(all_finite_doubles(values))
    return bool(np.isfinite(values).all())
