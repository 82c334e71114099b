"""Causes in the reading: sensor_nonlinearity, mains_hum, timing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.forms import Form, Trial, single
from sim.diagnosis.model.loops_linear import resample
from sim.diagnosis.model.measured import At, Setting, Slot


@dataclass(frozen=True)
class SensorNonlinearity(Form):
    """A single-valued bend of the reading, second to fourth order, at most 0.4 % of the range."""

    name: str = "sensor_nonlinearity"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return bool(np.max(np.abs(p)) < 0.99 * 0.008)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return tuple(Slot(f"order{j}", "1", 0.0, -0.008, 0.008, 5e-4, At.READING) for j in (2, 3, 4))

    def reading(self, y_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        half = 0.5 * setting.range_um
        x = (y_um - setting.centre_um) / half
        # Orthogonal polynomials: their shares of the bend can be read one by one.
        x2 = x * x
        bend = p[0] * (x2 - 1.0) + x * (p[1] * (x2 - 1.0)) + p[2] * (x2 * x2 - x2)
        return np.asarray(y_um + half * bend)

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        out = {}
        for i, name in enumerate(("quadratic", "cubic", "quartic")):
            row = np.zeros(p.size)
            row[i] = 0.5
            out[name] = (0.5 * float(p[i]), row)
        return out


@dataclass(frozen=True)
class MainsHum(Form):
    """Lines at 50 or 60 Hz and their first harmonics, phases free. ``variant`` is the frequency."""

    name: str = "mains_hum"
    of_one_recording: bool = True
    variant: str = "50"

    def applies(self, setting: Setting) -> str:
        return "" if float(self.variant) < 0.48 / setting.dt_s else "a sample rate above twice the mains frequency"

    def orders(self, setting: Setting) -> list[int]:
        return [k for k in (1, 2, 3) if k * float(self.variant) < 0.48 / setting.dt_s]

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        f, top = float(self.variant), 0.005 * setting.range_um
        own: list[Slot] = [Slot("frequency_hz", "Hz", f, f - 0.6, f + 0.6, 0.05 / setting.duration_s, At.READING)]
        for k in self.orders(setting):
            own += [Slot(f"{w}{k}_um", "µm", 0.0, -top, top, 1e-3 * top, At.READING) for w in ("sin", "cos")]
        return tuple(own)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        # The line's own frequency to a small part of a bin, from the residual's spectrum beside the nominal one.
        f0 = float(self.variant)
        grid = f0 + np.arange(-0.6, 0.6001, 0.25 / setting.duration_s)
        fast = (
            residual_um - np.convolve(residual_um, np.ones(9) / 9.0, "same")
            if f0 * setting.dt_s > 0.02
            else residual_um
        )
        # Windowed, because steps and ringing leak: a line is what stays sharp.
        fast = fast * np.hanning(setting.n)
        start = np.exp(-2j * np.pi * grid[0] * setting.t_s)
        turn = np.exp(-2j * np.pi * (grid[1] - grid[0]) * setting.t_s)
        power = np.empty(grid.size)
        carrier = fast * start
        for i in range(grid.size):
            power[i] = abs(carrier.sum())
            carrier *= turn
        f = float(grid[int(np.argmax(power))])
        slots = self.slots(setting)
        rows = []
        for i in range(1, len(slots)):
            row = np.array([f, *[0.0] * (len(slots) - 1)])
            row[i] = slots[i].step
            rows.append(row)
        return [rows]

    def reading(self, y_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        if not np.any(p[1:]):
            return y_um
        out = y_um.copy()
        phase = 2.0 * np.pi * p[0] * setting.t_s
        for i, k in enumerate(self.orders(setting)):
            a, b = p[1 + 2 * i], p[2 + 2 * i]
            if a != 0.0:
                out += a * np.sin(k * phase)
            if b != 0.0:
                out += b * np.cos(k * phase)
        return out

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        one = np.zeros(p.size)
        one[0] = 1.0
        size = float(np.hypot(p[1], p[2]))
        row = np.zeros(p.size)
        row[1:3] = p[1:3] / max(size, 1e-15)
        return {"frequency_hz": (float(p[0]), one), "amplitude_um": (size, row)}


@dataclass(frozen=True)
class Timing(Form):
    """A recorder's clock that runs fast or slow against the stage's: t' = (1 + e) t."""

    name: str = "timing"
    of_one_recording: bool = True

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return 3.0 <= abs(float(p[0])) <= 1500.0

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return (Slot("clock_ppm", "ppm", 0.0, -2000.0, 2000.0, 5.0, At.READING),)

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return single([-200.0, -60.0, -15.0, 15.0, 60.0, 200.0])

    def reading(self, y_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return y_um if p[0] == 0.0 else np.asarray(resample(y_um, 1e-6 * float(p[0]), 0.0))
