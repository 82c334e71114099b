"""Reference motions: position, velocity and acceleration that belong to one another exactly.

A controller feeds all three forward. References are composed of parts; one part passes into the next by a blend that
is three times continuously differentiable. `DemoReference` draws its parts from a seed: several tones between 0.5 and
20 Hz, changing amplitudes, minor loops and holds, which no model has seen in its identification.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.signals.voltages import sample_times

#: Duration of the blend from one part to the next, s.
BLEND_S = 0.6


@dataclass(frozen=True, slots=True)
class Reference:
    """Position, velocity and acceleration (n,) in µm, µm/s, µm/s² at the times ``t_s``, s."""

    t_s: FloatArray
    y_um: FloatArray
    v_um_per_s: FloatArray
    a_um_per_s2: FloatArray


class Motion(Protocol):
    """A reference that is defined at all times."""

    def at(self, t_s: FloatArray) -> Reference:
        """The reference at the times ``t_s`` (n,), s."""
        ...


def blend_step(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Polynomial step of order 7 from 0 to 1 over q in [0, 1], and its first two derivatives by q; (n,) each."""
    s0 = q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3)
    s1 = 140.0 * q**3 * (1.0 - q) ** 3
    s2 = 420.0 * q**2 * (1.0 - q) ** 2 * (1.0 - 2.0 * q)
    return s0, s1, s2


def _weight(t: FloatArray, start_s: float | None, end_s: float | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weight of a part and its two derivatives: rises at the start, falls at the end; None: no blend there."""
    w0, w1, w2 = np.ones_like(t), np.zeros_like(t), np.zeros_like(t)
    for edge, sign in ((start_s, 1.0), (end_s, -1.0)):
        if edge is None:
            continue
        s0, s1, s2 = blend_step(np.clip((t - edge) / BLEND_S + 0.5, 0.0, 1.0))
        # The two edges of a part never overlap, because it is longer than a blend.
        w0 = w0 * (s0 if sign > 0.0 else 1.0 - s0)
        w1 = w1 + sign * s1 / BLEND_S
        w2 = w2 + sign * s2 / BLEND_S**2
    return w0, w1, w2


def blended(t_s: FloatArray, parts: Sequence[tuple[float, Motion]]) -> Reference:
    """The parts, (end time s, motion) in order, blended into one reference at the times ``t_s`` (n,), s.

    The weights of two neighbours add up to 1 except for round-off.
    """
    t = np.asarray(t_s, dtype=np.float64)
    y, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    start = 0.0
    for i, (end, motion) in enumerate(parts):
        first, last = i == 0, i + 1 == len(parts)
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


@dataclass(frozen=True, slots=True)
class Tones:
    """A sum of sines about a level: ``level + sum_i amplitude_i sin(2 pi f_i t + phase_i)``; without tones, a hold.

    Raises InputError unless amplitudes, frequencies and phases are equally many.
    """

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
        """The reference at the times ``t_s`` (n,), s."""
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
    """A sine between two ends, at the lower one at the time ``from_s``."""
    half = 0.5 * (high_um - low_um)
    phase = -0.5 * math.pi - 2.0 * math.pi * frequency_Hz * from_s
    return Tones(low_um + half, (half,), (frequency_Hz,), (phase,))


@dataclass(frozen=True, slots=True)
class Shifted:
    """``motion``, later by ``by_s``, s."""

    motion: Motion
    by_s: float

    def at(self, t_s: FloatArray) -> Reference:
        """The reference at the times ``t_s`` (n,), s."""
        r = self.motion.at(t_s - self.by_s)
        return Reference(t_s, r.y_um, r.v_um_per_s, r.a_um_per_s2)


@dataclass(frozen=True)
class Sequenced:
    """Motions one after the other: ``parts`` are (end time s, motion).

    Raises InputError unless every part is longer than a blend.
    """

    parts: tuple[tuple[float, Motion], ...]

    def __post_init__(self) -> None:
        ends = [0.0, *(end for end, _ in self.parts)]
        if len(ends) < 2 or any(not b - a > BLEND_S for a, b in itertools.pairwise(ends)):
            raise InputError(f"parts: got ends at {ends[1:]} s, expected ascending times more than {BLEND_S} s apart")

    def at(self, t_s: FloatArray) -> Reference:
        """The reference at the times ``t_s`` (n,), s."""
        return blended(t_s, self.parts)


def in_band(
    low_um: float, high_um: float, band_Hz: tuple[float, float], seed: Sequence[int], v_max_um_per_s: float
) -> Tones:
    """Five tones, spread in log frequency over ``band_Hz``, within the range and never above ``v_max_um_per_s``.

    Amplitudes fall as 1/f, so all tones have the same speed.
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


@dataclass(frozen=True, slots=True)
class _DemoPart:
    """A level plus tones, whose amplitude beats with ``beat_omega`` (rad/s) by the share ``beat_share``."""

    kind: str
    start_s: float
    end_s: float
    level_um: float
    amplitude_um: FloatArray
    omega: FloatArray
    phase: FloatArray
    beat_omega: float
    beat_share: float

    def at(self, t_s: FloatArray) -> Reference:
        """The reference at the times ``t_s`` (n,), s."""
        angle = np.multiply.outer(t_s, self.omega) + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        s0 = sine @ self.amplitude_um
        s1 = cosine @ (self.amplitude_um * self.omega)
        s2 = -sine @ (self.amplitude_um * self.omega**2)
        b = self.beat_omega
        e0 = 1.0 - self.beat_share * 0.5 * (1.0 + np.cos(b * t_s))
        e1 = 0.5 * self.beat_share * b * np.sin(b * t_s)
        e2 = 0.5 * self.beat_share * b * b * np.cos(b * t_s)
        return Reference(t_s, self.level_um + e0 * s0, e1 * s0 + e0 * s1, e2 * s0 + 2.0 * e1 * s1 + e0 * s2)


@dataclass(frozen=True)
class DemoReference:
    """A reference drawn from a seed; ``at`` gives the same values whatever times are asked for together.

    Attributes
    ----------
    duration_s : its duration, s. It begins with a hold of about a second at the lower end.
    low_um, high_um : its range, which it never leaves, µm.
    seed : determines levels, tones and lengths.

    Raises InputError on an impossible duration or range.
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
    def parts(self) -> tuple[_DemoPart, ...]:
        """All parts in order; each extends by half a blend beyond its ends."""
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

    def _part(self, kind: str, start: float, end: float, rng: np.random.Generator) -> _DemoPart:
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
            elif kind == "loops":  # a slow sine plus a faster one that turns back: minor loops
                slow, fast = rng.uniform(0.3, 0.6), rng.uniform(3.0, 6.0)
                inner = rng.uniform(0.15, 0.3)
                hertz, amplitude = [slow, fast], [size * (1.0 - inner), size * inner]
            else:  # one sine of changing amplitude
                hertz, amplitude = [rng.uniform(0.8, 3.0)], [size]
                beat, share = rng.uniform(0.2, 0.4), rng.uniform(0.3, 0.7)
        return _DemoPart(
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
        r = blended(t_s, [(part.end_s, part) for part in self.parts])
        return Reference(r.t_s, np.clip(r.y_um, self.low_um, self.high_um), r.v_um_per_s, r.a_um_per_s2)


def demo_reference(
    duration_s: float, dt_s: float = 1e-3, range_um: tuple[float, float] = (5.0, 80.0), seed: int = 0
) -> Reference:
    """A `DemoReference` sampled every ``dt_s`` s. Raises InputError on impossible times and ranges."""
    return DemoReference(duration_s, range_um[0], range_um[1], seed).at(sample_times(duration_s, dt_s))
