"""A correction for motion that repeats: the voltage of one pass and its residual give that of the next.

Of a pass the voltage w and the residual r (wanted less read) are known. The next pass gets, with the period P, the
model's slope s = dV/dy and lag, and a low-pass Q without phase::

    w(t) = Q [w(t - P) + GAIN s r(t - P + lag)]

What is added to the model's answer is w less that answer. So the learner goes on beside it and does not move the stage
while the motion repeats, and what is above the cut-off of Q, where a stage rings, leaves the voltage. `designs` gives
the highest cut-off at which the residual falls from pass to pass at every frequency (Longman, Iterative learning
control and repetitive control for engineering practice, Int. J. Control 73, 2000).
"""

from __future__ import annotations

import functools
import math
from typing import Final, NamedTuple

import numpy as np

from dehyst.adaptive.correction.integral import LEAST_DAMPING
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

#: Share of the residual that a pass corrects.
GAIN: Final = 0.7
#: Largest factor of the residual from pass to pass, at every frequency, that a design may have.
GROWTH: Final = 0.95
#: What a design bears: the model's slope is off by this share, its lag by this share and half a sample.
SLOPE_ERROR: Final = 0.3
LAG_ERROR: Final = 0.25
#: Half length of the low-pass as a multiple of 1 / cut-off, and the shape of its Kaiser window: 70 dB, because what the
#: low-pass is off by at the frequency of the motion is an error of the whole motion.
_HALF: Final = 3.0
_KAISER: Final = 7.0
#: Cut-offs that are tried, as shares of the lowest mode and of the sample rate.
_OF_MODE: Final = 0.9
_OF_RATE: Final = 0.35
_STEP: Final = 0.95
_LEAST: Final = 0.1
_FREQUENCIES: Final = 400


class Design(NamedTuple):
    """Low-pass with ``cutoff`` (half amplitude), and the longest lag of the model with which the residual falls.

    ``cutoff`` : in cycles per sample; 0: nothing is corrected. ``half`` : half length of the low-pass, samples.
    """

    cutoff: float
    half: int
    most_lag_s: float


_NONE: Final = Design(0.0, 0, math.inf)


def kernel(delay: float, cutoff: float, half: int) -> tuple[int, FloatArray]:
    """(delay of the first weight in samples, (2 half + 1,) weights) of a low-pass without phase about ``delay``.

    ``delay`` : samples, whole or not. The weights sum to 1.
    """
    first = round(delay) - half
    x = np.arange(first, first + 2 * half + 1) - delay
    shape = np.i0(_KAISER * np.sqrt(np.maximum(0.0, 1.0 - (x / (half + 0.5)) ** 2)))
    weights = np.sinc(2.0 * cutoff * x) * shape
    return first, weights / weights.sum()


def most_lag_s(cutoff: float, half: int, mode_Hz: float, dt_s: float) -> float:
    """The longest lag, s, with which a pass leaves at most `GROWTH` of the residual at every frequency; below 0: none.

    The factor is ``|Q| |1 - GAIN G|``, its largest over all stages that a design bears: slope and lag off, and a mode
    of `LEAST_DAMPING` or more at ``mode_Hz`` or anywhere above it. Up to ``mode_Hz`` the mode lifts the response by
    1 / (1 - (f / mode)²) at most; from there on it may be 1 / (2 damping) at any phase. As the factor grows with the
    phase, the phase that it allows gives the lag.
    """
    # Close enough about the mode, however slow it is beside the samples.
    f = np.concatenate([np.linspace(0.0, top, _FREQUENCIES) for top in (min(2.0 * mode_Hz * dt_s, 0.5), 0.5)])
    # The sum of w[k] cos(2 pi f k) by rows of n weights: k = n i + j.
    n = math.isqrt(half) + 1
    rows = np.zeros((n, n))
    rows.flat[: half + 1] = kernel(0.0, cutoff, half)[1][half:]
    rows.flat[1 : half + 1] *= 2.0
    turn = np.exp(2j * np.pi * np.outer(f, np.arange(n)))
    low_pass = ((turn @ rows.T) * np.exp(2j * np.pi * n * np.outer(f, np.arange(n)))).sum(axis=1).real
    allowed = GROWTH / np.abs(low_pass)
    share, peak = f / (mode_Hz * dt_s), 0.5 / LEAST_DAMPING
    below, most = share < 1.0, GAIN * (1.0 + SLOPE_ERROR)
    lift = np.minimum(1.0 / np.maximum(1.0 - share[below] ** 2, 1.0 / peak), peak)
    gains = np.stack([np.full(lift.size, GAIN * (1.0 - SLOPE_ERROR)), most * lift])
    # |1 - gain e^(i phase)| <= allowed
    cos = (1.0 + gains**2 - allowed[below] ** 2) / (2.0 * gains)
    if (cos > 1.0).any() or (allowed[~below] < 1.0 + most * peak).any():
        return -1.0
    bounded = (cos > -1.0) & (f[below] > 0.0)
    phase, at = np.arccos(cos[bounded]), np.broadcast_to(f[below], cos.shape)[bounded]
    return float(((phase / (2.0 * np.pi * at) - 0.5) * dt_s / LAG_ERROR).min(initial=math.inf))


#: Samples that are kept: the longest period is half of them. The longest that is found is half of `SEARCHED`.
KEPT: Final = 8192
SEARCHED: Final = 4096


@functools.lru_cache(maxsize=16)
def designs(mode_Hz: float, dt_s: float) -> tuple[Design, ...]:
    """All designs of a stage, highest cut-off first, each for longer lags than the one before.

    mode_Hz : lowest frequency at which the stage may ring, Hz. dt_s : sample time, s.
    """
    found: list[Design] = []
    cutoff, longest_s = min(_OF_MODE * mode_Hz * dt_s, _OF_RATE), 0.0
    least = _LEAST * cutoff
    # A longer low-pass does not fit into what is kept.
    while cutoff > least and longest_s < math.inf and 2 * (half := math.ceil(_HALF / cutoff)) + 1 < KEPT:
        lag_s = most_lag_s(cutoff, half, mode_Hz, dt_s)
        if lag_s >= longest_s:
            longest_s = lag_s
            found.append(Design(cutoff, half, lag_s))
        cutoff *= _STEP
    return tuple(found)


#: Shortest period, samples, and the ratio of the windows that are tried.
_SHORTEST: Final = 16
_WINDOWS: Final = math.sqrt(2.0)
#: Shifts at which the motion nearly repeats that are looked at closely, of each window.
_VALLEYS: Final = 8
#: Two passes are the same motion where they differ by less than this share of its range, and what lies between their
#: samples: half of the two ways of a sample.
SAME: Final = 0.005


def find_period(y_um: FloatArray) -> float | None:
    """The period, samples, with which the last of the (n,) positions repeat; None where they do not.

    The shortest one of at most half their number. Two passes are compared in full (de Cheveigné and Kawahara, YIN, J.
    Acoust. Soc. Am. 111, 2002); the part of a sample follows by Newton's method.
    """
    window = float(_SHORTEST)
    while (w := math.ceil(window)) <= y_um.size // 2:
        window *= _WINDOWS
        late, both = y_um[-w:], y_um[-2 * w :]
        late, both = late - late.mean(), both - late.mean()
        power = float(late @ late)
        if not power > 0.0:
            continue
        size = 1 << (3 * w).bit_length()
        cross = np.fft.irfft(np.fft.rfft(both, size) * np.conj(np.fft.rfft(late, size)), size)[: w + 1]
        squares = np.concatenate([[0.0], np.cumsum(both**2)])
        # At shift L the window is compared with the one that begins L samples before it.
        apart = (power + squares[w:] - squares[: w + 1] - 2.0 * cross)[::-1] / (2.0 * power)
        far = np.flatnonzero(apart > 0.1)
        close = np.flatnonzero(apart[far[0] :] < 0.02) + far[0] if far.size else far
        for valley in np.split(close, np.flatnonzero(np.diff(close) > 1) + 1)[: _VALLEYS if close.size else 0]:
            period = _refined(y_um, float(valley[np.argmin(apart[valley])]), w)
            if period is not None:
                return period
    return None


def _refined(y_um: FloatArray, period: float, w: int) -> float | None:
    """``period`` to the part of a sample, from the last ``w`` positions; None where they are not the same motion."""
    t = np.arange(y_um.size, dtype=np.float64)
    now, v = y_um[-w:], np.gradient(y_um)
    for _ in range(4):
        at = t[-w:] - period
        # The mean of both passes' velocities: at a corner neither alone is right.
        mean = 0.5 * (v[-w:] + np.interp(at, t, v))
        period -= float(mean @ (now - np.interp(at, t, y_um)) / max(mean @ mean, 1e-300))
        if not _SHORTEST <= period <= min(w + 1, y_um.size - w):
            return None
    way = np.abs(np.diff(y_um, prepend=y_um[0]))
    at = t[-w:] - period
    off = np.abs(now - np.interp(at, t, y_um)) - 0.5 * (way[-w:] + way[np.floor(at).astype(np.int64) + 1])
    return period if off.max() <= SAME * np.ptp(now) else None


#: Residual of a pass, as a multiple of the smallest so far, from which on what was learnt is wrong.
_GROWN: Final = 3.0
#: A single residual counts by so many times their root mean square at most.
_SPIKE: Final = 4.0
#: Passes without growth after which a halved gain doubles again.
_QUIET: Final = 20
#: Samples between two looks for a period: as a share of those that are looked at, and at least.
_LOOK, _LOOK_SAMPLES = 0.05, 32


class Repetition:
    """What is added to the model's answers while the motion repeats; `add` and `applied` once for each point.

    Parameters
    ----------
    dt_s : sample time, s. mode_Hz : lowest frequency at which the stage rings, Hz. fade_s : time without good readings
    after which the correction is let go, s.

    Attributes
    ----------
    u_V : the correction of the last point, V. period : in samples, stated or found; None: none yet.
    active : whether the last point was corrected by the pass before. factor : share of `GAIN` in use. halved : times
    that growth halved it. doubted : readings that were not used. design : in use.

    Raises InputError on numbers that are not above 0.
    """

    def __init__(self, dt_s: float, mode_Hz: float, fade_s: float) -> None:
        for name, value in (("dt_s", dt_s), ("mode_Hz", mode_Hz), ("fade_s", fade_s)):
            if not 0.0 < value < math.inf:
                raise InputError(f"{name}: got {value}, expected a finite number above 0")
        self._dt_s, self._fade = dt_s, math.ceil(fade_s / dt_s)
        self.u_V, self.factor = 0.0, 1.0
        self.halved = self.doubted = 0
        self.period: float | None = None
        self.active = False
        self._designs, self.design = designs(mode_Hz, dt_s), _NONE
        self._stated = False
        self._slope, self._lag_s, self._bound_V = 0.0, math.nan, 0.0
        self._age = -1
        # By sample: wanted, µm; voltage, residual, low-passed residual, V; squares that `_judge` sums. Twice what
        # is kept, to be one piece.
        self._columns = np.zeros((5, 2 * KEPT))
        self._y, self._w, self._r, self._low, self._square = self._columns
        self._base, self._next = 0, 0
        self._restart(0)

    def _restart(self, number: int) -> None:
        """Begin anew at sample ``number``: nothing before it is used."""
        self._since, self._next, self._base = number, number, number
        self._forget()

    def _forget(self) -> None:
        """Let go what was learnt; what the stage does from now on is learnt anew."""
        self.active = False
        if not self._stated:
            self.period = None
        self._same_since = self._since = self._next
        self._look_at = self._next + 2 * _SHORTEST
        self._span = 0.0
        self._weight, self._fade_V = 0.0, abs(self.u_V)
        self._missing = 0
        self._power = self._least = math.nan
        self._quiet = 0

    def state(self, period_s: float | None) -> None:
        """The motion from the next point on repeats with ``period_s``, s; None: find it.

        Raises InputError on a period that is too short or too long.
        """
        if period_s is not None and not _SHORTEST <= period_s / self._dt_s <= KEPT / 2:
            raise InputError(
                f"period_s: got {period_s:g}, expected {_SHORTEST * self._dt_s:g} to {KEPT / 2 * self._dt_s:g} s"
            )
        self._stated, self.period = period_s is not None, None if period_s is None else period_s / self._dt_s
        self._forget()
        self._plan()

    def set(self, age: int, slope_V_per_um: float, lag_s: float, bound_V: float) -> None:
        """What the next readings are used by; as for `Correction.set`. Another low-pass where the lag has changed."""
        self._slope, self._bound_V = slope_V_per_um, bound_V
        # The lag of the model follows its last samples; what moves the low-pass by less than that is no other design.
        if not abs(lag_s - self._lag_s) <= 0.25 * self._dt_s + 0.1 * self._lag_s:
            self._lag_s = lag_s
            self.design = next((one for one in self._designs if lag_s <= one.most_lag_s), _NONE)
            self._age = -1
        if age != self._age:
            self._age = age
            self._plan()

    def _plan(self) -> None:
        """Kernels of voltage and residual for the period: of as many passes back as their last readings need."""
        self._passes = 0
        cutoff, half, _ = self.design
        if self.period is None or not cutoff or self._age < 0:
            return
        lead = self._lag_s / self._dt_s
        self._passes = math.ceil((half + 1.0 + lead + self._age) / self.period)
        self._delay = self._passes * self.period
        self._at_w, of_w = kernel(self._delay, cutoff, half)
        self._at_r, of_r = kernel(self._delay - lead, cutoff, half)
        self._of_w, self._of_r = of_w[::-1].copy(), of_r[::-1].copy()
        if self._at_w + 2 * half + 1 > KEPT:
            self._passes = 0

    def read(self, number: int, residual_um: float) -> None:
        """Take the residual, wanted less read, µm, of a sample; one not finite, or beyond the bound, is doubted.

        Nothing is learnt where the low-pass would use a doubted one; one that never came counts as 0.
        """
        i = number - self._base
        if not (number >= self._since and number < self._next and i >= 0):
            return
        r_V = self._slope * residual_um
        doubted = not (abs(r_V) <= self._bound_V and self._slope)
        self.doubted += doubted
        self._missing = self._missing + 1 if doubted else 0
        self._r[i] = math.nan if doubted else r_V
        if math.isfinite(r_V):
            if self.active:
                self._judge(i, r_V * r_V)
            else:
                self._square[i] = r_V * r_V

    def _judge(self, i: int, square: float) -> None:
        """Let go, with half the gain, once the residual of the last pass is `_GROWN` times the smallest of a pass."""
        assert self.period is not None
        n = round(self.period)
        if i < n:
            return  # a late reading from before the first pass that is kept
        if math.isnan(self._power):
            self._power = self._least = float(self._square[i - n : i].sum())
        self._square[i] = min(square, _SPIKE**2 * self._power / n)
        self._power += self._square.item(i) - self._square.item(i - n)
        self._quiet += 1
        if self._power > _GROWN**2 * self._least:
            self.factor *= 0.5
            self.halved += 1
            self._forget()
            return
        self._least = min(self._least, self._power)
        if self.factor < 1.0 and self._quiet > _QUIET * n:
            self.factor, self._quiet = 2.0 * self.factor, 0

    def add(self, number: int, y_um: float, answer_V: float) -> float:
        """The correction, V, of the point of sample ``number``: ``y_um`` is wanted, the model answers ``answer_V``."""
        if number != self._next:
            self._restart(number)
        i = number - self._base
        if i == 2 * KEPT:
            self._columns[:, :KEPT] = self._columns[:, KEPT:]
            self._base, i = self._base + KEPT, KEPT
        self._columns[:, i] = y_um, answer_V, 0.0, math.nan, 0.0
        self._next = number + 1
        if self._missing > self._fade:
            self._forget()
        self._follow(i)
        if not self.active:
            self.release()
            return self.u_V
        half = self.design.half
        begin = i - self._at_w - 2 * half
        voltage = self._of_w @ self._w[begin : begin + 2 * half + 1]
        begin = i - self._at_r - 2 * half
        low = float(self._of_r @ self._r[begin : begin + 2 * half + 1])
        low = low if low == low else 0.0
        self._low[i] = low
        before = self._low.item(max(i - round(self._delay), 0))
        if before == before:
            # Only what both passes have repeats.
            low = math.copysign(min(abs(low), abs(before)), low) if low * before > 0.0 else 0.0
        self._weight = min(self._weight + 1.0 / half, 1.0)
        u_V = float(voltage + GAIN * self.factor * low - answer_V)
        self.u_V = self._weight * min(max(u_V, -self._bound_V), self._bound_V)
        return self.u_V

    def applied(self, number: int, u_V: float) -> None:
        """The voltage, V, that the point of sample ``number`` got in the end, less what others have added to it."""
        if number < self._next and number >= self._base:
            self._w[number - self._base] = u_V

    def release(self) -> None:
        """Let the correction go for one sample; it is 0 after the length of the low-pass."""
        if self.active:
            self._forget()
        step_V = self._fade_V / max(self.design.half, 1)
        self.u_V = math.copysign(max(abs(self.u_V) - step_V, 0.0), self.u_V)

    def _follow(self, i: int) -> None:
        """Find the period, see that the motion still repeats, and begin once two passes and the low-pass are there."""
        number = self._next - 1
        if self.period is None:
            if number >= self._look_at:
                kept = min(number - self._since + 1, SEARCHED)
                self._look_at = number + max(_LOOK_SAMPLES, math.ceil(_LOOK * kept))
                self.period = find_period(self._y[i + 1 - kept : i + 1])
                if self.period is not None:
                    self._same_since = number - math.floor(2.0 * self.period)
                    self._plan()
            return
        at = i - self.period
        k = math.floor(at)
        if k < 1 or number - self.period < self._since:
            return
        part = at - k
        before = (1.0 - part) * self._y.item(k) + part * self._y.item(k + 1)
        way = abs(self._y.item(i) - self._y.item(i - 1)) + abs(self._y.item(k + 1) - self._y.item(k))
        span = float(np.ptp(self._y[k : i + 1])) if not self.active else self._span
        if abs(self._y.item(i) - before) > SAME * span + 0.5 * way:
            self._forget()
            return
        # The first pass is left out: hysteresis and creep of a motion that has begun are not yet those of the next.
        back = self._at_w + 2 * self.design.half if self._passes else KEPT
        if number - back <= self._same_since + self.period:
            self.release()  # older readings or another lag may need more than there is
        elif not self.active:
            self.active, self._span = True, span
