"""Causes between the command and the actuator: amplifier_lag, slew_limit, saturation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.stage_model import CauseModel, Guess, single_guesses


@compiled
def lag_ends(u: FloatArray, ratio: float, straight: bool) -> FloatArray:
    """(n,) output of a first-order lag at the beginning of each sample. ``ratio`` = time constant / sample time.

    The input is held over a sample or, with ``straight``, runs linearly to the next one.
    """
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    decay = math.exp(-1.0 / ratio)
    slope = 1.0 - ratio * (1.0 - decay)
    for k in range(n):
        out[k] = s
        gap = (s - u[k]) * decay
        s = u[k] + gap
        if straight and k + 1 < n:
            s += (u[k + 1] - u[k]) * slope
    return out


@compiled
def slew_ends(u: FloatArray, step: float, straight: bool) -> FloatArray:
    """(n,) output of a rate limit of ``step`` volts per sample at the beginning of each sample; see `lag_ends`."""
    n = u.shape[0]
    out = np.empty(n)
    s = u[0]
    for k in range(n):
        out[k] = s
        gap = u[min(k + 1, n - 1) if straight else k] - s
        s += min(max(gap, -step), step)
    return out


@dataclass(frozen=True)
class AmplifierLag(CauseModel):
    """First-order lag of the voltage before the hysteresis, 30 µs (5 kHz) to 30 ms."""

    name: str = "amplifier_lag"
    test_answers_to_others: bool = True
    unseen_is_absent: bool = True
    fast: bool = True
    substeps: int = 4
    continuous: bool = True

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("tau_s", "s", 0.0, 0.0, 0.03, max(1e-4, 0.1 * data.dt_s), ActsOn.DRIVE),)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        dt = data.dt_s
        return single_guesses([0.1 * dt, 0.3 * dt, dt, 4.0 * dt, 12.0 * dt])

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        ratio = p[0] / data.dt_s
        return lag_ends(u_V, max(ratio, 1e-3), data.straight)


@dataclass(frozen=True)
class SlewLimit(CauseModel):
    """Rate limit of the voltage, V/s at the command."""

    name: str = "slew_limit"
    unseen_is_absent: bool = True
    fast: bool = True
    substeps: int = 4
    continuous: bool = True

    def _fastest(self, data: FitData) -> float:
        return float(np.max(data.rate_V_per_s))

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        top = self._fastest(data)
        # An amplifier takes less than 0.2 s for the full swing.
        low = min(5.0 * data.swing_V, 0.5 * top)
        return (
            ModelParameter("slew_V_per_s", "V/s", 2.0 * top, low, 2.0 * top, 0.05 * data.swing_V / 1e-3, ActsOn.DRIVE),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        top = self._fastest(data)
        low = self.parameters(data)[0].low
        grid = data.swing_V / np.array([0.7e-3, 1.5e-3, 3e-3, 6e-3, 12e-3, 25e-3, 50e-3, 0.1])
        return single_guesses([float(v) for v in grid if low < v < top])

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return slew_ends(u_V, max(float(p[0]) * data.dt_s, 1e-12), data.straight)


@dataclass(frozen=True)
class Saturation(CauseModel):
    """Saturation of the voltage at an upper and a lower limit."""

    name: str = "saturation"
    unseen_is_absent: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        """Beyond the limit the readings hardly follow the command."""
        beyond = (data.u_V > p[0]) | (data.u_V < p[1])
        if int(beyond.sum()) < 20:
            return False
        slopes = []
        for side in (data.u_V > p[0], data.u_V < p[1]):
            u, y = data.u_V[side], data.y_um[side]
            if u.size >= 20 and float(np.ptp(u)) > 0.005 * data.swing_V:
                u = u - u.mean()
                slopes.append(abs(float(u @ y) / float(u @ u)))
        return bool(slopes) and min(slopes) < 0.35 * abs(data.gain_um_per_V)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        low, high, swing = data.u_low_V, data.u_high_V, data.swing_V
        return (
            ModelParameter("u_max_V", "V", high, low + 0.5 * swing, high, 0.02 * swing, ActsOn.DRIVE),
            ModelParameter("u_min_V", "V", low, low, high - 0.5 * swing, 0.02 * swing, ActsOn.DRIVE),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        low, high, swing = data.u_low_V, data.u_high_V, data.swing_V
        tops = [[np.array([high - f * swing, low])] for f in (0.01, 0.03, 0.08, 0.16, 0.3)]
        return tops + [[np.array([high, low + f * swing])] for f in (0.01, 0.03, 0.08, 0.16)]

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return np.clip(u_V, p[1], p[0])
