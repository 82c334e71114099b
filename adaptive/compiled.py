"""The one door to numba: typed, cached on disk, without the interpreter's lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a loop over samples or rows. IEEE order of operations is kept: results are reproducible."""
    return cast(F, numba.njit(cache=True, nogil=True, fastmath=False)(function))


def compiled_contracting(function: F) -> F:
    """The same, with a product rounded once together with the sum that it goes into, where the processor can: half the
    steps where all is products and sums, in order; the last bit is the processor's."""
    return cast(F, numba.njit(cache=True, nogil=True, fastmath={"contract"})(function))


def compiled_reassociating(function: F) -> F:
    """As `compiled_contracting`, with sums free to be reordered so that they vectorise; NaN and infinities keep their
    meaning."""
    return cast(F, numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})(function))
