"""What a run of surprising readings is: ringing, a new level, a drift, or a sensor that does not follow the stage.

The distances r(k) of the readings from where the stage must be (``adaptive.reckoning``) are explained in turn:

- a level with ringing on it: r(k) = sum a_i r(k-i) + c + noise. A mode of the stage obeys this exactly with two
  coefficients, with a lag or a second mode three and four; without any it is a plain level. The level is
  c/(1 - sum a_i), its deviation follows from the fit's covariance. So ringing, at whatever frequency, is motion and no
  level: after a knock the level is zero, however large the swing.
- the same of the shares r(k)/place(k): a change of the gain.
- a straight line: a drift under way.

The one that tells most per coefficient is taken (Bayesian information criterion). Nothing is decided from it unless the
level is ``SIGMA`` deviations beyond what is usual, or as many within it. Measured error rates: docs/learner.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray

#: Coefficients of ringing that are tried, at most.
ORDERS = 4
#: Deviations between a level and what it is decided not to be.
SIGMA = 5.0
#: A recursion whose sum of coefficients is nearer to 1 than this has no level.
NO_LEVEL = 0.05
#: Values that a fit needs beyond two for each coefficient.
SPARE = 4


class Level(NamedTuple):
    """Where readings settle.

    Attributes
    ----------
    at, std : level at the last reading and its standard deviation, in the unit of the readings; infinite deviation
    where there is none. residual : rms of what the fit leaves. order : coefficients of ringing.
    rate : change of the level from one reading to the next.
    """

    at: float
    std: float
    residual: float
    order: int
    rate: float


def level_of(r: FloatArray, noise: float, drifts: bool = False) -> Level:
    """The level of (n,) distances whose usual deviation is ``noise`` (above 0), in their unit.

    ``drifts`` : a straight line in place of a constant. Fewer than six values have no level.
    """
    out = np.array([math.nan, math.inf, math.inf, 0.0, 0.0])
    # In units of its own size, so that no sum depends on the unit.
    size = max(float(np.max(np.abs(r), initial=0.0)), noise)
    _fit(np.ascontiguousarray(r, dtype=np.float64) / size, noise / size, drifts, out)
    return Level(float(out[0]) * size, float(out[1]) * size, float(out[2]) * size, int(out[3]), float(out[4]) * size)


@compiled
def _fit(r: FloatArray, noise: float, drifts: bool, out: FloatArray) -> None:  # pragma: no cover - compiled
    """Best order by the information criterion; ``out`` is [level, deviation, residual, order, rate]."""
    n = r.shape[0]
    best = math.inf
    extra = 2 if drifts else 1
    for p in range(ORDERS + 1):
        rows, k = n - p, p + extra
        if rows < 2 * k + SPARE:
            break
        X = np.empty((rows, k))
        for i in range(rows):
            for j in range(p):
                X[i, j] = r[p + i - 1 - j]
            X[i, p] = 1.0
            if drifts:
                # Counted backwards from the last reading, so that the constant is the level there.
                X[i, p + 1] = float(i - rows + 1)
        z = r[p:]
        normal = X.T @ X
        ridge = 1e-13 * np.trace(normal)
        for j in range(k):
            normal[j, j] += ridge + 1e-300
        inverse = np.linalg.inv(normal)
        theta = inverse @ (X.T @ z)
        error = z - X @ theta
        variance = float(error @ error) / (rows - k)
        gone, squares = 1.0, 1.0
        lagged = 0.0
        for j in range(p):
            gone -= theta[j]
            squares += theta[j] * theta[j]
            lagged += theta[j] * (j + 1)
        # Noise of the readings passes through the recursion; no fit is better than that.
        told = rows * math.log(variance + 0.3 * noise * noise * squares) + k * math.log(float(rows))
        told /= rows
        if not told < best:
            continue
        best = told
        out[2], out[3] = math.sqrt(variance), float(p)
        if gone < NO_LEVEL:
            out[0], out[1], out[4] = math.nan, math.inf, 0.0
            continue
        rate = theta[p + 1] / gone if drifts else 0.0
        # With a line, r = level + rate i: the recursion shifts it by what its lags are of the rate.
        level = (theta[p] - rate * lagged) / gone
        gradient = np.zeros(k)
        for j in range(p):
            gradient[j] = level / gone
        gradient[p] = 1.0 / gone
        spread = float(gradient @ inverse @ gradient)
        out[0], out[4] = level, rate
        out[1] = math.sqrt(max(variance, noise * noise) * max(spread, 0.0))


class Slope(NamedTuple):
    """A straight line y = constant + slope x: by least squares. std : of the slope. residual : rms. share : of the
    variance of y that it explains, 0 to 1. swing : standard deviation of x."""

    slope: float
    constant: float
    std: float
    residual: float
    share: float
    swing: float


def slope_of(x: FloatArray, y: FloatArray) -> Slope:
    """How (n,) values ``y`` follow (n,) values ``x``; n at least 3."""
    n = x.size
    dx, dy = x - x.mean(), y - y.mean()
    xx, xy, yy = float(dx @ dx), float(dx @ dy), float(dy @ dy)
    if n < 3 or not xx > 0.0:
        return Slope(0.0, float(y.mean()), math.inf, math.sqrt(yy / max(n, 1)), 0.0, 0.0)
    slope = xy / xx
    left = max(yy - slope * xy, 0.0)
    share = slope * xy / yy if yy > 0.0 else 0.0
    std = math.sqrt(left / (n - 2) / xx)
    return Slope(slope, float(y.mean() - slope * x.mean()), std, math.sqrt(left / n), share, math.sqrt(xx / n))
