"""The frequency at which the stage rings, stretch by stretch: what a payload is seen by."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dehyst.adaptive.types import FloatArray
from dehyst.baselines.prandtl_ishlinskii.operators import play_run
from dehyst.sim.fitting.fit_data import FitData

#: Stretches of a record, and samples that one needs at least.
_STRETCHES, _LEAST_SAMPLES = 20, 300
#: Past readings: two for the mode and one for a lag beside it. Past voltages: what happens within a few samples.
_READINGS, _VOLTAGES = 3, 4
#: Radii of the plays, relative to the swing. Without them a loop's delay would be taken for the mode's.
_RADII = np.array([0.0, 0.02, 0.06, 0.12, 0.25])
#: Standard errors from which another frequency counts as seen.
SIGMAS = 8.0
#: A mode counts up to this damping ratio, where its frequency is known to this relative standard error ...
_MOST_DAMPED, _KNOWN = 0.2, 0.01
#: ... and between these shares of the frequency that is known beforehand.
_LOWEST, _HIGHEST = 0.4, 1.7
#: Plays do not describe every loop: a standard error is this many times the formal one, and this share of f besides.
_TIMES, _MODEL_ERROR = 3.0, 0.003


@dataclass(frozen=True)
class Level:
    """A frequency and its standard error, Hz."""

    f_hz: float
    error_hz: float


@dataclass(frozen=True)
class Ringing:
    """Stretches that show the mode, (m,) each: begin and end (s), frequency and its standard error (Hz)."""

    begin_s: FloatArray
    end_s: FloatArray
    f_hz: FloatArray
    error_hz: FloatArray

    def level(self, which: slice = slice(None)) -> Level:
        """The weighted median of these stretches: a loop that plays do not describe spoils single ones."""
        f_hz, weights = self.f_hz[which], self.error_hz[which] ** -2.0
        order = np.argsort(f_hz)
        at = int(np.searchsorted(np.cumsum(weights[order]), 0.5 * float(weights.sum())))
        return Level(float(f_hz[order[at]]), float(weights.sum() ** -0.5))

    def change(self) -> tuple[int, Level, Level] | None:
        """The stretch from which on the stage rings at another frequency, with those before and after; None if none."""
        found = []
        for k in range(1, self.f_hz.size):
            before, after = self.level(slice(k)), self.level(slice(k, None))
            levels = np.where(np.arange(self.f_hz.size) < k, before.f_hz, after.f_hz)
            found.append((float(np.sum(np.abs(self.f_hz - levels) / self.error_hz)), k, before, after))
        if not found:
            return None
        _, k, before, after = min(found, key=lambda split: split[0])
        apart = abs(after.f_hz - before.f_hz)
        seen = apart > SIGMAS * math.hypot(before.error_hz, after.error_hz) and apart > 0.02 * before.f_hz
        return (k, before, after) if seen else None


def ringing(data: FitData) -> Ringing | None:
    """The frequency at which the first mode that a stage file states rings, by stretch; None if it states none."""
    return data.derived("ringing", lambda: _ringing(data, data.known_modes_hz[0])) if data.known_modes_hz else None


def _ringing(data: FitData, known_hz: float) -> Ringing:
    """In each stretch, the differenced readings are regressed on their past and on that of plays of the voltage (ARX;
    Ljung, System Identification, 4.2). The least damped pole is the mode. No stage is fitted.
    """
    plays = np.asarray(play_run(data.u_V, _RADII * data.swing_V, np.full(_RADII.size, data.u_V[0]))).T
    # Some six samples a period: with more of them the noise hides the curvature that tells the frequency.
    thin = max(1, int(1.0 / (6.0 * known_hz * data.dt_s)))
    n, dt_s = data.n // thin, thin * data.dt_s
    signals = np.vstack([data.y_um, plays])[:, : n * thin].reshape(-1, n, thin).mean(axis=2)
    past = sliding_window_view(np.diff(signals, axis=1), _VOLTAGES + 1, axis=1)[:, :, ::-1]
    target = past[0, :, 0]
    columns = np.hstack([past[0, :, 1 : 1 + _READINGS], *past[1:, :, :_VOLTAGES]])
    length = max(_LEAST_SAMPLES, n // _STRETCHES)
    found = []
    for first in range(0, target.size - length + 1, length):
        inside = slice(first, first + length)
        mode = _mode(columns[inside], target[inside], dt_s)
        if mode is not None and _LOWEST < mode[0] / known_hz < _HIGHEST:
            error_hz = math.hypot(_TIMES * mode[1], _MODEL_ERROR * mode[0])
            found.append((first * dt_s, (first + length + _VOLTAGES) * dt_s, mode[0], error_hz))
    return Ringing(*np.array(found).reshape(-1, 4).T)


def _mode(columns: FloatArray, target: FloatArray, dt_s: float) -> tuple[float, float] | None:
    """Undamped frequency (Hz) of the least damped pole and its standard error; None where none is known."""
    size = np.sqrt(np.mean(np.square(columns), axis=0))
    size[size == 0.0] = 1.0
    scaled = columns / size
    weights, _, rank, _ = np.linalg.lstsq(scaled, target, rcond=1e-10)
    if rank < _READINGS:
        return None
    left = target - scaled @ weights
    a = weights[:_READINGS] / size[:_READINGS]
    poles = np.roots([1.0, *-a])
    poles = poles[poles.imag > 0.0]
    if not poles.size:
        return None
    rates = np.log(poles) / dt_s
    damping = -rates.real / np.abs(rates)
    at = int(np.argmin(damping))
    pole, rate = complex(poles[at]), complex(rates[at])
    if damping[at] > _MOST_DAMPED:
        return None
    # The pole is a root of z^3 - a1 z^2 - a2 z - a3: dz/da_j = z^(3 - j) / (3 z^2 - 2 a1 z - a2).
    steepness = 3.0 * pole**2 - 2.0 * a[0] * pole - a[1]
    moved = pole ** np.arange(_READINGS - 1, -1, -1) / steepness
    # d|rate| = Re(conj(rate) d rate) / |rate|, and d rate = dz / (z dt).
    gradient = np.real(np.conj(rate) * moved / (pole * dt_s)) / abs(rate) / (2.0 * math.pi)
    spread = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12)[:_READINGS, :_READINGS] * float(left @ left) / left.size
    gradient = gradient / size[:_READINGS]
    f_hz, error_hz = abs(rate) / (2.0 * math.pi), math.sqrt(max(float(gradient @ spread @ gradient), 0.0))
    return (f_hz, error_hz) if error_hz < _KNOWN * f_hz else None
