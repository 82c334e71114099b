"""A reference that no model has seen: several tones between 0.5 and 20 Hz, changing amplitude, minor loops, holds.

Parts of some seconds each follow one another; every part is a sum of sines about a level, and neighbours are blended by
a polynomial that is three times continuously differentiable, so that position, velocity and acceleration belong to one
another exactly and the reference stays within its range (a blend of two values never leaves them).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.stage.timebase import times

#: Time over which one part goes over into the next, s.
BLEND_S = 0.6


@dataclass(frozen=True, slots=True)
class Reference:
    """Position, velocity and acceleration (n,) in µm, µm/s, µm/s² at the times ``t_s``."""

    t_s: FloatArray
    y_um: FloatArray
    v_um_per_s: FloatArray
    a_um_per_s2: FloatArray


@dataclass(frozen=True, slots=True)
class _Part:
    """A level plus tones; ``beat_Hz`` and ``beat_share`` let the amplitude swell."""

    kind: str
    start_s: float
    end_s: float
    level_um: float
    amplitude_um: FloatArray
    omega: FloatArray
    phase: FloatArray
    beat_omega: float
    beat_share: float

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position and its two derivatives."""
        angle = np.multiply.outer(t, self.omega) + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        s0 = sine @ self.amplitude_um
        s1 = cosine @ (self.amplitude_um * self.omega)
        s2 = -sine @ (self.amplitude_um * self.omega**2)
        b = self.beat_omega
        e0 = 1.0 - self.beat_share * 0.5 * (1.0 + np.cos(b * t))
        e1 = 0.5 * self.beat_share * b * np.sin(b * t)
        e2 = 0.5 * self.beat_share * b * b * np.cos(b * t)
        return self.level_um + e0 * s0, e1 * s0 + e0 * s1, e2 * s0 + 2.0 * e1 * s1 + e0 * s2


def _blend(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Seventh-order step from 0 to 1 over q in [0, 1] and its two derivatives."""
    s0 = q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3)
    s1 = 140.0 * q**3 * (1.0 - q) ** 3
    s2 = 420.0 * q**2 * (1.0 - q) ** 2 * (1.0 - 2.0 * q)
    return s0, s1, s2


@dataclass(frozen=True)
class DemoReference:
    """The plan of the reference; ``at`` gives any stretch of it, the same values whatever the stretch.

    Attributes
    ----------
    duration_s : how long it goes on, s. It begins with a hold at the lower end, where the stage rests.
    low_um, high_um : never left.
    seed : chooses levels, tones and lengths.
    """

    duration_s: float
    low_um: float
    high_um: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration_s) and self.duration_s > 0.0):
            raise InputError(f"duration_s: got {self.duration_s!r}, expected seconds above 0")
        if not (math.isfinite(self.low_um) and math.isfinite(self.high_um) and self.low_um < self.high_um):
            raise InputError(f"range_um: got ({self.low_um!r}, {self.high_um!r}), expected finite µm, the first lower")

    @cached_property
    def parts(self) -> tuple[_Part, ...]:
        """All parts in order; each reaches half a blend beyond its ends."""
        rng = np.random.default_rng(self.seed)
        parts = [self._part("start", 0.0, 1.0, rng)]
        order = ("tones", "loops", "tones", "hold", "sine", "tones", "loops", "hold")
        index = 0
        while parts[-1].end_s < self.duration_s:
            kind = order[index % len(order)]
            length = rng.uniform(1.2, 2.0) if kind == "hold" else rng.uniform(2.5, 4.5)
            parts.append(self._part(kind, parts[-1].end_s, parts[-1].end_s + length, rng))
            index += 1
        return tuple(parts)

    def _part(self, kind: str, start: float, end: float, rng: np.random.Generator) -> _Part:
        half = 0.5 * (self.high_um - self.low_um)
        middle = self.low_um + half
        beat, share = 0.0, 0.0
        if kind == "start":
            level, amplitude, hertz = self.low_um, [0.0], [1.0]
        elif kind == "hold":
            level, amplitude, hertz = middle + half * rng.uniform(-0.8, 0.8), [0.0], [1.0]
        else:
            size = half * rng.uniform(0.45, 1.0)
            level = middle + (half - size) * rng.uniform(-1.0, 1.0)
            if kind == "tones":  # one tone in each of five bands from 0.5 to 20 Hz, falling as 1/f
                edges = 0.5 * 40.0 ** (np.arange(6) / 5.0)
                hertz = list(np.exp(rng.uniform(np.log(edges[:-1]), np.log(edges[1:]))))
                raw = rng.uniform(0.5, 1.0, 5) / np.array(hertz)
                amplitude = list(size * raw / raw.sum())
                beat, share = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.6)
            elif kind == "loops":  # a slow sweep with a faster one upon it that turns back: minor loops
                slow, fast = rng.uniform(0.3, 0.6), rng.uniform(3.0, 6.0)
                inner = rng.uniform(0.15, 0.3)
                hertz, amplitude = [slow, fast], [size * (1.0 - inner), size * inner]
            else:  # one sine that swells
                hertz, amplitude = [rng.uniform(0.8, 3.0)], [size]
                beat, share = rng.uniform(0.2, 0.4), rng.uniform(0.3, 0.7)
        return _Part(
            kind=kind,
            start_s=start,
            end_s=end,
            level_um=float(level),
            amplitude_um=np.array(amplitude),
            omega=2.0 * np.pi * np.array(hertz),
            phase=rng.uniform(0.0, 2.0 * np.pi, len(hertz)),
            beat_omega=2.0 * np.pi * float(beat),
            beat_share=float(share),
        )

    def at(self, t_s: FloatArray) -> Reference:
        """The reference at the times ``t_s`` (n,), s."""
        t = np.asarray(t_s, dtype=np.float64)
        y, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        for i, part in enumerate(self.parts):
            last = i + 1 == len(self.parts)
            near = (t > part.start_s - BLEND_S / 2 if i else t > -np.inf) & (
                t < part.end_s + BLEND_S / 2 if not last else t < np.inf
            )
            if not near.any():
                continue
            tt = t[near]
            p0, p1, p2 = part.at(tt)
            w0, w1, w2 = np.ones_like(tt), np.zeros_like(tt), np.zeros_like(tt)
            for edge, sign, real in ((part.start_s, 1.0, i > 0), (part.end_s, -1.0, not last)):
                if real:
                    q = np.clip((tt - edge) / BLEND_S + 0.5, 0.0, 1.0)
                    s0, s1, s2 = _blend(q)
                    # the two edges of a part never overlap: its length exceeds the blend
                    if sign < 0.0:
                        s0 = 1.0 - s0
                    w0 = w0 * s0
                    w1 += sign * s1 / BLEND_S
                    w2 += sign * s2 / BLEND_S**2
            y[near] += w0 * p0
            v[near] += w1 * p0 + w0 * p1
            a[near] += w2 * p0 + 2.0 * w1 * p1 + w0 * p2
        # the weights of two neighbours add up to one but for round-off
        return Reference(t, np.clip(y, self.low_um, self.high_um), v, a)


def demo_reference(
    duration_s: float, dt_s: float = 1e-3, range_um: tuple[float, float] = (5.0, 80.0), seed: int = 0
) -> Reference:
    """The demo's reference, sampled: position, velocity and acceleration that belong to one another exactly.

    Stays within ``range_um`` (µm), begins with a hold of about a second at its lower end. Raises InputError on
    impossible times and ranges.
    """
    return DemoReference(duration_s, range_um[0], range_um[1], seed).at(times(duration_s, dt_s))
