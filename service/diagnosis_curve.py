"""What a picture of a cause is made of: curves as numbers, and the means and units that they share.

Residuals are in nm, or in µm where they are large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.result import Cause
from sim.diagnosis.setting import Setting

MEASURED, WITHOUT, WITH = "measured", "without it", "with it"
#: Points beyond which a curve over time is drawn by the extremes of equal stretches.
MOST_POINTS = 6000


@dataclass(frozen=True)
class Curve:
    """One curve: ``role`` is MEASURED, WITHOUT or WITH; ``dashed`` tells a second one of the same role apart."""

    role: str
    x: FloatArray
    y: FloatArray
    note: str = ""
    dashed: bool = False
    points: bool = False
    name: str = ""

    @property
    def label(self) -> str:
        """For the legend."""
        return self.name or (f"{self.role}, {self.note}" if self.note else self.role)


@dataclass(frozen=True)
class Picture:
    """Curves over one pair of axes; ``marks`` are values of x worth a line."""

    x_name: str
    y_name: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    marks: tuple[float, ...] = ()


def envelope(t: FloatArray, y: FloatArray, most: int = MOST_POINTS) -> tuple[FloatArray, FloatArray]:
    """A long line thinned to the lowest and highest value of each stretch, so that no spike is lost."""
    if y.size <= most:
        return t, y
    width = -(-y.size // (most // 2))
    starts = np.arange(0, y.size, width)
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    return np.repeat(t[starts], 2), np.column_stack([low, high]).ravel()


def binned(x: FloatArray, y: FloatArray, bins: int = 60) -> tuple[FloatArray, FloatArray]:
    """Means of y in equal bins of x; bins of few samples are left out."""
    low, high = np.quantile(x, [0.001, 0.999])
    edges = np.linspace(low, high, bins + 1)
    place = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    mean = np.bincount(place, weights=y, minlength=bins) / np.maximum(count, 1)
    good = count > min(20, max(2, x.size // (4 * bins)))
    return 0.5 * (edges[1:] + edges[:-1])[good], mean[good]


def unit(cause: Cause) -> tuple[float, str]:
    """Factor from µm and name of the unit that suits this cause's residual."""
    return (1.0, "µm") if float(np.quantile(np.abs(cause.before_um), 0.99)) > 3.0 else (1e3, "nm")


def both(cause: Cause) -> tuple[tuple[str, FloatArray], tuple[str, FloatArray]]:
    scale = unit(cause)[0]
    return (WITHOUT, scale * cause.before_um), (WITH, scale * cause.after_um)


def slow(r_nm: FloatArray, width: int) -> FloatArray:
    """Moving mean over ``width`` samples, the same length, without the ends' bias."""
    sums = np.concatenate([[0.0], np.cumsum(r_nm)])
    half = width // 2
    low = np.clip(np.arange(r_nm.size) - half, 0, r_nm.size)
    high = np.clip(np.arange(r_nm.size) + half + 1, 0, r_nm.size)
    return np.asarray((sums[high] - sums[low]) / (high - low))


def period(setting: Setting) -> int:
    """Samples of the drive's slowest strong period: what a mean must span to see only what is slower."""
    u = setting.u_V - setting.u_V.mean()
    power = np.abs(np.fft.rfft(u * np.hanning(u.size))) ** 2
    strong = np.flatnonzero(power[3:] > 0.1 * power[3:].max())
    lowest = (int(strong[0]) + 3) if strong.size else 3
    return int(np.clip(u.size // lowest, 10, u.size // 8))
