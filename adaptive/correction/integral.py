"""A guarded integral of the residual, for clients with fresh readings: voltage = feedforward + correction.

The correction is an integral of the residual (wanted less read, both of the reading's own sample), behind a low-pass of
first order, times the model's slope dV/dy. `design` chooses its gain from the delay of the readings, the lag of the
stage and the lowest frequency at which it may ring. `Correction` keeps it within a bound, leaves out doubted readings
and the noise of a stage at rest, and halves the gain once it oscillates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, InverseModel

#: Phase margin, rad, and gain margin of `design` for a model whose slope is right.
PHASE_MARGIN: Final = math.pi / 3.0
GAIN_MARGIN: Final = 2.0
#: Damping ratio that a mode has at least.
LEAST_DAMPING: Final = 0.01
#: Largest gain as a share of the lowest mode. Up to there the mode lifts the loop by less than ``_LIFT``.
_OF_MODE: Final = 0.25
_LIFT: Final = 1.08


class Loop(NamedTuple):
    """``gain_per_s`` of the integral, 1/s, and ``filter_s``, the time constant of its low-pass, s."""

    gain_per_s: float
    filter_s: float


def design(delay_s: float, lag_s: float, mode_Hz: float, dt_s: float) -> Loop:
    """The fastest integral with `PHASE_MARGIN` and `GAIN_MARGIN`, in closed form.

    The loop is K / s · 1 / (1 + s tau) · e^(-s delay) · 1 / (1 + s lag) · mode(s). Its phase falls from -90° by at most
    ω (delay + lag + tau), so that it crosses 1 with the phase margin where::

        K (delay + lag + tau) <= pi / 2 - PHASE_MARGIN

    At a mode of damping d the loop is K / (2 d ω) / (ω tau) at most, whatever its phase. So the gain margin asks::

        K <= 2 d ω² tau / GAIN_MARGIN

    A longer tau relaxes the second and tightens the first: both hold with equality at the root of a quadratic. In
    samples, one ω of the second is 2 / dt sin(ω dt / 2); a mode that they cannot show may appear anywhere, so that no
    low-pass helps.

    Parameters
    ----------
    delay_s : from the instant of a reading to the voltage that it changes, s. lag_s : of the stage, s.
    mode_Hz : lowest frequency at which the stage may ring, with a damping of at least `LEAST_DAMPING`, Hz.
    """
    omega = 2.0 * math.pi * mode_Hz
    dead_s = max(delay_s, 0.0) + max(lag_s, 0.0)
    phase = (0.5 * math.pi - PHASE_MARGIN) / _LIFT
    most_per_s = 2.0 * LEAST_DAMPING * omega / GAIN_MARGIN
    if omega * dt_s >= math.pi:
        return Loop(min(most_per_s, phase / dead_s if dead_s else math.inf), 0.0)
    most_per_s2 = most_per_s * 2.0 / dt_s * math.sin(0.5 * omega * dt_s)
    filter_s = -0.5 * dead_s + math.sqrt(0.25 * dead_s**2 + phase / most_per_s2)
    return Loop(min(most_per_s2 * filter_s, _OF_MODE * omega), filter_s)


#: Points of the model at which `sensitivity` asks, as a share of the range to both sides, and ranges per second.
_STEP: Final = 0.02
_SPEED_PER_S: Final = 1.0


def sensitivity(model: InverseModel, y_um: float, memory: FloatArray, range_um: float) -> tuple[float, float]:
    """(slope dV/dy in V/µm, lag in s) of ``model`` at rest at ``y_um`` with (m,) ``memory``, which is not changed.

    Of the slopes to the two sides it is the flatter one: that of the branch on which the stage moves. Just after a turn
    the other one is steeper, and a correction by it would be too strong for a stage in motion.
    """

    def voltage(y: float, v: float) -> float:
        points = np.array([y]), np.array([v]), np.zeros(1)
        return float(model.feedforward(*points, memory).u_V[0])

    step_um, speed = _STEP * range_um, _SPEED_PER_S * range_um
    here_V = voltage(y_um, 0.0)
    sides = (voltage(y_um + step_um, 0.0) - here_V) / step_um, (here_V - voltage(y_um - step_um, 0.0)) / step_um
    slope = min(sides, key=abs)
    if not (math.isfinite(slope) and slope):
        return 0.0, 0.0
    lag_s = (voltage(y_um, speed) - voltage(y_um, -speed)) / (2.0 * speed * slope)
    return slope, max(lag_s, 0.0) if math.isfinite(lag_s) else 0.0


#: Time in which the estimate of the noise grows or falls by a factor e, s. Long beside an oscillation of the loop.
_NOISE_S: Final = 1.0
#: Standard deviations of noise: dead band at rest, and what a reading may be off by noise alone.
_DEAD_SIGMA: Final = 3.0
_NOISE_SIGMA: Final = 4.0
#: Half periods of an oscillation after which the gain is halved, and the ratio of last to first peak that tells it from
#: a ring that dies away: of one with a damping of `LEAST_DAMPING` this ratio is exp(-8 pi / 100) = 0.78.
_HALF_PERIODS: Final = 8
_LASTING: Final = 0.9
#: Time without an oscillation after which the gain doubles again, up to its whole, s.
_RECOVER_S: Final = 60.0


@dataclass(slots=True)
class _Oscillation:
    """Tells an oscillation that lasts from noise, from a ring that dies away, and from the motion that is asked for."""

    side: int = 0
    peak_um: float = 0.0
    since_s: float = 0.0
    peaks_um: tuple[float, ...] = ()

    def lasts(self, residual_um: float, level_um: float, longest_s: float, turned: bool, dt_s: float) -> bool:
        """Take a residual; True where it has gone `_HALF_PERIODS` times from one side to the other and lasts.

        ``level_um`` : smaller residuals are noise. ``longest_s`` : half the period of the slowest oscillation that is
        the loop's own. ``turned`` : the motion asked for has turned, which begins the count anew.
        """
        self.since_s += dt_s
        if turned or self.since_s > longest_s:
            self.peaks_um = ()
        side = (residual_um > level_um) - (residual_um < -level_um)
        if side == self.side or not side:
            self.peak_um = max(self.peak_um, abs(residual_um))
            return False
        if self.side:
            self.peaks_um = (*self.peaks_um, self.peak_um)[-_HALF_PERIODS - 1 :]
        self.side, self.peak_um, self.since_s = side, abs(residual_um), 0.0
        # By pairs: a ring about another place than 0 has higher peaks on one side.
        peaks = self.peaks_um
        if len(peaks) <= _HALF_PERIODS or max(peaks[-2:]) < _LASTING * max(peaks[:2]):
            return False
        self.peaks_um = ()
        return True


class Correction:
    """What is added to the feedforward of one axis, V; one `take` for each reading.

    Parameters
    ----------
    dt_s : sample time, s. mode_Hz : as for `design`. fade_s : time over which `release` lets the correction go, s.

    Attributes
    ----------
    u_V : the correction, V. loop : the design in use. factor : share of its gain. halved : times that an oscillation
    halved it. noise_um : standard deviation of a reading. doubted : readings that were not used.

    Raises InputError on numbers that are not above 0.
    """

    def __init__(self, dt_s: float, mode_Hz: float, fade_s: float) -> None:
        for name, value in (("dt_s", dt_s), ("mode_Hz", mode_Hz), ("fade_s", fade_s)):
            if not 0.0 < value < math.inf:
                raise InputError(f"{name}: got {value}, expected a finite number above 0")
        self.u_V = 0.0
        self.factor = 1.0
        self.halved = self.doubted = 0
        self.loop = Loop(0.0, 0.0)
        self._dt_s, self._mode_Hz, self._fade_s = dt_s, mode_Hz, fade_s
        self._designed = (math.nan, math.nan)
        self._slope, self._bound_V, self._most_V = 0.0, 0.0, 0.0
        self._filtered_um, self._before_um = 0.0, math.nan
        self.noise_um, self._readings = 0.0, 0
        self._speed, self._held_V = 0.0, 0.0
        self._watch, self._quiet_s = _Oscillation(), 0.0
        self._waited_s, self._fade_V = 0.0, 0.0

    def set(self, age: int, slope_V_per_um: float, lag_s: float, bound_V: float) -> None:
        """What the next readings are used by; the gain is designed anew where age or lag have changed.

        ``age`` : samples from a reading to the voltage that it changes. ``slope_V_per_um`` , ``lag_s`` : of the model
        (`sensitivity`). ``bound_V`` : largest correction, V, and largest residual that is no doubt. It falls at once.
        It rises only with good readings, by a factor e in ``fade_s``: a fault of the sensor raises the deviation that
        the model states, too.
        """
        if (age, lag_s) != self._designed:
            self._designed = (age, lag_s)
            self.loop = design(age * self._dt_s, lag_s, self._mode_Hz, self._dt_s)
        self._slope, self._most_V = slope_V_per_um, bound_V
        self._bound_V = min(self._bound_V, bound_V) or bound_V

    def take(self, residual_um: float, speed_um_per_s: float) -> None:
        """Use a reading: ``residual_um`` is wanted less read, µm, and ``speed_um_per_s`` is as wanted.

        A residual that is not finite, or beyond bound and noise, is doubted: see `wait`.
        """
        dt_s, slope = self._dt_s, abs(self._slope)
        turned = speed_um_per_s * self._speed < 0.0
        self._speed = speed_um_per_s
        noise_um = _NOISE_SIGMA * self.noise_um
        if slope and math.isfinite(residual_um):
            self._look(residual_um, max(0.25 * self._bound_V / slope, noise_um), turned)
        if not (slope and abs(residual_um) <= self._bound_V / slope + noise_um):
            self.doubted += 1
            self.wait()
            return
        self._waited_s = self._fade_V = 0.0
        # The median of the differences of white readings is 0.95 of their standard deviation.
        change_um, self._before_um = abs(residual_um - self._before_um), residual_um
        self._readings += 1
        share = max(1.0 / (self._readings + 1), dt_s / _NOISE_S)
        if change_um > self.noise_um:
            self.noise_um = self.noise_um * (1.0 + share) or change_um
        elif change_um < self.noise_um:
            self.noise_um *= 1.0 - share
        gain_per_s, filter_s = self.loop
        alpha = dt_s / (dt_s + filter_s)
        self._filtered_um += alpha * (residual_um - self._filtered_um)
        error_um = self._filtered_um
        if self._at_rest(speed_um_per_s):
            # At rest: what the noise explains would only make the stage jitter.
            dead_um = _DEAD_SIGMA * self.noise_um * math.sqrt(alpha / (2.0 - alpha))
            error_um -= min(max(error_um, -dead_um), dead_um)
        u_V = self.u_V + self.factor * gain_per_s * dt_s * self._slope * error_um
        # A bound that has come down takes the correction along as slowly as it is let go.
        most_V = max(self._bound_V, abs(self.u_V) * (1.0 - dt_s / self._fade_s))
        self.u_V = min(max(u_V, -most_V), most_V)
        self._bound_V = min(self._most_V, self._bound_V * (1.0 + dt_s / self._fade_s))

    def begin(self, u_V: float, bound_V: float) -> None:
        """Begin with ``u_V``, V, as far as it is within ``bound_V``."""
        self.u_V = min(max(u_V, -bound_V), bound_V)

    def hand_over(self, taken_V: float, speed_um_per_s: float) -> None:
        """Give up what a new model has taken over: its voltage is by ``taken_V`` above that of the one before.

        Only what the correction carries: it does not resist the model, and comes no further from 0. At rest the voltage
        stays, and `let_in` the rest of the change: a model changes with the noise that it learns from.
        """
        left_V = self.u_V - taken_V
        self.u_V = min(max(left_V, min(self.u_V, 0.0)), max(self.u_V, 0.0))
        if self._at_rest(speed_um_per_s):
            self._held_V += left_V - self.u_V
            self.u_V = left_V

    def let_in(self) -> None:
        """Once for each point: let in of a new model what is held back, as fast as the low-pass of the readings."""
        part_V = self._held_V * self._dt_s / (self._dt_s + self.loop.filter_s)
        self._held_V -= part_V
        self.u_V -= part_V

    def _at_rest(self, speed_um_per_s: float) -> bool:
        """Whether the way within low-pass and age is less than the noise."""
        return abs(speed_um_per_s) * (self.loop.filter_s + self._designed[0] * self._dt_s) < self.noise_um

    def wait(self) -> None:
        """Keep the correction for one sample without a reading; after ``fade_s`` of them in a row let it go."""
        self._waited_s += self._dt_s
        self._before_um = math.nan
        if self._waited_s > self._fade_s:
            self.release()

    def release(self) -> None:
        """Let the correction go for one sample; after ``fade_s`` of them in a row it is 0."""
        self._fade_V = self._fade_V or abs(self.u_V) * self._dt_s / self._fade_s
        self.u_V = math.copysign(max(abs(self.u_V) - self._fade_V, 0.0), self.u_V)
        self._filtered_um, self._before_um = 0.0, math.nan
        self._held_V = 0.0

    def _look(self, residual_um: float, level_um: float, turned: bool) -> None:
        """Halve the gain once an oscillation lasts that is as fast as the loop or faster."""
        gain_per_s = max(self.factor * self.loop.gain_per_s, 1e-9)
        self._quiet_s += self._dt_s
        if self._watch.lasts(residual_um, level_um, math.pi / gain_per_s, turned, self._dt_s):
            self.factor *= 0.5
            self.halved += 1
            self._quiet_s = 0.0
        elif self.factor < 1.0 and self._quiet_s > _RECOVER_S:
            self.factor, self._quiet_s = min(1.0, 2.0 * self.factor), 0.0
