"""Which of two columns drives the other: a displacement never leads the voltage that causes it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from adaptive.types import FloatArray

#: Share of the lagging part (sine of the mean lag) above which the order of the columns is doubted. Loops of
#: stages have -0.05 to -0.3; a hysteresis-free one has 0.
DOUBT = 0.02
#: Below this correlation the two are no loop at all, and nothing is said.
LEAST_CORRELATION = 0.8


def lead(u: FloatArray, y: FloatArray) -> float:
    """Mean sine of the angle by which ``y`` leads ``u``: negative where y lags, as in any passive stage.

    The correlation of y with the slope of u, with the sign of the gain taken out: it is the area of the loops,
    signed by the sense in which they are run through. Not finite samples are left out.
    """
    good = np.isfinite(u) & np.isfinite(y)
    u, y = u[good] - np.mean(u[good]), y[good] - np.mean(y[good])
    slope = 0.5 * (u[2:] - u[:-2])
    centre = y[1:-1]
    size = float(np.sqrt(np.sum(slope**2) * np.sum(centre**2)))
    gain = float(np.sum(u * y))
    return float(np.sum(slope * centre)) / size * float(np.sign(gain)) if size > 0.0 else 0.0


def roughness(x: FloatArray) -> float:
    """Fast noise relative to the range: the median of fourth differences, in which slow motion vanishes."""
    x = x[np.isfinite(x)]
    if len(x) < 5 or np.ptp(x) == 0.0:
        return 0.0
    return float(np.median(np.abs(np.diff(x, n=4))) / np.sqrt(70.0) / np.ptp(x))


def swapped(u: FloatArray, y: FloatArray) -> Literal["no", "likely", "certain"]:
    """Whether ``u`` and ``y`` look exchanged: by the sense of the loops, and by which one carries the noise."""
    good = np.isfinite(u) & np.isfinite(y)
    if np.count_nonzero(good) < 3 or np.ptp(u[good]) == 0.0 or np.ptp(y[good]) == 0.0:
        return "no"
    if abs(float(np.corrcoef(u[good], y[good])[0, 1])) < LEAST_CORRELATION or lead(u, y) < DOUBT:
        return "no"
    return "certain" if roughness(u) > 3.0 * roughness(y) else "likely"
