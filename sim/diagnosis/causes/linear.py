"""Causes in the linear part: resonance, sensor_lag, delay."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics
from sim.diagnosis.model.forms import Form, Trial, single
from sim.diagnosis.model.measured import At, Setting, Slot


@dataclass(frozen=True)
class Resonance(Form):
    """A missing second-order mode of unit gain after the loop."""

    name: str = "resonance"
    fast: bool = True

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return bool(np.exp(p[1]) < 0.4)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        top = 0.47 / setting.dt_s
        return (
            Slot(
                "log_f0",
                "1",
                float(np.log(300.0 * top)),
                float(np.log(0.01 * top)),
                float(np.log(top)),
                0.02,
                At.DYNAMICS,
            ),
            Slot("log_damping", "1", float(np.log(0.02)), float(np.log(1e-3)), float(np.log(0.5)), 0.3, At.DYNAMICS),
        )

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        spectrum = np.abs(np.fft.rfft(np.diff(residual_um)))
        f = np.fft.rfftfreq(setting.n - 1, setting.dt_s)
        # Bins of about 2 Hz: a mode of 1 % damping at 200 Hz is that wide.
        width = max(1, round(2.0 * setting.duration_s))
        power = np.convolve(spectrum**2, np.ones(width) / width, "same")
        slots = self.slots(setting)
        inside = (f > np.exp(slots[0].low)) & (f < np.exp(slots[0].high))
        for line in (50.0, 60.0, 100.0, 120.0, 150.0, 180.0):
            inside &= np.abs(f - line) > 1.5 + 1.5 / setting.duration_s
        if not np.any(inside):
            return []
        peak = float(f[inside][np.argmax(power[inside])])
        guesses = {peak * r for r in (0.97, 0.985, 0.995, 1.0, 1.005, 1.015, 1.03)}
        guesses |= {v for v in (150.0, 250.0, 350.0, 450.0, 600.0) if np.exp(slots[0].low) < v < np.exp(slots[0].high)}
        return [[np.array([np.log(g), np.log(z)])] for g in sorted(guesses) for z in (0.01, 0.04)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        mode = (float(np.exp(p[0])), float(np.exp(p[1])))
        return replace(system, modes_hz=(*system.modes_hz, mode))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        f, z = float(np.exp(p[0])), float(np.exp(p[1]))
        return {"f0_hz": (f, np.array([f, 0.0])), "damping": (z, np.array([0.0, z]))}


@dataclass(frozen=True)
class SensorLag(Form):
    """A low-pass in the sensor's electronics."""

    name: str = "sensor_lag"
    fast: bool = True

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return (Slot("tau_s", "s", 0.0, 0.0, 0.03, max(1e-4, 0.1 * setting.dt_s), At.DYNAMICS),)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return single([f * setting.dt_s for f in (0.1, 0.3, 1.0, 3.0, 10.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, lags_s=(*system.lags_s, float(p[0]))) if p[0] > 1e-7 else system


@dataclass(frozen=True)
class Delay(Form):
    """A dead time of more than the one sample that is the recorder's own."""

    name: str = "delay"
    fast: bool = True
    pins: tuple[str, ...] = ("latch_samples",)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        dt = setting.dt_s
        return (Slot("tau_s", "s", dt, dt, max(0.01, 6.0 * dt), 0.1 * dt, At.DYNAMICS),)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return single([f * setting.dt_s for f in (1.3, 1.8, 2.5, 3.2, 4.0, 5.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, delay_s=float(p[0]))
