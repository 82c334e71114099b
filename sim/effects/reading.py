"""The sensor, from its noise to the time base of its readings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.counter_noise import normal, uniform
from sim.effects.holds import first_order

# --- sensor_noise ---
# White noise of the sensor, before the lag of its electronics.


@block
def run_sensor_noise(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: standard deviation µm, seed."""
    if p[0] > 0.0:
        for k in range(n):
            x[k] += p[0] * normal(p[1], k0 + k)


SENSOR_NOISE = Kind(
    name="sensor_noise",
    place=Place.NOISE,
    parameters=(Parameter("rms_um", "µm", 0.0, 10.0, 0.005, "standard deviation before any lag of the electronics"),),
    derive=lambda values, context: (values["rms_um"], float(context.seed)),
    block=run_sensor_noise,
    signature="white, the same at rest and in motion",
    source="about 5 nm rms at full bandwidth for a 100 µm capacitive sensor",
    cause=False,
)


# --- sensor_lag ---
# First-order low-pass of the sensor electronics; it attenuates signal and noise.


@block
def run_sensor_lag(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: (a, b0, b1). s: output, input so far, µm; whether it has begun."""
    for k in range(n):
        now = x[k]
        if s[2] == 0.0:  # start settled
            s[0], s[1], s[2] = now, now, 1.0
        s[0] = p[0] * s[0] + p[1] * s[1] + p[2] * now
        s[1] = now
        x[k] = s[0]


def derive_sensor_lag(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the displacement is linear between samples
    return first_order(values["tau_s"], context.dt_s, 0.0)


SENSOR_LAG = Kind(
    name="sensor_lag",
    place=Place.SENSOR_LAG,
    parameters=(Parameter("tau_s", "s", 0.0, 0.01, 3e-4, "time constant"),),
    derive=derive_sensor_lag,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run_sensor_lag,
    signature="gain AND noise roll off",
    mistaken_for=("amplifier_lag", "delay"),
    tells_apart="a monitor of the voltage; the spectrum of the noise at rest",
    source="0.3 ms at a bandwidth setting of 1 kHz (sensor electronics data sheet)",
)


# --- delay ---
# A pure delay between the motion and its reading.

LONGEST_S = 0.005


def _delay_slots(context: Context) -> int:
    return math.ceil(LONGEST_S / context.dt_s) + 2


@block
def run_delay(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slots, whole samples, fraction. s: newest slot (-1: not begun), then a ring of past values, µm."""
    slots, whole = int(p[0]), int(p[1])
    for k in range(n):
        if s[0] < 0.0:  # start at rest
            for j in range(slots):
                s[1 + j] = x[k]
        newest = (int(s[0]) + 1) % slots
        s[0] = newest
        s[1 + newest] = x[k]
        late = s[1 + (newest - whole + slots) % slots]
        later = s[1 + (newest - whole - 1 + 2 * slots) % slots]
        x[k] = late + p[2] * (later - late)


def derive_delay(values: Mapping[str, float], context: Context) -> Sequence[float]:
    samples = values["delay_s"] / context.dt_s
    whole = math.floor(samples)
    return float(_delay_slots(context)), float(whole), samples - whole


DELAY = Kind(
    name="delay",
    place=Place.DELAY,
    parameters=(
        Parameter("delay_s", "s", 0.0, LONGEST_S, 5e-4, "delay; between samples the motion is a straight line"),
    ),
    derive=derive_delay,
    rest=lambda values, context: [-1.0] + [0.0] * _delay_slots(context),
    block=run_delay,
    signature="phase in proportion to the frequency at gain 1",
    mistaken_for=("amplifier_lag", "sensor_lag", "hysteresis_shape"),
    tells_apart="a lag also loses gain; the loop of a hysteresis persists as the frequency goes to zero",
    source="0.1 to 2 ms of converters and buses (common knowledge of the field)",
)


# --- sensor_nonlinearity ---
# Nonlinearity of the sensor: a single-valued polynomial of the displacement, zero at both ends of the range.


@block
def run_sensor_nonlinearity(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: 1/range, square, cubic term in µm."""
    for k in range(n):
        q = x[k] * p[0]
        # q (1-q) has its extremum 1/4 at the middle; q (1-q)(1-2q) has sqrt(3)/18 at q = 0.21 and 0.79
        bow = q * (1.0 - q)
        x[k] += 4.0 * p[1] * bow + 10.392304845413264 * p[2] * bow * (1.0 - 2.0 * q)


def derive_sensor_nonlinearity(values: Mapping[str, float], context: Context) -> Sequence[float]:
    full = values["range_um"]
    return 1.0 / full, values["square"] * full, values["cubic"] * full


SENSOR_NONLINEARITY = Kind(
    name="sensor_nonlinearity",
    place=Place.SENSOR_CURVE,
    parameters=(
        Parameter("square", "1", -0.02, 0.02, 0.0006, "largest error of the square term, relative to the range"),
        Parameter("cubic", "1", -0.02, 0.02, 0.0, "largest error of the cubic term, relative to the range"),
        Parameter("range_um", "µm", 0.1, 1e4, 100.0, "range of the sensor"),
    ),
    derive=derive_sensor_nonlinearity,
    block=run_sensor_nonlinearity,
    signature="the same error at the same displacement, at all rates and in both directions",
    mistaken_for=("asymmetry",),
    tells_apart="the curve of the actuator needs a second sensor to be told apart",
    source="0.03 to 0.1 % of the range (capacitive sensor data sheets)",
)


# --- mains_hum ---
# Mains hum: lines at the mains frequency and its third harmonic, independent of the input.


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
)


# --- quantisation ---
# A/D converter: readings on a grid.


@block
def run_quantisation(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: step µm (0: none)."""
    if p[0] > 0.0:
        for k in range(n):
            x[k] = p[0] * round(x[k] / p[0])


QUANTISATION = Kind(
    name="quantisation",
    place=Place.ADC,
    parameters=(Parameter("step_um", "µm", 0.0, 10.0, 100.0 / 65536, "step of the grid; 0: none"),),
    derive=lambda values, context: (values["step_um"],),
    block=run_quantisation,
    signature="few distinct levels, dead patches at low rate",
    mistaken_for=("stick_slip",),
    tells_apart="the levels lie on one grid everywhere",
    source="16 bit over 100 µm: 1.5 nm",
)


# --- timing ---
# Faults of the time base: readings that repeat the one before, and a sensor clock that runs slow.

#: Largest lateness of a slow clock, s; it stays there.
LATEST_S = 0.05


def _clock_slots(context: Context) -> int:
    return math.ceil(LATEST_S / context.dt_s) + 2


@block
def run_timing(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: probability of a repeat, lateness per sample, slots, seed. s: last reading, slot (-1: not begun), ring."""
    slots = int(p[2])
    for k in range(n):
        index = k0 + k
        if s[1] < 0.0:
            s[0] = x[k]
            for j in range(slots):
                s[2 + j] = x[k]
        newest = (int(s[1]) + 1) % slots
        s[1] = newest
        s[2 + newest] = x[k]
        late = min(p[1] * index, slots - 2.0)
        whole = int(late)
        first = s[2 + (newest - whole + slots) % slots]
        second = s[2 + (newest - whole - 1 + 2 * slots) % slots]
        reading = first + (late - whole) * (second - first)
        if p[0] > 0.0 and uniform(p[3], index) < p[0]:
            reading = s[0]
        s[0] = reading
        x[k] = reading


def derive_timing(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["repeat_probability"], values["slow_ppm"] * 1e-6, float(_clock_slots(context)), float(context.seed)


TIMING = Kind(
    name="timing",
    place=Place.TIMING,
    parameters=(
        Parameter("repeat_probability", "1", 0.0, 0.5, 0.001, "share of readings that repeat the one before"),
        Parameter("slow_ppm", "ppm", 0.0, 1000.0, 0.0, "how slow the sensor's clock is"),
    ),
    derive=derive_timing,
    rest=lambda values, context: [0.0, -1.0] + [0.0] * _clock_slots(context),
    block=run_timing,
    signature="gaps, zero differences; a phase that grows with time",
    mistaken_for=("delay",),
    tells_apart="a delay is constant",
    source="10 to 100 ppm between two crystals (common knowledge of the field)",
)
