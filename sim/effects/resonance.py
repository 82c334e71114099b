"""A lightly damped mode of the stage's mechanics, with the mass of a payload; in a diagnosis also several at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import (
    Cause,
    Context,
    Effect,
    FoundInReadings,
    InReadings,
    Kind,
    Parameter,
    Place,
    same_numbers,
)
from dehyst.sim.effects.holds import second_order
from dehyst.sim.effects.mechanics import run_mode
from dehyst.sim.fitting.dynamics import Dynamics
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.modes import Modes
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


def derive_resonance(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # a payload adds mass; spring and dashpot, and so the DC gain, stay
    mass = (1.0 + values["payload_ratio"]) * (1.0 + context.payload_ratio)
    omega = 2.0 * math.pi * values["frequency_Hz"] / math.sqrt(mass)
    return second_order(omega, values["damping_ratio"] / math.sqrt(mass), context.dt_s, context.hold_per_s)


# Its form in a diagnosis.


def _or_a_payload(data: FitData) -> tuple[str, ...]:
    """A nominal stage with a loop has no mode: this may be the stage's own, or a known one that a payload has moved."""
    return () if data.nominal_kind == "linear" else ("payload_change",)


@dataclass(frozen=True)
class Resonance(CauseModel):
    """A second-order mode of unit gain after the hysteresis that the nominal stage lacks."""

    unseen_is_absent: bool = True
    fast: bool = True
    #: Frequency at which the readings ring; 0 where they do not.
    peak_hz: float = 0.0

    def also(self, data: FitData) -> tuple[str, ...]:
        return _or_a_payload(data)

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        # At the top of what the sampling shows it stands for what is faster still.
        top = self.parameters(data)[0]
        return bool(np.exp(p[1]) < 0.4 and p[0] < top.high - 0.5 * top.step)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        top = 0.47 / data.dt_s
        return (
            ModelParameter(
                "log_f0",
                "1",
                float(np.log(300.0 * top)),
                float(np.log(0.01 * top)),
                float(np.log(top)),
                0.02,
                ActsOn.DYNAMICS,
            ),
            ModelParameter(
                "log_damping", "1", float(np.log(0.02)), float(np.log(1e-3)), float(np.log(0.5)), 0.3, ActsOn.DYNAMICS
            ),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        spectrum = np.abs(np.fft.rfft(np.diff(residual_um)))
        f = np.fft.rfftfreq(data.n - 1, data.dt_s)
        # Bins of about 2 Hz: a mode of 1 % damping at 200 Hz is that wide.
        width = max(1, round(2.0 * data.duration_s))
        power = np.convolve(spectrum**2, np.ones(width) / width, "same")
        parameters = self.parameters(data)
        inside = (f > np.exp(parameters[0].low)) & (f < np.exp(parameters[0].high))
        for line in (50.0, 60.0, 100.0, 120.0, 150.0, 180.0):
            inside &= np.abs(f - line) > 1.5 + 1.5 / data.duration_s
        if not np.any(inside):
            return []
        peak = float(f[inside][np.argmax(power[inside])])
        near = (0.97, 0.985, 0.995, 1.0, 1.005, 1.015, 1.03)
        guesses = {f_hz * r for r in near for f_hz in (peak, self.peak_hz or peak)}
        guesses |= {
            v for v in (150.0, 250.0, 350.0, 450.0, 600.0) if np.exp(parameters[0].low) < v < np.exp(parameters[0].high)
        }
        return [[np.array([np.log(g), np.log(z)])] for g in sorted(guesses) for z in (0.01, 0.04)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        mode = (float(np.exp(p[0])), float(np.exp(p[1])))
        return replace(system, modes_hz=(*system.modes_hz, mode))

    def shown(self, readings: Readings) -> CauseModel:
        return replace(self, peak_hz=readings.once(_ringing_hz))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        f, z = float(np.exp(p[0])), float(np.exp(p[1]))
        return {"f0_hz": (f, np.array([f, 0.0])), "damping": (z, np.array([0.0, z]))}


@dataclass(frozen=True)
class StructureModes(Modes):
    """Resonances of a structure, driven by the actuator's displacement."""

    unseen_is_absent: bool = True
    fast: bool = True

    def also(self, data: FitData) -> tuple[str, ...]:
        return _or_a_payload(data)


# Its signature in the readings.

#: Power of a band in that of its neighbours from which on a mode rings there.
_RINGS = 10.0


def seen(readings: Readings) -> Sight:
    """A peak in the response above the trend about it, with the phase turn of a mode."""
    response = readings.response
    fs = 1.0 / readings.data.dt_s
    if response is None or response.f_hz.size < 24 or response.f_hz[-1] < 6.0 * response.f_hz[0]:
        return Sight(None, "the voltage has too little power above 5 Hz for a frequency response")
    f, size = response.f_hz, np.log(np.abs(response.gain))
    phase = np.unwrap(np.angle(response.gain))
    best: tuple[float, float, float] | None = None
    for i in range(2, f.size - 2):
        near = (f > 0.85 * f[i]) & (f < 1.18 * f[i])
        about = (f > 0.5 * f[i]) & (f < 2.0 * f[i]) & ~near
        below, above = about & (f < f[i]), about & (f > f[i])
        if int(below.sum()) < 4 or int(near.sum()) < 3 or size[i] < np.max(size[near]):
            continue
        # A mode carries the motion below it and lets it fall above it: compare with the part below alone.
        trend = np.polynomial.polynomial.polyfit(np.log(f[below]), size[below], 1)
        rise = float(size[i] - (trend[0] + trend[1] * np.log(f[i])))
        spread = float(np.std(size[below] - (trend[0] + trend[1] * np.log(f[below]))))
        high = np.flatnonzero(near)
        turn = float(phase[high[0]] - phase[high[-1]])
        noise = float(np.hypot(spread, response.sigma[i]))
        score = rise / max(noise, 1e-6)
        lively = rise > 0.3 and score > 5.0 and (turn > 0.8 or not above.any())
        if lively and (best is None or rise > best[1]):
            best = (float(f[i]), rise, turn)
    if best is not None:
        words = (
            f"a peak at {best[0]:.4g} Hz, {np.exp(best[1]):.2g} times the trend, phase turn {np.degrees(best[2]):.0f}°"
        )
        return Sight(True, words)
    if f[-1] < 0.3 * fs:
        return Sight(None, f"the response is known up to {f[-1]:.3g} Hz only, and has no peak there")
    return Sight(False, f"no peak in the response from {f[0]:.2g} to {f[-1]:.3g} Hz")


def ringing_peak(left_um: FloatArray, described_um: FloatArray, mask: BoolArray, dt_s: float) -> tuple[float, float]:
    """Frequency (Hz) of the largest peak above its neighbours in the spectrum of ``left_um`` (n,), and its share of the
    power. Zeros where there is none.

    A mode raises all of a band of 4 %, hum and the harmonics of a drive only lines in it: medians are compared, without
    the band's three largest lines. A peak that the described motion ``described_um`` (n,) has as well, or that does not
    go on in each quarter of the record, is the drive's.
    """
    n, f = left_um.size, np.fft.rfftfreq(left_um.size, dt_s)
    left, described = (np.where(mask, x - x.mean(), 0.0) for x in (left_um, described_um))
    powers = [np.square(np.abs(np.fft.rfft(x * np.hanning(n)))) for x in (left, described)]
    best, at_hz = _RINGS, 0.0
    for f_hz in np.geomspace(125.0, 0.47 * n, 400) / (n * dt_s) if n > 300 else ():
        off = np.abs(f / f_hz - 1.0)
        inside, beside = off < 0.02, (off > 0.06) & (off < 0.3)
        ratio, driven = (float(np.median(np.sort(p[inside])[:-3]) / max(np.median(p[beside]), 1e-300)) for p in powers)
        if ratio > best * max(driven, 1.0):
            best, at_hz = ratio / max(driven, 1.0), float(f_hz)
    band = np.abs(f / max(at_hz, 1e-9) - 1.0) < 0.06
    # Faded, since the ends of the record are steps.
    faded = left * np.minimum(1.0, 10.0 * np.minimum(np.arange(n), np.arange(n)[::-1]) / n)
    quarters = [float(q @ q) for q in np.array_split(np.fft.irfft(np.fft.rfft(faded) * band, n), 4)]
    if min(quarters) < 0.05 * sum(quarters) or not at_hz:
        return 0.0, 0.0
    return at_hz, float(powers[0][band].sum() / powers[0].sum())


def _ringing_hz(readings: Readings) -> float:
    if readings.data.has_mode:
        # It is the stage's own.
        return 0.0
    return ringing_peak(readings.left_um, readings.memory_um, readings.mask, readings.data.dt_s)[0]


def find_ringing(data: FitData, residual_um: FloatArray, mask: BoolArray, sigma_um: float) -> FoundInReadings | None:
    """A mode that makes a fifth of what is left: disturbances excite it, not the voltage."""
    f_hz, share = ringing_peak(residual_um, data.y_um - residual_um, mask, data.dt_s)
    if data.has_mode or share <= 0.2:
        return None
    words = f"what is left of the readings rings at {f_hz:.4g} Hz"
    return FoundInReadings({"f0_hz": f_hz}, {"f0_hz": (0.96 * f_hz, 1.04 * f_hz)}, share, words)


def ringing_in_library(parameters: dict[str, float]) -> tuple[tuple[Effect, ...], float]:
    return (RESONANCE.clipped(frequency_Hz=parameters["f0_hz"]),), 0.0


def rings(readings: Readings) -> Sight:
    """A peak in the spectrum of what plays of the voltage leave of the readings."""
    peak_hz = readings.once(_ringing_hz)
    if not peak_hz:
        return Sight(None, "no peak in the spectrum of what the loop leaves")
    return Sight(True, f"what the loop leaves rings at {peak_hz:.4g} Hz")


RESONANCE = Kind(
    name="resonance",
    place=Place.MECHANICS,
    parameters=(
        Parameter("frequency_Hz", "Hz", 5.0, 1e5, 400.0, "undamped frequency without payload"),
        Parameter("damping_ratio", "1", 0.001, 100.0, 0.03, "damping ratio without payload"),
        Parameter("payload_ratio", "1", 0.0, 20.0, 0.0, "mass of the payload relative to the moved mass"),
    ),
    derive=derive_resonance,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run_mode,
    signature="ringing after steps; a peak and -180° in the response",
    mistaken_for=("mains_hum", "payload_change"),
    tells_apart="hum is a fixed line that is there without excitation",
    source="300 to 500 Hz, damping 0.01 to 0.05 for a 100 µm flexure stage (common knowledge of the field)",
    cause=Cause(
        sign="a peak in the frequency response, with the phase turn of a mode; or in the spectrum of what the loop "
        "leaves",
        forms=(Resonance(), StructureModes()),
        tests=(seen, rings),
        # Of parallel modes the strongest becomes one in series.
        in_library=same_numbers("resonance", frequency_Hz="f0_hz", damping_ratio="damping"),
        picture=pictures.frequency_response,
        in_readings=InReadings(find_ringing, ringing_in_library),
    ),
)
