"""Narrow lines: whether one stands out of the residual, at rest as well as under drive."""

from __future__ import annotations

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.measured import Setting
from sim.diagnosis.search.noise_floor import standing


def _amplitude(residual: FloatArray, t_s: FloatArray, f_hz: float) -> tuple[float, float]:
    """Amplitude of a line and its standard error, about a slow parabola."""
    x = t_s - t_s.mean()
    span = max(float(np.ptp(x)), 1e-12)
    z = 2.0 * np.pi * f_hz * t_s
    columns = np.stack([np.sin(z), np.cos(z), np.ones_like(x), x / span, (x / span) ** 2])
    solved = np.linalg.lstsq(columns.T, residual, rcond=None)[0]
    left = residual - solved @ columns
    error = float(np.std(left)) * np.sqrt(2.0 / max(1, residual.size - 5))
    return float(np.hypot(solved[0], solved[1])), error


def line_is_there(
    residual_um: FloatArray, setting: Setting, f_hz: float, sigmas: float = 5.5, ratio: float = 3.0
) -> bool:
    """True where a line at ``f_hz`` stands out of the fast residual at rest and beside its neighbours.

    Steps and ringing have broad spectra that pass through the mains frequency; hum is narrow and does not stop.
    """
    quiet: BoolArray = standing(setting, 0.1)
    width = max(3, round(0.04 / setting.dt_s))
    fast = residual_um - np.convolve(residual_um, np.ones(width) / width, "same")
    where = quiet
    if int(quiet.sum()) * setting.dt_s < 1.0:
        # Under drive everything that repeats has lines: only one that towers over its neighbours is hum.
        where, sigmas, ratio = np.ones(setting.n, dtype=np.bool_), 3.0 * sigmas, 3.0 * ratio
    t, r = setting.t_s[where], fast[where]
    size, error = _amplitude(r, t, f_hz)
    if size < sigmas * error:
        return False
    beside = [_amplitude(r, t, f_hz + d)[0] for d in (-4.3, -3.1, -2.2, 2.2, 3.1, 4.3)]
    return size > ratio * float(np.median(beside))
