"""Motions that users make and the service's own references do not: rasters, staircases, tones, noise, spirals, rests.

Each is a closed form, drawn from the seed of a `ReferenceRequest`. It rests at ``start_um``, moves slowly to where the
motion begins, and goes on from there at ``BEGIN_S``. Velocity and acceleration are what a controller supplies: the
exact derivatives, and at a corner those after it (a triangle has v = ± its slope and a = 0). Nothing of ``adaptive``,
``baselines``, ``sim`` or ``service`` is used.

>>> maker = motion("raster:10")  # a triangle of 10 Hz; "raster" draws the frequency
>>> reference = maker(ReferenceRequest(start_um=0.0, low_um=5.0, high_um=95.0, duration_s=12.0, seed=1))

Shapes (`Sawtooth`, `Rounded`, ...) have no unit of length: they lie within 0 to 1 and are functions of the time since
the motion began, s; their velocities are in 1/s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dehyst.lab.rehearsal.reference import (
    BEGIN_S,
    Motion,
    Placed,
    Reference,
    ReferenceRequest,
    Sawtooth,
    Shape,
    SmoothStep,
    product,
)

FloatArray = NDArray[np.float64]
#: When a hold may begin at the earliest, and when the stand of a night begins, s.
HOLD_FROM_S, NIGHT_FROM_S = 4.0, 0.1
#: Tones of the band-limited noise, and their lowest frequency as a share of the highest.
NOISE_TONES, NOISE_FROM = 40, 0.02
#: Time over which the noise fades in, s.
FADE_S = 0.3


# ---- shapes


@dataclass(frozen=True, slots=True)
class Rounded:
    """A triangle of which each turn is a parabola over the share ``turn`` (0 to 0.5) of the period."""

    frequency_Hz: float
    turn: float

    def __call__(self, t_s: FloatArray) -> Motion:
        phase = np.mod(self.frequency_Hz * t_s, 1.0)
        # Upper half: the lower one upside down. ``p``: phase after the turn, -1/4 to 1/4.
        lower = np.abs(phase - 0.5) >= 0.25
        p = np.where(lower, np.mod(phase + 0.5, 1.0) - 0.5, phase - 0.5)
        half = 0.5 * self.turn
        bent = np.abs(p) < half
        slope = 1.0 / (0.5 - half)
        y = slope * (np.where(bent, (p * p + half * half) / (2.0 * half), np.abs(p)) - 0.5 * half)
        v = slope * self.frequency_Hz * np.where(bent, p / half, np.sign(p))
        a = slope * self.frequency_Hz**2 * np.where(bent, 1.0 / half, 0.0)
        sign = np.where(lower, 1.0, -1.0)
        return Motion(np.where(lower, y, 1.0 - y), sign * v, sign * a)


@dataclass(frozen=True, slots=True)
class Levels:
    """(n + 1,) levels; a smooth step to the next one begins at each of the (n,) times, s, and takes ``way_s``."""

    at_s: FloatArray
    levels: FloatArray
    way_s: float

    def __call__(self, t_s: FloatArray) -> Motion:
        k = np.searchsorted(self.at_s, t_s, side="right")
        before = self.levels[np.maximum(k - 1, 0)]
        rise = self.levels[k] - before
        since_s = np.where(k > 0, t_s - self.at_s[np.maximum(k - 1, 0)], 0.0)
        step = SmoothStep(0.0, self.way_s)(since_s)
        return Motion(before + rise * step.y_um, rise * step.v_um_per_s, rise * step.a_um_per_s2)


@dataclass(frozen=True, slots=True)
class Tones:
    """0.5 + ``size`` of the sum of tones (angular frequencies rad/s, phases rad), times a smooth fade-in over
    ``fade_s``."""

    omega: FloatArray
    phase: FloatArray
    size: float
    fade_s: float

    def __call__(self, t_s: FloatArray) -> Motion:
        y, v, a = np.zeros((3, t_s.size))
        for omega, phase in zip(self.omega.tolist(), self.phase.tolist(), strict=True):
            sine, cosine = np.sin(omega * t_s + phase), np.cos(omega * t_s + phase)
            y, v, a = y + sine, v + omega * cosine, a - omega**2 * sine
        added = Motion(self.size * y, self.size * v, self.size * a)
        if self.fade_s > 0.0:
            added = product(SmoothStep(0.0, self.fade_s)(t_s), added)
        return Motion(0.5 + added.y_um, added.v_um_per_s, added.a_um_per_s2)


@dataclass(frozen=True, slots=True)
class Spiral:
    """One axis of a spiral: a sine whose amplitude grows evenly from 0 within ``out_s`` and shrinks as evenly."""

    frequency_Hz: float
    out_s: float

    def __call__(self, t_s: FloatArray) -> Motion:
        omega = 2.0 * math.pi * self.frequency_Hz
        sine, cosine = np.sin(omega * t_s), np.cos(omega * t_s)
        radius = Sawtooth(0.5 / self.out_s)(t_s)
        y, v, a = product(radius, Motion(0.5 * sine, 0.5 * omega * cosine, -0.5 * omega**2 * sine))
        return Motion(0.5 + y, v, a)


# ---- references


@dataclass(frozen=True, slots=True)
class Paused:
    """``base`` up to a time, s; then at rest there for ``still_s``; then on."""

    base: Reference
    at_s: float
    still_s: float

    def __call__(self, t_s: FloatArray) -> Motion:
        t = np.asarray(t_s, dtype=np.float64)
        still = (t >= self.at_s) & (t < self.at_s + self.still_s)
        y, v, a = self.base(t - np.clip(t - self.at_s, 0.0, self.still_s))
        return Motion(y, np.where(still, 0.0, v), np.where(still, 0.0, a))


# ---- what is drawn

#: Makes a shape of a frequency, Hz, for a duration, s.
Drawn = Callable[[np.random.Generator, float, float], Shape]


@dataclass(frozen=True, slots=True)
class MotionMaker:
    """Makes motions of one kind; a `ReferenceMaker`.

    Attributes
    ----------
    draw : makes the shape. between_Hz : frequencies that are drawn; what they are the frequency of, `MOTIONS` says.
    share : smallest range of the motion as a share of the band. frequency_Hz : None: drawn.
    rests : "hold" for one at a turn, "night" for one at the start, "" for none. still_s : how long, s.
    """

    draw: Drawn
    between_Hz: tuple[float, float]
    share: float = 0.3
    rests: str = ""
    frequency_Hz: float | None = None
    still_s: float = 0.0

    def at(self, frequency_Hz: float) -> MotionMaker:
        """The same with this frequency, Hz."""
        return replace(self, frequency_Hz=frequency_Hz)

    def drawn_Hz(self, seed: int) -> float:
        """The frequency of the motion with this seed, Hz."""
        if self.frequency_Hz is not None:
            return self.frequency_Hz
        low, high = np.log(self.between_Hz)
        return float(np.exp(np.random.default_rng([seed, 30]).uniform(low, high)))

    def begin_s(self, seed: int) -> float:
        """When the motion begins, or goes on after a rest, s."""
        if self.rests == "hold":
            return self._hold_at_s(seed) + self.still_s
        return BEGIN_S + self.still_s

    def _hold_at_s(self, seed: int) -> float:
        """The first turn at the lower end after ``HOLD_FROM_S``, s."""
        frequency_Hz = self.drawn_Hz(seed)
        return BEGIN_S + math.ceil((HOLD_FROM_S - BEGIN_S) * frequency_Hz) / frequency_Hz

    def __call__(self, wish: ReferenceRequest) -> Reference:
        rng = np.random.default_rng([wish.seed, 31])
        band_um = wish.high_um - wish.low_um
        share = float(rng.uniform(self.share, 1.0))
        low_um = wish.low_um + float(rng.uniform(0.0, 1.0 - share)) * band_um
        shape = self.draw(rng, self.drawn_Hz(wish.seed), wish.duration_s)
        placed = Placed(shape, wish.start_um, low_um, share * band_um)
        if not self.rests:
            return placed
        return Paused(placed, self._hold_at_s(wish.seed) if self.rests == "hold" else NIGHT_FROM_S, self.still_s)


def _triangle(_: np.random.Generator, frequency_Hz: float, __: float) -> Shape:
    return Sawtooth(frequency_Hz)


def _sawtooth(rng: np.random.Generator, frequency_Hz: float, _: float) -> Shape:
    return Sawtooth(frequency_Hz, float(rng.uniform(0.1, 0.3)))


def _rounded(rng: np.random.Generator, frequency_Hz: float, _: float) -> Shape:
    return Rounded(frequency_Hz, float(rng.uniform(0.05, 0.3)))


def _lines(rng: np.random.Generator, frequency_Hz: float) -> int:
    """Lines of a frame that takes 2 to 10 s, at least two."""
    return max(2, round(frequency_Hz * float(rng.uniform(2.0, 10.0))))


def _slow_ramp(rng: np.random.Generator, frequency_Hz: float, _: float) -> Shape:
    return Sawtooth(0.5 * frequency_Hz / _lines(rng, frequency_Hz))


def _stairs(frequency_Hz: float, levels: int, way_s: float, duration_s: float) -> Shape:
    """Up and down over so many levels, each for a period."""
    steps = math.ceil(duration_s * frequency_Hz)
    turn = levels - 1
    level = turn - np.abs(np.mod(np.arange(steps + 1), 2 * turn) - turn)
    return Levels(np.arange(1, steps + 1) / frequency_Hz, level / turn, way_s)


def _slow_stairs(rng: np.random.Generator, frequency_Hz: float, duration_s: float) -> Shape:
    way_s = float(rng.uniform(0.1, 0.3)) / frequency_Hz
    return _stairs(frequency_Hz, _lines(rng, frequency_Hz) + 1, way_s, duration_s)


def _staircase(rng: np.random.Generator, frequency_Hz: float, duration_s: float) -> Shape:
    way_s = min(float(rng.uniform(0.005, 0.02)), 0.5 / frequency_Hz)
    return _stairs(frequency_Hz, int(rng.integers(4, 21)), way_s, duration_s)


def _binary(rng: np.random.Generator, frequency_Hz: float, duration_s: float) -> Shape:
    steps = math.ceil(duration_s * frequency_Hz)
    way_s = min(float(rng.uniform(0.002, 0.01)), 0.5 / frequency_Hz)
    return Levels(np.arange(1, steps + 1) / frequency_Hz, rng.integers(0, 2, steps + 1).astype(np.float64), way_s)


def _tone(_: np.random.Generator, frequency_Hz: float, __: float) -> Shape:
    # It begins at its lower turn.
    return Tones(np.array([2.0 * math.pi * frequency_Hz]), np.array([-0.5 * math.pi]), 0.5, 0.0)


def _noise(rng: np.random.Generator, frequency_Hz: float, duration_s: float) -> Shape:
    omega = 2.0 * math.pi * frequency_Hz * rng.uniform(NOISE_FROM, 1.0, NOISE_TONES)
    phase = rng.uniform(0.0, 2.0 * math.pi, NOISE_TONES)
    # Between points of this grid a tone grows by 1.3 % of its size at most.
    grid_s = np.arange(0.0, duration_s + 0.1, 0.05 / frequency_Hz)
    largest = float(np.abs(Tones(omega, phase, 1.0, 0.0)(grid_s).y_um - 0.5).max())
    return Tones(omega, phase, 0.5 / (1.05 * largest), FADE_S)


def _spiral(rng: np.random.Generator, frequency_Hz: float, _: float) -> Shape:
    return Spiral(frequency_Hz, float(rng.uniform(1.0, 5.0)))


#: The motions by name, and what their frequency is: of the lines of rasters and the slow axes beside them, of the steps
#: or bits, of the tone, of the revolutions; of the noise the highest.
MOTIONS: Final[dict[str, MotionMaker]] = {
    "raster": MotionMaker(_triangle, (1.0, 50.0)),
    "rounded": MotionMaker(_rounded, (1.0, 50.0)),
    "sawtooth": MotionMaker(_sawtooth, (1.0, 50.0)),
    "slow_ramp": MotionMaker(_slow_ramp, (1.0, 50.0)),
    "slow_stairs": MotionMaker(_slow_stairs, (1.0, 50.0)),
    "staircase": MotionMaker(_staircase, (2.0, 20.0)),
    "tone": MotionMaker(_tone, (1.0, 100.0), share=1.0 / 9.0),
    "noise": MotionMaker(_noise, (5.0, 100.0)),
    "binary": MotionMaker(_binary, (5.0, 100.0)),
    "spiral": MotionMaker(_spiral, (1.0, 50.0)),
    "hold": MotionMaker(_rounded, (1.0, 5.0), rests="hold"),
    "night": MotionMaker(_rounded, (1.0, 5.0), rests="night"),
}


def motion(name: str) -> MotionMaker:
    """The maker of a name of `MOTIONS`, or of ``name:frequency`` with the frequency in Hz.

    Raises KeyError on an unknown name, ValueError on a frequency that is no number above 0.
    """
    kind, _, frequency = name.partition(":")
    maker = MOTIONS[kind]
    if not frequency:
        return maker
    if not 0.0 < float(frequency) < math.inf:
        raise ValueError(f"{name}: expected a frequency above 0 Hz")
    return maker.at(float(frequency))
