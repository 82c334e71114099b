"""The play operator as the chapter writes it, (2.4): slow, plain, to hold the compiled loops against."""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.types import FloatArray


def plays(u_V: FloatArray, radii_V: FloatArray) -> FloatArray:
    """Every play on its own, (m, n), relaxed at zero volts."""
    out, state = np.empty((radii_V.size, u_V.size)), np.zeros(radii_V.size)
    for k, u in enumerate(u_V):
        state = np.maximum(u - radii_V, np.minimum(u + radii_V, state))
        out[:, k] = state
    return out
