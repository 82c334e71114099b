"""The noise floor: what the readings do while the drive stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.measured import Setting


@dataclass(frozen=True)
class Floor:
    """Standard deviation of the noise (µm) and where it was seen: ``rests``, ``holds`` or ``differences``."""

    sigma_um: float
    source: str


def standing(setting: Setting, settle_s: float = 0.3) -> BoolArray:
    """Samples at which the drive (and that of the other axis) has stood still for ``settle_s``."""
    still = setting.rate_V_per_s <= 1e-9 * max(setting.swing_V, 1e-30) / setting.dt_s
    if setting.u2_V is not None:
        still &= np.abs(np.diff(setting.u2_V, prepend=setting.u2_V[0])) == 0.0
    moves = np.flatnonzero(~still)
    last = np.full(setting.n, 0)
    last[moves] = moves
    last = np.maximum.accumulate(last)
    return np.asarray(still & (np.arange(setting.n) - last >= settle_s / setting.dt_s))


def repeated_period(u_V: FloatArray) -> int:
    """Samples after which the whole drive repeats itself exactly, at least twice; 0 where it does not."""
    n = u_V.size
    x = u_V - u_V.mean()
    if n < 64 or not np.any(x):
        return 0
    size = 1 << (2 * n - 1).bit_length()
    likeness = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: n // 2 + 1] / np.arange(n, n - n // 2 - 1, -1)
    # Behind the first fall of the autocorrelation: a smooth drive is like itself at small lags, too.
    fall = int(np.argmax(likeness < 0.5 * likeness[0]))
    if fall == 0:
        return 0
    # The first of the highest peaks: twice the period is one, too.
    lag = fall + int(np.argmax(likeness[fall:] > (1.0 - 1e-6) * np.max(likeness[fall:])))
    same = np.max(np.abs(u_V[lag:] - u_V[:-lag])) <= 1e-3 * np.ptp(u_V)
    return lag if same else 0


def noise_floor(setting: Setting) -> Floor:
    """Median over short windows at rest of the readings' spread about a line; without rests, from differences."""
    period = repeated_period(setting.u_V)
    others = [u for u in (setting.u2_V, setting.u3_V) if u is not None]
    if period and all(repeated_period(u) == period for u in others):
        # The first period is still settling where there are more than two.
        y = setting.y_um[period:] if setting.n >= 3 * period else setting.y_um
        # By blocks, and their median: where the first period came from rest, its beginning differs by more than noise.
        d = y[period:] - y[:-period]
        block = max(8, d.size // 100)
        return Floor(float(np.median(_spread(d, block)) / np.sqrt(2.0)), "repeated periods")
    window = max(16, round(0.1 / setting.dt_s))
    quiet = standing(setting)
    starts = np.arange(0, setting.n - window, window)
    whole = [int(s) for s in starts if quiet[s : s + window].all()]
    if len(whole) >= 4:
        t = np.linspace(-1.0, 1.0, window)
        pieces = np.array([setting.y_um[s : s + window] for s in whole])
        pieces = pieces - pieces.mean(axis=1, keepdims=True)
        pieces -= (pieces @ t)[:, None] * t / (t @ t)
        variance = np.sum(pieces**2, axis=1) / (window - 2)
        return Floor(float(np.sqrt(np.median(variance))), "rests")
    # The smoothest parts of the record: sixth differences leave nothing of the motion there.
    d = np.diff(setting.y_um, n=4) / np.sqrt(70.0)
    return Floor(float(np.quantile(_spread(d, max(8, d.size // 200)), 0.25)), "differences")


def _spread(d: FloatArray, block: int) -> FloatArray:
    """Standard deviation in each whole block."""
    n = d.size // block * block
    return np.asarray(np.std(d[:n].reshape(-1, block), axis=1))
