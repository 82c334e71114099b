"""Drift of the stage: a Kalman filter on the model's linear part, detection of sudden changes, and creep at rest.

The linear part ``beta`` is a random walk. Its process noise makes it fast without forgetting: large along beta itself
(a change of the gain), in the constant (an offset), and in velocity and acceleration (a lag, a payload); small in every
other coefficient. A gain drop of 6 % is one direction to find instead of twenty, so it is found within tens of
milliseconds, and the play coefficients keep the shape of the loop.

The algebra is that of ``filterpy.kalman.KalmanFilter`` (Joseph form), compiled: the library's calls and copies cost
70 µs an update of 63 coefficients, as much as the rest of the learner. Tests and ``dehyst bench`` compare the two. The
measurement is the voltage minus the kernel part of the model, so that filter and window learn one model together.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan

import numpy as np

from adaptive.compiled import compiled
from adaptive.errors import InputError, ModelFileError
from adaptive.features import ACCELERATION, MOTION_COLUMNS, VELOCITY
from adaptive.types import FloatArray, StateDict

# --- The drift filter's algebra, compiled: one scalar measurement of a random walk, in O(p²).
#
# The same filter as ``filterpy.kalman.KalmanFilter.update`` with one measurement, in Joseph's form and to rounding; the
# tests hold it to that. Its products with (I - K h') are of rank one: worked out entry by entry they cost p² operations
# instead of p³, without a copy or a call between them, at a twentieth of the time.


@compiled
def open_gain(x: FloatArray, P: FloatArray, variance: float) -> None:  # pragma: no cover - compiled
    """P <- P + variance x x': the direction of a change of the gain. ``x`` (p,), ``P`` (p, p)."""
    for i in range(x.shape[0]):
        scaled = variance * x[i]
        for j in range(x.shape[0]):
            P[i, j] += scaled * x[j]


@compiled
def walk(x: FloatArray, P: FloatArray, walks: FloatArray, gain_variance: float) -> None:  # pragma: no cover - compiled
    """Prediction of a random walk: ``walks`` (p,) on the diagonal of P, and a walk of the gain along x."""
    for i in range(x.shape[0]):
        P[i, i] += walks[i]
    open_gain(x, P, gain_variance)


@compiled
def innovation_of(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, towards: FloatArray
) -> tuple[float, float]:  # pragma: no cover - compiled
    """(z - h'x, h'Ph) of a measurement ``z`` along ``h`` (p,); ``towards`` (p,) becomes P h."""
    p = x.shape[0]
    predicted = variance = 0.0
    for i in range(p):
        s = 0.0
        for j in range(p):
            s += P[i, j] * h[j]
        towards[i] = s
        predicted += h[i] * x[i]
        variance += h[i] * s
    return z - predicted, variance


@compiled
def walk_and_innovation(
    x: FloatArray, P: FloatArray, walks: FloatArray, gain_variance: float, h: FloatArray, z: float, towards: FloatArray
) -> tuple[float, float]:  # pragma: no cover - compiled
    """:func:`walk`, then :func:`innovation_of`, in one call."""
    walk(x, P, walks, gain_variance)
    return innovation_of(x, P, h, z, towards)


@compiled
def joseph(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, noise: float, k: FloatArray, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """x <- x + K (z - h'x), P <- (I - K h') P (I - K h')' + noise K K', made exactly symmetric.

    ``k`` and ``row`` are (p,) of scratch.
    """
    innovation, variance = innovation_of(x, P, h, z, row)
    take_in(x, P, h, innovation, variance, noise, k, row)


@compiled
def take_in(
    x: FloatArray,
    P: FloatArray,
    h: FloatArray,
    innovation: float,
    variance: float,
    noise: float,
    k: FloatArray,
    row: FloatArray,
) -> None:  # pragma: no cover - compiled
    """:func:`joseph` of a measurement whose :func:`innovation_of` is known; that call filled ``row`` (p,) with P h."""
    p = x.shape[0]
    for i in range(p):
        k[i] = row[i] / (variance + noise)
    for i in range(p):
        x[i] += k[i] * innovation
    # P is symmetric, so that h'P is the row that P h is the column of.
    for i in range(p):
        s = 0.0
        for j in range(p):
            value = P[i, j] - k[i] * row[j]
            P[i, j] = value
            s += value * h[j]
        for j in range(p):
            P[i, j] += (noise * k[i] - s) * k[j]
    for i in range(p):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean


@compiled
def update_constant(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, noise: float, row: FloatArray
) -> None:  # pragma: no cover - compiled
    """Joseph's form with a gain that is zero but for the first entry (Schmidt's filter: the rest is considered)."""
    p = x.shape[0]
    innovation, variance = innovation_of(x, P, h, z, row)
    variance += noise
    gain = row[0] / variance
    x[0] += gain * innovation
    for j in range(p):
        P[0, j] -= gain * row[j]
    for j in range(p):
        P[j, 0] -= gain * row[j]
    P[0, 0] += gain * gain * variance
    for j in range(p):
        mean = 0.5 * (P[0, j] + P[j, 0])
        P[0, j] = mean
        P[j, 0] = mean


@dataclass(frozen=True, slots=True)
class DriftConfig:
    """How fast each direction may walk (per square root of a second), and how much one measurement is trusted.

    All but ``gain_*``, ``burst_ratio`` and the gate are shares of the model's voltage span.

    gain_walk : relative change of the whole linear part. offset_walk : of the constant.
    motion_walk : of the velocity and acceleration coefficients, at full scale of the feature map.
    shape_walk : of all other coefficients.
    noise : standard deviation of one measurement; larger than the sensor's, because errors of the model last.
    burst_gain, burst_offset, burst_motion : deviations opened at once when a change is detected.
    burst_ratio : detection threshold, short-term over long-term mean square innovation.
    burst_floor : rms innovations below this are never a change.
    gate_sigma : innovations beyond this many standard deviations are refused ...
    gate_persistence : ... unless this many in a row are.
    """

    gain_walk: float = 0.005
    offset_walk: float = 0.005
    motion_walk: float = 0.00125
    shape_walk: float = 0.000125
    noise: float = 0.0013
    burst_gain: float = 0.03
    burst_offset: float = 0.005
    burst_motion: float = 0.0025
    burst_ratio: float = 25.0
    burst_floor: float = 0.0025
    gate_sigma: float = 8.0
    gate_persistence: int = 6

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"drift.{name}: got {value}, expected a finite number, not negative")
        if self.noise <= 0.0:
            raise InputError(f"drift.noise: got {self.noise}, expected a positive share of the voltage span")


@dataclass(slots=True)
class DriftState:
    """fast, slow : short and long-term mean square innovation, V². rejected : in a row. quiet : steps since a burst."""

    fast_V2: float = 0.0
    slow_V2: float = 0.0
    rejected: int = 0
    quiet: int = 0
    bursts: int = 0
    updates: int = 0


#: Time constants of the innovation's short and long-term mean square, s.
FAST_S = 0.008
SLOW_S = 2.0
#: No second burst within this time, s: the first one needs it to be used up.
DEAD_S = 0.25


class DriftFilter:
    """Random-walk Kalman filter on ``beta`` (p,), in V per normalised input.

    Parameters
    ----------
    config : frozen configuration.
    beta : (p,) starting value. covariance : (p, p) of it, V².
    step_s : time between two updates, s. span_V : the model's voltage span, V.
    """

    def __init__(
        self, config: DriftConfig, beta: FloatArray, covariance: FloatArray, step_s: float, span_V: float
    ) -> None:
        p = beta.shape[0]
        if covariance.shape != (p, p):
            raise InputError(f"covariance: got shape {covariance.shape}, expected ({p}, {p})")
        self.config = config
        self.step_s = step_s
        self.span_V = span_V
        self._noise_V2 = (config.noise * span_V) ** 2
        self._floor_V2 = (config.burst_floor * span_V) ** 2
        self.state = DriftState(slow_V2=self._noise_V2, fast_V2=0.0)
        self._x = np.array(beta, dtype=np.float64)
        self._P = np.array(covariance, dtype=np.float64, order="C")
        self._k, self._row = np.empty(p), np.empty(p)
        walk, burst = np.full(p, config.shape_walk), np.zeros(p)
        walk[0], burst[0] = config.offset_walk, config.burst_offset
        if p >= MOTION_COLUMNS:
            walk[VELOCITY : ACCELERATION + 1] = config.motion_walk
            burst[VELOCITY : ACCELERATION + 1] = config.burst_motion
        self._walk = (walk * span_V) ** 2 * step_s
        self._burst = (burst * span_V) ** 2

    @property
    def beta(self) -> FloatArray:
        """(p,) current estimate; a copy."""
        return self._x.copy()

    @property
    def covariance(self) -> FloatArray:
        """(p, p) of the estimate, V²; a copy."""
        return self._P.copy()

    def update(self, basis: FloatArray, target_V: float, moving: bool, weight: float = 1.0) -> str:
        """One measurement of ``basis' beta``. Returns "updated", "outlier" or "burst" (a change was detected).

        At rest (``moving`` False) only the constant walks and only it is estimated: nothing else can be told apart
        there. The rest of the covariance is considered, not learnt from (Schmidt's filter), so that minutes in one
        place neither bend what is known of the others nor make the next motion's first samples count for too much.
        ``weight`` : of the measurement, above 0; its noise variance is 1/weight of the ordinary.
        """
        c, s, x, P = self.config, self.state, self._x, self._P
        if moving:
            gain_V2 = c.gain_walk**2 * self.step_s
            innovation, variance = walk_and_innovation(x, P, self._walk, gain_V2, basis, target_V, self._row)
        else:
            P[0, 0] += self._walk[0]
            innovation, variance = innovation_of(x, P, basis, target_V, self._row)
        noise_V2 = self._noise_V2 / weight
        if innovation * innovation > c.gate_sigma**2 * (variance + noise_V2) and s.rejected < c.gate_persistence:
            s.rejected += 1
            return "outlier"
        s.rejected = 0
        squared = innovation * innovation
        s.fast_V2 += (squared - s.fast_V2) * min(1.0, self.step_s / FAST_S)
        s.quiet += 1
        outcome = "updated"
        threshold = max(c.burst_ratio * s.slow_V2, self._floor_V2)
        if s.fast_V2 > threshold and s.quiet * self.step_s > DEAD_S and moving:
            self.expect_change()
            outcome = "burst"
        # The long-term level must not learn the change itself, or a second change would hide behind the first.
        s.slow_V2 += (min(squared, threshold) - s.slow_V2) * min(1.0, self.step_s / SLOW_S)
        if moving:
            if outcome == "burst":
                # It has widened the covariance.
                innovation, variance = innovation_of(x, P, basis, target_V, self._row)
            take_in(x, P, basis, innovation, variance, noise_V2, self._k, self._row)
        else:
            update_constant(x, P, basis, target_V, noise_V2, self._row)
        s.updates += 1
        return outcome

    def expect_change(self) -> None:
        """Open the directions in which a sudden change of the stage shows: gain, offset, velocity, acceleration."""
        walk(self._x, self._P, self._burst, self.config.burst_gain**2)
        self.state.quiet = 0
        self.state.bursts += 1

    def mark(self) -> tuple[FloatArray, FloatArray]:
        """What ``go_back`` needs to return to the present estimate."""
        return self.beta, self.covariance

    def restore(self, mark: tuple[FloatArray, FloatArray]) -> None:
        """Return to a marked estimate as it was."""
        self._x[:], self._P[:] = mark

    def go_back(self, mark: tuple[FloatArray, FloatArray]) -> None:
        """Return to a marked estimate, ready for what may have changed since."""
        self.restore(mark)
        self.state.rejected = 0
        self.expect_change()

    def shift_constant(self, by_V: float) -> None:
        """Add to the constant, V: what another part of the model gives up."""
        self._x[0] += by_V

    def state_dict(self) -> StateDict:
        s = self.state
        return {
            "beta": self.beta,
            "covariance": self.covariance,
            "fast_V2": s.fast_V2,
            "slow_V2": s.slow_V2,
            "rejected": s.rejected,
            "quiet": s.quiet,
            "bursts": s.bursts,
            "updates": s.updates,
        }

    @classmethod
    def from_state(cls, config: DriftConfig, step_s: float, span_V: float, values: StateDict) -> DriftFilter:
        made = cls(
            config,
            np.asarray(values["beta"], dtype=np.float64),
            np.asarray(values["covariance"], dtype=np.float64),
            step_s,
            span_V,
        )
        made.state = DriftState(
            fast_V2=float(values["fast_V2"]),
            slow_V2=float(values["slow_V2"]),
            rejected=int(values["rejected"]),
            quiet=int(values["quiet"]),
            bursts=int(values["bursts"]),
            updates=int(values["updates"]),
        )
        return made


# --- Creep at rest.

#: Steps of the filter between two moves of the frame: a new feature map costs as much as a step.
_FRAME_EVERY = 10
#: Largest move of the frame, as a share of the range a second: creep is slow.
_FASTEST_PER_S = 0.02
#: Largest move of a voltage that holds a stage in place, as a share of the span a second. A stuck sensor shows a stage
#: at rest too, but with a voltage that moves on.
_STILL_PER_S = 0.1


@dataclass(slots=True)
class RestCreep:
    """Creep of a stage at rest, and the move of the frame that follows from it.

    To hold a creeping stage in place the voltage must creep back, and this small reversal enters the stage's
    hysteresis. If the constant of the linear part took up the difference, the hysteresis of the model would stay as it
    was, which shows as soon as the stage moves. Creep is a displacement without a voltage. As an offset of the feature
    map's frame (``adaptive.features``) it lets the modelled hysteresis reverse as the voltage does.

    constant_V : constant of the linear part when the rest began, NaN while the stage moves. steps : of the filter
    since.
    u_V : voltage at the last step that could move the frame.
    """

    constant_V: float = nan
    steps: int = 0
    u_V: float = nan

    def leave(self) -> None:
        """The stage moves: the constant keeps its value."""
        self.constant_V, self.steps, self.u_V = nan, 0, nan

    def shift_um(
        self, constant_V: float, u_V: float, span_V: float, range_um: float, step_s: float, creep_s: float
    ) -> float:
        """Move of the frame's offset, µm, after one more step of the filter at rest; mostly 0.

        ``constant_V`` is that of the linear part now, ``u_V`` the voltage; ``span_V`` and ``range_um`` those of the
        model. The gain of the constant since the rest began moves to the frame with the time constant ``creep_s``
        (0: never).
        """
        if isnan(self.constant_V):
            self.constant_V, self.u_V = constant_V, u_V
        self.steps += 1
        if creep_s <= 0.0 or self.steps % _FRAME_EVERY:
            return 0.0
        went_V, self.u_V = abs(u_V - self.u_V), u_V
        if went_V > _STILL_PER_S * span_V * _FRAME_EVERY * step_s:
            self.leave()
            return 0.0
        gained_um = (constant_V - self.constant_V) * range_um / span_V
        most_um = _FASTEST_PER_S * range_um * _FRAME_EVERY * step_s
        return -min(max(gained_um * min(1.0, _FRAME_EVERY * step_s / creep_s), -most_um), most_um)

    def state_dict(self) -> StateDict:
        return {"constant_V": self.constant_V, "steps": self.steps, "u_V": self.u_V}

    @classmethod
    def from_state(cls, values: StateDict) -> RestCreep:
        """Inverse of ``state_dict``; older states have no entries: the stage moves."""
        if not values:
            return cls()
        try:
            return cls(float(values["constant_V"]), int(values["steps"]), float(values["u_V"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"rest: entry missing or damaged: {error}") from error
