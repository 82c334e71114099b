"""Voltage signals: those of the chapter, triangles, sines and multi-tones.

All return ``(t_s, u_V)``, (n,) arrays with times ``k dt_s``; voltages are at the scale of the command.
"""

from __future__ import annotations

import math

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

# --- Sample times, computed from the count of samples and never summed.


def sample_times(duration_s: float, dt_s: float) -> FloatArray:
    """``k dt_s`` (n,) s for all samples before ``duration_s``. Raises InputError unless both are above 0 and finite."""
    if not (math.isfinite(dt_s) and dt_s > 0.0):
        raise InputError(f"dt_s: got {dt_s!r}, expected a sample time above 0 s")
    if not (math.isfinite(duration_s) and duration_s >= dt_s):
        raise InputError(f"duration_s: got {duration_s!r}, expected at least one sample time, {dt_s} s")
    return np.arange(round(duration_s / dt_s), dtype=np.float64) * dt_s


#: Amplitude A of (2.37) and (2.45). The chapter prints 5, which peaks at 9.8 V. Its tables and ranges (thresholds
#: (2.38) up to 7.2434 V = 12/13 of 7.847 V, 89.306 µm) belong to a peak of 7.85 V, an amplitude of 4.
CHAPTER_AMPLITUDE_V = 4.0


def training_input(
    dt_s: float = 0.02, duration_s: float = 10.0, amplitude_V: float = CHAPTER_AMPLITUDE_V
) -> tuple[FloatArray, FloatArray]:
    """(2.37): ``u = A e^(-0.11 t) [sin(6 pi t e^(-0.345 t) - 1.55) + 1]``; 500 samples at 0.02 s by default.

    See `CHAPTER_AMPLITUDE_V` for the default of A.
    """
    t = sample_times(duration_s, dt_s)
    wave = np.sin(6.0 * np.pi * t * np.exp(-0.345 * t) - 1.55) + 1.0
    return t, amplitude_V * np.exp(-0.11 * t) * wave


def generalisation_input(
    dt_s: float = 0.02, duration_s: float = 10.0, amplitude_V: float = CHAPTER_AMPLITUDE_V
) -> tuple[FloatArray, FloatArray]:
    """(2.45): ``u = A e^(-0.14 t) [cos(3 pi t e^(-0.092 t) - 3.15) + 1]``; 500 samples at 0.02 s by default."""
    t = sample_times(duration_s, dt_s)
    wave = np.cos(3.0 * np.pi * t * np.exp(-0.092 * t) - 3.15) + 1.0
    return t, amplitude_V * np.exp(-0.14 * t) * wave


def growing_triangles(
    dt_s: float = 1e-3, amplitudes_V: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0), rate_V_per_s: float = 6.0
) -> tuple[FloatArray, FloatArray]:
    """Triangles from 0 V of growing amplitude at a constant rate, as in Fig. 2.2. Raises InputError on bad values."""
    if not amplitudes_V or min(amplitudes_V) <= 0.0 or rate_V_per_s <= 0.0:
        raise InputError(f"amplitudes_V, rate_V_per_s: got {amplitudes_V}, {rate_V_per_s}, expected positive numbers")
    return _straight([0.0, *(corner for amplitude in amplitudes_V for corner in (amplitude, 0.0))], rate_V_per_s, dt_s)


def _straight(corners_V: list[float], rate_V_per_s: float, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Straight from corner to corner at one rate."""
    corners_s = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(corners_V)) / rate_V_per_s)))
    t = sample_times(float(corners_s[-1]), dt_s)
    return t, np.interp(t, corners_s, corners_V)


def triangle(
    low_V: float, high_V: float, frequency_Hz: float, cycles: float, dt_s: float = 1e-3
) -> tuple[FloatArray, FloatArray]:
    """A triangle wave from ``low_V`` up to ``high_V`` and back, ``cycles`` times."""
    t = sample_times(cycles / frequency_Hz, dt_s)
    phase = np.mod(t * frequency_Hz, 1.0)
    return t, low_V + (high_V - low_V) * (1.0 - np.abs(1.0 - 2.0 * phase))


def sine(
    low_V: float, high_V: float, frequency_Hz: float, cycles: float, dt_s: float = 1e-3
) -> tuple[FloatArray, FloatArray]:
    """A sine from ``low_V`` up to ``high_V`` and back, ``cycles`` times (Fig. 2.3)."""
    t = sample_times(cycles / frequency_Hz, dt_s)
    return t, low_V + (high_V - low_V) * 0.5 * (1.0 - np.cos(2.0 * np.pi * frequency_Hz * t))


def minor_loops(loops: int = 4, dt_s: float = 1e-3) -> tuple[FloatArray, FloatArray]:
    """A large loop from 0 V, between 1 and 7 V, with ``loops`` minor loops of 1.5 V on each branch, at 6 V/s."""
    low_V, high_V, inner_V = 1.0, 7.0, 1.5
    levels = np.linspace(low_V, high_V, loops + 2)[1:-1].tolist()
    up = [corner for level in levels for corner in (level, level - inner_V)]
    down = [corner for level in levels[::-1] for corner in (level, level + inner_V)]
    return _straight([0.0, low_V, *up, high_V, *down, low_V, 0.0], 6.0, dt_s)


def multitone(
    duration_s: float, dt_s: float = 1e-3, low_V: float = 0.5, high_V: float = 7.5, seed: int = 0, tones: int = 6
) -> tuple[FloatArray, FloatArray]:
    """A sum of sines between 0.5 and 20 Hz with amplitudes falling as 1/f, within the given voltages."""
    rng = np.random.default_rng(seed)
    t = sample_times(duration_s, dt_s)
    frequency = np.exp(rng.uniform(math.log(0.5), math.log(20.0), tones))
    phase = rng.uniform(0.0, 2.0 * np.pi, tones)
    weight = 1.0 / frequency
    weight /= weight.sum()
    wave = np.sin(2.0 * np.pi * frequency * t[:, None] + phase) @ weight
    return t, 0.5 * (low_V + high_V) + 0.5 * (high_V - low_V) * wave
