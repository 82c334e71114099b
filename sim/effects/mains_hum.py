"""Mains hum: lines at the mains frequency and its third harmonic, independent of the input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_mains_hum(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: amplitude, of the third harmonic, cycles per sample, phase in cycles."""
    for k in range(n):
        # whole cycles are subtracted before the sine, so that a run of months keeps its phase
        cycles = p[2] * (k0 + k)
        angle = 2.0 * math.pi * (cycles - math.floor(cycles) + p[3])
        x[k] += p[0] * math.sin(angle) + p[1] * math.sin(3.0 * angle)


def derive_mains_hum(values: Mapping[str, float], context: Context) -> Sequence[float]:
    amplitude = values["amplitude_um"]
    return amplitude, amplitude * values["third_share"], values["frequency_Hz"] * context.dt_s, values["phase_cycles"]


# Its form in a diagnosis.


@dataclass(frozen=True)
class MainsHum(CauseModel):
    """Spectral lines at 50 or 60 Hz and the first harmonics, with free phases. ``variant`` is the frequency."""

    unseen_is_absent: bool = True
    of_one_recording: bool = True
    variant: str = "50"

    def missing(self, data: FitData) -> str:
        return "" if float(self.variant) < 0.48 / data.dt_s else "a sample rate above twice the mains frequency"

    def line_hz(self, p: FloatArray) -> float | None:
        return float(p[0])

    def orders(self, data: FitData) -> list[int]:
        return [k for k in (1, 2, 3) if k * float(self.variant) < 0.48 / data.dt_s]

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        f, top = float(self.variant), 0.05 * data.range_um
        own: list[ModelParameter] = [
            ModelParameter("frequency_hz", "Hz", f, f - 0.6, f + 0.6, 0.05 / data.duration_s, ActsOn.READING)
        ]
        for k in self.orders(data):
            own += [
                ModelParameter(f"{w}{k}_um", "µm", 0.0, -top, top, 1e-4 * top, ActsOn.READING) for w in ("sin", "cos")
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


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    third = float(np.hypot(*p[-2:]) / max(v["amplitude_um"], 1e-12)) if p.size >= 7 else 0.0
    hum = MAINS_HUM.clipped(
        amplitude_um=v["amplitude_um"],
        frequency_Hz=v["frequency_hz"],
        phase_cycles=float(np.arctan2(p[2], p[1]) / (2.0 * np.pi)),
        third_share=third,
    )
    return InLibrary((hum,))


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """A line at 50 or 60 Hz in the rests, with one phase over all of them, above its neighbours in frequency."""
    data = readings.data
    where = np.concatenate([np.arange(r.first, r.last) for r in readings.rests]) if readings.rests else np.empty(0, int)
    if where.size * data.dt_s < 1.0 or data.dt_s > 1.0 / 130.0:
        return Sight(None, "less than a second of rests, or fewer than 130 samples a second")
    width = max(3, round(0.04 / data.dt_s))
    pieces = []
    for r in readings.rests:
        y = data.y_um[r.first : r.last]
        padded = np.pad(y, width, mode="edge")
        pieces.append(y - np.convolve(padded, np.ones(width) / width, "same")[width:-width])
    y = np.concatenate(pieces)
    t = data.t_s[where]
    best: tuple[float, float, float] | None = None
    for mains in (50.0, 60.0):
        grid = mains + np.arange(-0.6, 0.6001, max(0.25 / data.duration_s, 0.004))
        size = np.array([_line(y, t, f) for f in grid])
        i = int(np.argmax(size))
        beside = float(np.median([_line(y, t, float(grid[i]) + d) for d in (-4.3, -3.1, -2.2, 2.2, 3.1, 4.3)]))
        if best is None or size[i] / max(beside, 1e-300) > best[1] / max(best[2], 1e-300):
            best = (float(grid[i]), float(size[i]), beside)
    assert best is not None
    f, size_um, beside = best
    error = float(np.std(y)) * float(np.sqrt(2.0 / y.size))
    words = f"at rest a line at {f:.2f} Hz of {1e3 * size_um:.2g} nm; beside it {1e3 * beside:.1g} nm"
    return Sight(bool(size_um > max(5.5 * error, 3.0 * beside, 0.05 * readings.sigma_um)), words)


def _line(y: FloatArray, t: FloatArray, f_hz: float) -> float:
    """Amplitude of a line by correlation."""
    z = 2.0 * np.pi * f_hz * t
    return 2.0 / y.size * float(np.hypot(y @ np.cos(z), y @ np.sin(z)))


MAINS_HUM = Kind(
    name="mains_hum",
    place=Place.HUM,
    parameters=(
        Parameter("amplitude_um", "µm", 0.0, 1.0, 0.01, "amplitude of the line"),
        Parameter("frequency_Hz", "Hz", 45.0, 65.0, 50.0, "50 or 60 Hz"),
        Parameter("third_share", "1", 0.0, 1.0, 0.2, "amplitude at three times the frequency, relative"),
        Parameter("phase_cycles", "1", -1.0, 1.0, 0.0, "phase at the first sample, in cycles"),
    ),
    derive=derive_mains_hum,
    block=run_mains_hum,
    signature="narrow lines, also at zero input",
    mistaken_for=("resonance",),
    tells_apart="change the sample rate to tell it from an alias",
    source="0.5 to 10 nm (common knowledge of the field)",
    cause=Cause(
        sign="a line at 50 or 60 Hz in the rests, above its neighbours",
        forms=(MainsHum(variant="50"), MainsHum(variant="60")),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.residual_spectrum,
    ),
)
