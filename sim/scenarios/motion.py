"""References made of parts: each follows from the one before by a blend three times continuously differentiable.

Position, velocity and acceleration belong to one another exactly, because a controller feeds all three forward.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.signals.unseen_reference import DemoReference, Reference

#: Time over which one part goes over into the next, s.
BLEND_S = 0.6


class Motion(Protocol):
    """A motion over all times."""

    def at(self, t_s: FloatArray) -> Reference:
        """Position µm, velocity µm/s, acceleration µm/s² at the times ``t_s`` (n,), s."""
        ...


@dataclass(frozen=True, slots=True)
class Tones:
    """A sum of sines about a level: ``level + sum_i amplitude_i sin(2 pi f_i t + phase_i)``; no tone is a hold."""

    level_um: float
    amplitude_um: tuple[float, ...] = ()
    frequency_Hz: tuple[float, ...] = ()
    phase_rad: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.amplitude_um) == len(self.frequency_Hz) == len(self.phase_rad):
            raise InputError(
                f"amplitude_um, frequency_Hz, phase_rad: got {len(self.amplitude_um)}, {len(self.frequency_Hz)} and "
                f"{len(self.phase_rad)} values, expected equally many"
            )

    def at(self, t_s: FloatArray) -> Reference:
        omega, amplitude = 2.0 * np.pi * np.array(self.frequency_Hz), np.array(self.amplitude_um)
        angle = np.multiply.outer(t_s, omega) + np.array(self.phase_rad)
        sine, cosine = np.sin(angle), np.cos(angle)
        return Reference(
            t_s,
            self.level_um + sine @ amplitude,
            np.asarray(cosine @ (amplitude * omega)),
            np.asarray(-sine @ (amplitude * omega**2)),
        )


def strokes(low_um: float, high_um: float, frequency_Hz: float, from_s: float = 0.0) -> Tones:
    """Full strokes between two ends, at the lower one at ``from_s``."""
    half = 0.5 * (high_um - low_um)
    phase = -0.5 * math.pi - 2.0 * math.pi * frequency_Hz * from_s
    return Tones(low_um + half, (half,), (frequency_Hz,), (phase,))


@dataclass(frozen=True, slots=True)
class Shifted:
    """A motion that begins later: ``at(t)`` is that of ``motion`` at ``t - by_s``."""

    motion: Motion
    by_s: float

    def at(self, t_s: FloatArray) -> Reference:
        r = self.motion.at(t_s - self.by_s)
        return Reference(t_s, r.y_um, r.v_um_per_s, r.a_um_per_s2)


@dataclass(frozen=True)
class Parts:
    """Motions one after the other: ``parts`` are (end time s, motion); the last end is the whole's.

    Every part must last longer than a blend, which lies half before and half after the end between two.
    """

    parts: tuple[tuple[float, Motion], ...]

    def __post_init__(self) -> None:
        ends = [0.0, *(end for end, _ in self.parts)]
        if len(ends) < 2 or any(not b - a > BLEND_S for a, b in itertools.pairwise(ends)):
            raise InputError(f"parts: got ends at {ends[1:]} s, expected ascending times more than {BLEND_S} s apart")

    def at(self, t_s: FloatArray) -> Reference:
        """The whole at the times ``t_s`` (n,), s."""
        t = np.asarray(t_s, dtype=np.float64)
        y, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        start = 0.0
        for i, (end, motion) in enumerate(self.parts):
            first, last = i == 0, i + 1 == len(self.parts)
            near = (first | (t > start - BLEND_S / 2)) & (last | (t < end + BLEND_S / 2))
            if near.any():
                tt = t[near]
                p = motion.at(tt)
                w0, w1, w2 = _weight(tt, None if first else start, None if last else end)
                y[near] += w0 * p.y_um
                v[near] += w1 * p.y_um + w0 * p.v_um_per_s
                a[near] += w2 * p.y_um + 2.0 * w1 * p.v_um_per_s + w0 * p.a_um_per_s2
            start = end
        return Reference(t, y, v, a)


def _weight(t: FloatArray, start_s: float | None, end_s: float | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weight of a part and its two derivatives: up at its start, down at its end; a part outlasts its blends."""
    w0, w1, w2 = np.ones_like(t), np.zeros_like(t), np.zeros_like(t)
    for edge, sign in ((start_s, 1.0), (end_s, -1.0)):
        if edge is None:
            continue
        q = np.clip((t - edge) / BLEND_S + 0.5, 0.0, 1.0)
        step = q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3)
        w0 = w0 * (step if sign > 0.0 else 1.0 - step)
        w1 = w1 + sign * 140.0 * q**3 * (1.0 - q) ** 3 / BLEND_S
        w2 = w2 + sign * 420.0 * q**2 * (1.0 - q) ** 2 * (1.0 - 2.0 * q) / BLEND_S**2
    return w0, w1, w2


def in_band(
    low_um: float, high_um: float, band_Hz: tuple[float, float], seed: Sequence[int], v_max_um_per_s: float
) -> Tones:
    """Five tones spread in log frequency over ``band_Hz``, within the range and never faster than ``v_max_um_per_s``.

    Amplitudes fall as 1/f, so that every tone is as fast as the others.
    """
    rng = np.random.default_rng(seed)
    edges = np.geomspace(*band_Hz, 6)
    hertz = np.exp(rng.uniform(np.log(edges[:-1]), np.log(edges[1:])))
    raw = rng.uniform(0.5, 1.0, 5) / hertz
    half = 0.5 * (high_um - low_um)
    amplitude = raw / raw.sum() * half
    speed = float(np.sum(2.0 * np.pi * hertz * amplitude))
    amplitude *= min(1.0, v_max_um_per_s / speed)
    spare = half - float(amplitude.sum())
    level = low_um + half + rng.uniform(-0.7, 0.7) * spare
    phase = rng.uniform(0.0, 2.0 * np.pi, 5)
    return Tones(float(level), *(tuple(float(x) for x in values) for values in (amplitude, hertz, phase)))


def demo_motion(duration_s: float, low_um: float, high_um: float, seed: int) -> DemoReference:
    """The demo's reference as a motion; it begins with a hold at the lower end."""
    return DemoReference(duration_s, low_um, high_um, seed)
