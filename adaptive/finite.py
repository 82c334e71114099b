"""Whether all of a small array is finite: the question that every answer asks several times over."""

from __future__ import annotations

import math

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray

#: Of the machine's own doubles there is one description, and to compare with it takes a tenth of the time.
DOUBLE = np.dtype(np.float64)


@compiled
def all_finite_doubles(values: FloatArray) -> bool:  # pragma: no cover - compiled
    """`all_finite` for who knows that it has (n,) contiguous doubles; another kind would be compiled for."""
    for i in range(values.shape[0]):  # noqa: SIM110  # a generator would not compile
        if not math.isfinite(values[i]):
            return False
    return True


def all_finite(values: FloatArray) -> bool:
    """Whether no value of a (n,) array is NaN or infinite; as ``np.isfinite(values).all()`` in a third of its time."""
    # Compiled for the one kind of array that the online path makes; another is no reason to compile while serving.
    if values.flags.carray and values.ndim == 1 and values.dtype is DOUBLE:
        return bool(all_finite_doubles(values))
    return bool(np.isfinite(values).all())
