"""The motion of a rehearsal: holds and ramps at random speeds with rounded corners, plus tones.

Position, velocity and acceleration are closed forms that match exactly; the acceleration is twice continuously
differentiable. The excitation that a model is identified from contains nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.errors import FieldError


class Motion(NamedTuple):
    """(n,) displacement µm, velocity µm/s, acceleration µm/s², all at the same instants."""

    y_um: FloatArray
    v_um_per_s: FloatArray
    a_um_per_s2: FloatArray


class Reference(Protocol):
    """A motion as a function of time."""

    def __call__(self, t_s: FloatArray) -> Motion:
        """The motion at the (n,) ascending times ``t_s``, s from the start of the closed loop."""
        ...


@dataclass(frozen=True, slots=True)
class ReferenceRequest:
    """What a reference must respect.

    Attributes
    ----------
    start_um : where the stage rests at first; the reference begins there, at rest. low_um, high_um : range of the
    motion after that. duration_s : its length, s. seed : of everything random.
    """

    start_um: float
    low_um: float
    high_um: float
    duration_s: float
    seed: int


#: Makes the reference of a run.
ReferenceMaker = Callable[[ReferenceRequest], Reference]

#: Range of the amplitude of all tones together, as a share of the band; the ramps stay away from its ends by as much.
TONES_SHARE = (0.02, 0.45)
#: Speeds of the ramps in spans per second, from the slowest to the fastest, which is drawn per run. Lengths of the
#: holds, s.
SLOWEST, FASTEST = 0.3, (1.5, 8.0)
HOLD_S = (0.1, 0.6)
#: Half the time over which a corner is rounded, s.
CORNER_S = (0.03, 0.12)
#: Frequencies of the tones, Hz, their number, and when they fade in, s.
TONES_HZ, TONES = (0.4, 8.0), 4
TONES_FROM_S = (0.6, 1.8)


class RandomReference:
    """Ramps and holds between random levels, with tones; its speed and the share of the tones are drawn.

    ``tones_share``: amplitude of all tones together as a share of the band, below 0.5; None: drawn. Raises FieldError
    on a band without width.
    """

    def __init__(self, wish: ReferenceRequest, tones_share: float | None = None) -> None:
        span = wish.high_um - wish.low_um
        if not (math.isfinite(span) and span > 0.0):
            raise FieldError("reference", f"{wish.low_um} to {wish.high_um} µm", "a band of finite width")
        if tones_share is not None and not 0.0 <= tones_share < 0.5:
            raise FieldError("tones_share", tones_share, "a share of the band from 0 to below 0.5")
        rng = np.random.default_rng(wish.seed)
        share = _between(rng, *TONES_SHARE) if tones_share is None else tones_share
        fastest = _between(rng, *FASTEST)
        low, high = wish.low_um + share * span, wish.high_um - share * span
        left = high - low
        # Knots of a polyline: (time, level). It begins with a rest and a slow ramp into the band.
        knots = [(-1.0, wish.start_um), (0.15, wish.start_um), (1.0, low + rng.uniform(0.2, 0.8) * left)]
        up = bool(rng.integers(2))
        while knots[-1][0] < wish.duration_s + 1.0:
            t, level = knots[-1]
            if rng.uniform() < 0.25 and knots[-2][1] != level:
                knots.append((t + rng.uniform(*HOLD_S), level))
                continue
            end = (high if up else low) + (-1.0 if up else 1.0) * left * rng.uniform(0.0, 0.55)
            up = not up
            if abs(end - level) < 0.1 * left:
                continue
            speed = left * _between(rng, SLOWEST, fastest)
            knots.append((t + max(abs(end - level) / speed, 0.1), end))
        times, levels = np.array(knots).T
        slopes = np.diff(levels) / np.diff(times)
        self._start_um = float(wish.start_um)
        self._corner_s = times[1:-1]
        self._bend = np.diff(slopes)
        # Neighbouring corners must not overlap, or the line would be cut deeper than each alone cuts it.
        shortest = np.minimum(np.diff(times)[:-1], np.diff(times)[1:])
        self._half_s = np.minimum(rng.uniform(*CORNER_S, self._bend.size), 0.5 * shortest)
        hertz = np.exp(rng.uniform(math.log(TONES_HZ[0]), math.log(TONES_HZ[1]), TONES))
        weight = rng.uniform(0.3, 1.0, TONES) / hertz ** rng.uniform(0.3, 1.0)
        self._omega = 2.0 * math.pi * hertz
        self._amplitude_um = share * span * weight / weight.sum()
        self._phase = rng.uniform(0.0, 2.0 * math.pi, TONES)

    def __call__(self, t_s: FloatArray) -> Motion:
        t = np.asarray(t_s, dtype=np.float64)
        y, v, a = np.full(t.size, self._start_um), np.zeros(t.size), np.zeros(t.size)
        for corner_s, bend, half_s in zip(self._corner_s, self._bend, self._half_s, strict=True):
            first, last = np.searchsorted(t, (corner_s - half_s, corner_s + half_s))
            # The acceleration is a pulse of area ``bend`` about the corner; velocity and position are its integrals.
            q = np.clip((t[first:last] - corner_s) / half_s, -1.0, 1.0)
            q2 = q * q
            a[first:last] += bend / half_s * (35.0 / 32.0) * (1.0 - q2) ** 3
            v[first:last] += bend * (0.5 + (35.0 / 32.0) * q * (1.0 - q2 * (1.0 - q2 * (0.6 - q2 / 7.0))))
            y[first:last] += bend * half_s * _ramp(q, q2)
            v[last:] += bend
            y[last:] += bend * (t[last:] - corner_s)
        fade = SmoothStep(*TONES_FROM_S)(t)
        angle = np.multiply.outer(t, self._omega) + self._phase
        sine, cosine = np.sin(angle), np.cos(angle)
        tones = Motion(
            sine @ self._amplitude_um,
            cosine @ (self._amplitude_um * self._omega),
            -sine @ (self._amplitude_um * self._omega**2),
        )
        added = product(fade, tones)
        return Motion(y + added.y_um, v + added.v_um_per_s, a + added.a_um_per_s2)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _ramp(q: FloatArray, q2: FloatArray) -> FloatArray:
    """Integral from -1 to q of the smooth step whose slope is the pulse (35/32)(1 - q²)³; 1 at q = 1."""
    # ∫ of 1/2 + (35/32)(q - q³ + 3/5 q⁵ - q⁷/7), minus its value at -1.
    got: FloatArray = 0.5 * q + (35.0 / 32.0) * q2 * (0.5 - q2 * (0.25 - q2 * (0.1 - q2 / 56.0)))
    at_minus_one = -0.5 + (35.0 / 32.0) * (0.5 - 0.25 + 0.1 - 1.0 / 56.0)
    return got - at_minus_one


@dataclass(frozen=True, slots=True)
class SmoothStep:
    """A smooth step from 0 to 1 between two times, s, three times continuously differentiable."""

    from_s: float
    to_s: float

    def __call__(self, t_s: FloatArray) -> Motion:
        width = self.to_s - self.from_s
        q = np.clip((t_s - self.from_s) / width, 0.0, 1.0)
        return Motion(
            q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3),
            140.0 * (q * (1.0 - q)) ** 3 / width,
            420.0 * (q * (1.0 - q)) ** 2 * (1.0 - 2.0 * q) / width**2,
        )


def product(f: Motion, g: Motion) -> Motion:
    """The product of two functions of time, with its derivatives."""
    return Motion(
        f.y_um * g.y_um,
        f.v_um_per_s * g.y_um + f.y_um * g.v_um_per_s,
        f.a_um_per_s2 * g.y_um + 2.0 * f.v_um_per_s * g.v_um_per_s + f.y_um * g.a_um_per_s2,
    )


@dataclass(frozen=True, slots=True)
class Excursion:
    """``base`` with an excursion to ``level_um`` between two times: there within ``way_s``, a stay, and back within
    ``way_s``."""

    base: Reference
    level_um: float
    from_s: float
    to_s: float
    way_s: float = 0.3

    def __call__(self, t_s: FloatArray) -> Motion:
        there = SmoothStep(self.from_s, self.from_s + self.way_s)(t_s)
        back = SmoothStep(self.to_s - self.way_s, self.to_s)(t_s)
        weight = Motion(*(one - other for one, other in zip(there, back, strict=True)))
        y, v, a = self.base(t_s)
        away = product(weight, Motion(self.level_um - y, -v, -a))
        return Motion(y + away.y_um, v + away.v_um_per_s, a + away.a_um_per_s2)


#: A motion within 0 to 1 as a function of the time since it began, s; velocities in 1/s.
Shape = Callable[[FloatArray], Motion]
#: Rest at first, end of the slow move to the place where the motion begins, and begin of the motion, s.
REST_S, THERE_S, BEGIN_S = 0.15, 0.95, 1.0


@dataclass(frozen=True, slots=True)
class Sawtooth:
    """Up at one speed and back at another one within the share ``back`` of the period; a triangle with 0.5."""

    frequency_Hz: float
    back: float = 0.5

    def __call__(self, t_s: FloatArray) -> Motion:
        phase = np.mod(self.frequency_Hz * t_s, 1.0)
        forth = 1.0 - self.back
        up = phase < forth
        y = np.where(up, phase / forth, (1.0 - phase) / self.back)
        v = self.frequency_Hz * np.where(up, 1.0 / forth, -1.0 / self.back)
        return Motion(y, v, np.zeros_like(y))


@dataclass(frozen=True, slots=True)
class Placed:
    """A shape between two places, µm, after a rest at ``start_um`` and a slow move to its begin."""

    shape: Shape
    start_um: float
    low_um: float
    span_um: float

    def __call__(self, t_s: FloatArray) -> Motion:
        t = np.asarray(t_s, dtype=np.float64)
        moves = t >= BEGIN_S
        first_um = self.low_um + self.span_um * self.shape(np.zeros(1)).y_um[0]
        shape = self.shape(np.maximum(t - BEGIN_S, 0.0))
        way = SmoothStep(REST_S, THERE_S)(t)
        way_um = first_um - self.start_um
        return Motion(
            np.where(moves, self.low_um + self.span_um * shape.y_um, self.start_um + way_um * way.y_um),
            np.where(moves, self.span_um * shape.v_um_per_s, way_um * way.v_um_per_s),
            np.where(moves, self.span_um * shape.a_um_per_s2, way_um * way.a_um_per_s2),
        )
