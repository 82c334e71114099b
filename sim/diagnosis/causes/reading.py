"""Causes in the reading: sensor_nonlinearity, mains_hum, and a clock error as timing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.compiled import compiled
from adaptive.types import FloatArray
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.stage_model import CauseModel, Guess, single_guesses


@compiled
def resample_by(x: FloatArray, shifts: FloatArray) -> FloatArray:
    """(n,) x at the instants k + shifts[k] by cubic (Catmull-Rom) interpolation, constant beyond the ends."""
    n = x.shape[0]
    out = np.empty(n)
    for k in range(n):
        whole = math.floor(shifts[k])
        f = shifts[k] - whole
        i = k + int(whole)
        a = x[min(max(i - 1, 0), n - 1)]
        b = x[min(max(i, 0), n - 1)]
        c = x[min(max(i + 1, 0), n - 1)]
        d = x[min(max(i + 2, 0), n - 1)]
        out[k] = b + 0.5 * f * (c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a)))
    return out


@compiled
def resample(x: FloatArray, stretch: float, shift: float) -> FloatArray:
    """(n,) x at the instants k (1 + stretch) + shift, see `resample_by`."""
    shifts = stretch * np.arange(x.shape[0], dtype=np.float64) + shift
    return resample_by(x, shifts.astype(np.float64))


@dataclass(frozen=True)
class SensorNonlinearity(CauseModel):
    """A static curve of the sensor: a polynomial of second to fourth order, at most 0.4 % of the range."""

    name: str = "sensor_nonlinearity"
    test_answers_to_others: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return bool(np.max(np.abs(p)) < 0.99 * 0.008)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return tuple(ModelParameter(f"order{j}", "1", 0.0, -0.008, 0.008, 5e-4, ActsOn.READING) for j in (2, 3, 4))

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        half = 0.5 * data.range_um
        x = (y_um - data.centre_um) / half
        # Near-orthogonal polynomials: the share of each order can be read on its own.
        x2 = x * x
        bend = p[0] * (x2 - 1.0) + x * (p[1] * (x2 - 1.0)) + p[2] * (x2 * x2 - x2)
        return np.asarray(y_um + half * bend)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        out = {}
        for i, name in enumerate(("quadratic", "cubic", "quartic")):
            row = np.zeros(p.size)
            row[i] = 0.5
            out[name] = (0.5 * float(p[i]), row)
        return out


@dataclass(frozen=True)
class MainsHum(CauseModel):
    """Spectral lines at 50 or 60 Hz and the first harmonics, with free phases. ``variant`` is the frequency."""

    name: str = "mains_hum"
    unseen_is_absent: bool = True
    of_one_recording: bool = True
    variant: str = "50"

    def missing(self, data: FitData) -> str:
        return "" if float(self.variant) < 0.48 / data.dt_s else "a sample rate above twice the mains frequency"

    def orders(self, data: FitData) -> list[int]:
        return [k for k in (1, 2, 3) if k * float(self.variant) < 0.48 / data.dt_s]

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        f, top = float(self.variant), 0.005 * data.range_um
        own: list[ModelParameter] = [
            ModelParameter("frequency_hz", "Hz", f, f - 0.6, f + 0.6, 0.05 / data.duration_s, ActsOn.READING)
        ]
        for k in self.orders(data):
            own += [
                ModelParameter(f"{w}{k}_um", "µm", 0.0, -top, top, 1e-3 * top, ActsOn.READING) for w in ("sin", "cos")
            ]
        return tuple(own)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        # Search the residual's spectrum around the nominal frequency in steps of a quarter of a bin.
        f0 = float(self.variant)
        grid = f0 + np.arange(-0.6, 0.6001, 0.25 / data.duration_s)
        fast = (
            residual_um - np.convolve(residual_um, np.ones(9) / 9.0, "same") if f0 * data.dt_s > 0.02 else residual_um
        )
        # The window suppresses the leakage of steps and ringing; a line stays sharp.
        fast = fast * np.hanning(data.n)
        start = np.exp(-2j * np.pi * grid[0] * data.t_s)
        turn = np.exp(-2j * np.pi * (grid[1] - grid[0]) * data.t_s)
        power = np.empty(grid.size)
        carrier = fast * start
        for i in range(grid.size):
            power[i] = abs(carrier.sum())
            carrier *= turn
        f = float(grid[int(np.argmax(power))])
        parameters = self.parameters(data)
        rows = []
        for i in range(1, len(parameters)):
            row = np.array([f, *[0.0] * (len(parameters) - 1)])
            row[i] = parameters[i].step
            rows.append(row)
        return [rows]

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if not np.any(p[1:]):
            return y_um
        out = y_um.copy()
        phase = 2.0 * np.pi * p[0] * data.t_s
        for i, k in enumerate(self.orders(data)):
            a, b = p[1 + 2 * i], p[2 + 2 * i]
            if a != 0.0:
                out += a * np.sin(k * phase)
            if b != 0.0:
                out += b * np.cos(k * phase)
        return out

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        one = np.zeros(p.size)
        one[0] = 1.0
        size = float(np.hypot(p[1], p[2]))
        row = np.zeros(p.size)
        row[1:3] = p[1:3] / max(size, 1e-15)
        return {"frequency_hz": (float(p[0]), one), "amplitude_um": (size, row)}


@dataclass(frozen=True)
class Timing(CauseModel):
    """A recorder's clock that runs fast or slow against the stage's: t' = (1 + e) t."""

    name: str = "timing"
    test_answers_to_others: bool = True
    imitates_others: bool = True
    of_one_recording: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 3.0 <= abs(float(p[0])) <= 1500.0

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("clock_ppm", "ppm", 0.0, -2000.0, 2000.0, 5.0, ActsOn.READING),)

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([-200.0, -60.0, -15.0, 15.0, 60.0, 200.0])

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        return y_um if p[0] == 0.0 else np.asarray(resample(y_um, 1e-6 * float(p[0]), 0.0))
