"""Causes between the command and the actuator: amplifier_lag, slew_limit, saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.forms import Form, Trial, single
from sim.diagnosis.model.loops_linear import lag_ends, slew_ends
from sim.diagnosis.model.measured import At, Setting, Slot


@dataclass(frozen=True)
class AmplifierLag(Form):
    """First-order lag of the voltage before the hysteresis, 30 µs (5 kHz) to 30 ms."""

    name: str = "amplifier_lag"
    fast: bool = True
    substeps: int = 4
    continuous: bool = True

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return (Slot("tau_s", "s", 0.0, 0.0, 0.03, max(1e-4, 0.1 * setting.dt_s), At.DRIVE),)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        dt = setting.dt_s
        return single([0.1 * dt, 0.3 * dt, dt, 4.0 * dt])

    def drive(self, u_V: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        ratio = p[0] / setting.dt_s
        return lag_ends(u_V, max(ratio, 1e-3), setting.straight)


@dataclass(frozen=True)
class SlewLimit(Form):
    """Rate clamp of the voltage (V/s at the command)."""

    name: str = "slew_limit"
    fast: bool = True
    substeps: int = 4
    continuous: bool = True

    def _fastest(self, setting: Setting) -> float:
        return float(np.max(setting.rate_V_per_s))

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        top = self._fastest(setting)
        # Slower than a full swing in 0.2 s is no amplifier.
        low = min(5.0 * setting.swing_V, 0.5 * top)
        return (Slot("slew_V_per_s", "V/s", 2.0 * top, low, 2.0 * top, 0.05 * setting.swing_V / 1e-3, At.DRIVE),)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        top = self._fastest(setting)
        low = self.slots(setting)[0].low
        grid = setting.swing_V / np.array([0.7e-3, 1.5e-3, 3e-3, 6e-3, 12e-3, 25e-3])
        return single([float(v) for v in grid if low < v < top])

    def drive(self, u_V: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return slew_ends(u_V, max(float(p[0]) * setting.dt_s, 1e-12), setting.straight)


@dataclass(frozen=True)
class Saturation(Form):
    """Clamp of the voltage at an upper and a lower rail."""

    name: str = "saturation"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        """Flat tops: beyond the rail the readings no longer go with the command."""
        beyond = (setting.u_V > p[0]) | (setting.u_V < p[1])
        if int(beyond.sum()) < 20:
            return False
        slopes = []
        for side in (setting.u_V > p[0], setting.u_V < p[1]):
            u, y = setting.u_V[side], setting.y_um[side]
            if u.size >= 20 and float(np.ptp(u)) > 0.005 * setting.swing_V:
                u = u - u.mean()
                slopes.append(abs(float(u @ y) / float(u @ u)))
        return bool(slopes) and min(slopes) < 0.35 * abs(setting.gain_um_per_V)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        low, high, swing = setting.u_low_V, setting.u_high_V, setting.swing_V
        return (
            Slot("u_max_V", "V", high, low + 0.5 * swing, high, 0.02 * swing, At.DRIVE),
            Slot("u_min_V", "V", low, low, high - 0.5 * swing, 0.02 * swing, At.DRIVE),
        )

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        low, high, swing = setting.u_low_V, setting.u_high_V, setting.swing_V
        tops = [[np.array([high - f * swing, low])] for f in (0.01, 0.03, 0.08, 0.16, 0.3)]
        return tops + [[np.array([high, low + f * swing])] for f in (0.01, 0.03, 0.08, 0.16)]

    def drive(self, u_V: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return np.clip(u_V, p[1], p[0])
