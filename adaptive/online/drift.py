"""Drift of the stage: a Kalman filter on the model's linear part, detection of sudden changes, and creep at rest.

The linear part ``beta`` is modelled as a random walk. The process noise is large in the directions of usual changes:
along beta itself (gain), in the constant (offset), and in velocity and acceleration (lag, payload). It is small in all
other coefficients. A gain drop of 6 % is therefore one unknown instead of twenty: the filter finds it within tens of
milliseconds, and the play coefficients keep the shape of the loop.

The algebra is that of ``filterpy.kalman.KalmanFilter`` (Joseph form), compiled. The library takes 70 µs for one update
of 63 coefficients, as much as the rest of the learner. Tests and ``dehyst bench`` compare the two. The measurement is
the voltage minus the kernel part of the model, so that filter and window together fit one model.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan
from typing import Annotated, Any, NamedTuple

import numpy as np

from dehyst.adaptive.compiled import compiled, shared
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import ACCELERATION, MOTION_COLUMNS, VELOCITY
from dehyst.adaptive.state import Entry, Numbers, record_of
from dehyst.adaptive.types import FloatArray

# --- The drift filter's algebra, compiled: one scalar measurement of a random walk, in O(p²).
#
# Equals ``filterpy.kalman.KalmanFilter.update`` with one measurement, in Joseph's form, up to rounding; a test compares
# them. (I - K h') is the identity minus a matrix of rank one, so its products need p² operations instead of p³, without
# copies. This takes a twentieth of the time.


@compiled
def _open_gain(x: FloatArray, P: FloatArray, variance: float) -> None:  # pragma: no cover - compiled
    """P <- P + variance x x': variance along x, the direction of a change of the gain. ``x`` (p,), ``P`` (p, p)."""
    for i in range(x.shape[0]):
        scaled = variance * x[i]
        for j in range(x.shape[0]):
            P[i, j] += scaled * x[j]


@compiled
def walk(x: FloatArray, P: FloatArray, walks: FloatArray, gain_variance: float) -> None:  # pragma: no cover - compiled
    """Prediction step: add ``walks`` (p,) to the diagonal of P, and ``gain_variance`` along x."""
    for i in range(x.shape[0]):
        P[i, i] += walks[i]
    _open_gain(x, P, gain_variance)


@compiled
def innovation_of(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, towards: FloatArray
) -> tuple[float, float]:  # pragma: no cover - compiled
    """(z - h'x, h'Ph) of a measurement ``z`` of h'x; writes P h into ``towards`` (p,)."""
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
def _walk_and_innovation(
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

    ``k`` and ``row`` are scratch arrays (p,).
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
    # P is symmetric, so h'P is the transpose of P h.
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
    """Update of the first coefficient only: the gain of all others is set to zero (Schmidt-Kalman filter)."""
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
    """Process noise of each direction (standard deviation after one second), measurement noise, and detection limits.

    All but ``gain_*``, ``alike_s``, ``burst_ratio`` and ``gate_*`` are shares of the model's voltage span.

    gain_walk : relative change of the whole linear part, deviation after one second.
    offset_walk, motion_walk, shape_walk : the same, shares of the voltage span: of the constant; of velocity and
    acceleration, at full scale; of all other coefficients.
    noise : least deviation of one measurement, share of the voltage span.
    alike_s : time within which model errors are alike; the variance of one measurement is the long-term mean square
    innovation times the measurements within it.
    burst_gain, burst_offset, burst_motion : deviations that a sudden change adds.
    burst_ratio : short-term over long-term mean square innovation at which a change is detected.
    burst_floor : an rms innovation below this share of the voltage span is never a change.
    gate_sigma : an innovation beyond this many deviations is refused.
    gate_persistence : after this many refusals in a row the next one is used.
    """

    gain_walk: float = 0.005
    offset_walk: float = 0.005
    motion_walk: float = 0.00125
    shape_walk: float = 0.000375
    noise: float = 0.0013
    alike_s: float = 0.005
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


class DriftState(Numbers):
    """Counters of the filter, and the innovations by which it detects changes."""

    fast_V2: Annotated[float, Entry("short-term mean square innovation", "V²", low=0.0)] = 0.0
    slow_V2: Annotated[float, Entry("long-term mean square innovation", "V²", low=0.0)] = 0.0
    rejected: Annotated[int, Entry("refused measurements in a row", low=0)] = 0
    quiet: Annotated[int, Entry("updates since the last burst", low=0)] = 0
    bursts: Annotated[int, Entry("detected changes", low=0)] = 0
    updates: Annotated[int, Entry("updates so far", low=0)] = 0


class Mark(NamedTuple):
    """An estimate of the filter to return to."""

    beta: Annotated[FloatArray, Entry("linear part", "V", "p")]
    covariance: Annotated[FloatArray, Entry("its covariance", "V²", "p,p")]


#: Time constants of the short-term and long-term mean square innovation, s.
FAST_S = 0.008
SLOW_S = 2.0
#: Shortest time between two bursts, s: the estimate needs this time to settle after one.
DEAD_S = 0.25


@shared
def expect_change(c: DriftConfig, s: DriftState, x: FloatArray, P: FloatArray, bursts: FloatArray) -> None:
    """See `DriftFilter.expect_change`; ``bursts`` (p,) V²."""
    walk(x, P, bursts, c.burst_gain**2)
    s.quiet = 0
    s.bursts += 1


@shared
def update(
    c: DriftConfig, s: DriftState, x: FloatArray, P: FloatArray, walks: FloatArray, bursts: FloatArray, span_V: float,
    step_s: float, basis: FloatArray, target_V: float, moving: bool, k: FloatArray, row: FloatArray,
) -> str:  # fmt: skip
    """Update with one measurement ``target_V`` of ``basis' x``; ``basis`` (p,).

    Returns "updated", "outlier" (refused) or "burst" (updated, and a sudden change was detected).

    At rest (``moving`` False) only the constant has process noise and is estimated, because all samples have the same
    basis. The other coefficients keep their values and variances (Schmidt-Kalman filter). Otherwise minutes at one
    position would change the model at all others, and would give too much weight to the next motion's first samples.

    ``walks``, ``bursts`` (p,) : variances added by a step and by a sudden change, V². x (p,), P (p, p) change in place;
    k, row (p,) are scratch.
    """
    if moving:
        innovation, variance = _walk_and_innovation(x, P, walks, c.gain_walk**2 * step_s, basis, target_V, row)
    else:
        P[0, 0] += walks[0]
        innovation, variance = innovation_of(x, P, basis, target_V, row)
    noise_V2 = max((c.noise * span_V) ** 2, c.alike_s / step_s * s.slow_V2)
    if innovation * innovation > c.gate_sigma**2 * (variance + noise_V2) and s.rejected < c.gate_persistence:
        s.rejected += 1
        return "outlier"
    s.rejected = 0
    squared = innovation * innovation
    s.fast_V2 += (squared - s.fast_V2) * min(1.0, step_s / FAST_S)
    s.quiet += 1
    outcome = "updated"
    threshold = max(c.burst_ratio * s.slow_V2, (c.burst_floor * span_V) ** 2)
    if s.fast_V2 > threshold and s.quiet * step_s > DEAD_S and moving:
        expect_change(c, s, x, P, bursts)
        outcome = "burst"
    # Limited, so that a change does not raise the long-term level and hide the next change.
    s.slow_V2 += (min(squared, threshold) - s.slow_V2) * min(1.0, step_s / SLOW_S)
    if moving:
        if outcome == "burst":
            # The burst has changed the covariance.
            innovation, variance = innovation_of(x, P, basis, target_V, row)
        take_in(x, P, basis, innovation, variance, noise_V2, k, row)
    else:
        update_constant(x, P, basis, target_V, noise_V2, row)
    s.updates += 1
    return outcome


class DriftFilter(Numbers):
    """Random-walk Kalman filter on ``beta`` (p,), in V per normalised input.

    Parameters
    ----------
    config : frozen configuration.
    beta : (p,) initial estimate, and covariance : (p, p) its covariance, V².
    step_s : time between two updates, s. span_V : the model's voltage span, V.
    record, arrays : where its numbers and its two arrays are kept; of its own unless given.
    """

    _x: Annotated[FloatArray, Entry("linear part", "V", "p", name="beta")]
    _P: Annotated[FloatArray, Entry("its covariance", "V²", "p,p", name="covariance")]
    state: Annotated[DriftState, Entry("counters of the filter", name="")]

    def __init__(
        self,
        config: DriftConfig,
        beta: FloatArray,
        covariance: FloatArray,
        step_s: float,
        span_V: float,
        record: Any = None,
        arrays: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        p = beta.shape[0]
        if covariance.shape != (p, p):
            raise InputError(f"covariance: got shape {covariance.shape}, expected ({p}, {p})")
        self.config = config
        self.step_s = step_s
        self.span_V = span_V
        self.record = np.zeros((), record_of(DriftFilter)) if record is None else record
        self.state = DriftState(slow_V2=(config.noise * span_V) ** 2)
        self._x, self._P = arrays or (np.empty(p), np.empty((p, p)))
        self._x[:], self._P[:] = beta, covariance
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

    @property
    def variances(self) -> tuple[FloatArray, FloatArray]:
        """(p,) variances that each coefficient gains with a step, and with a sudden change, V²."""
        return self._walk.copy(), self._burst.copy()

    def expect_change(self) -> None:
        """Add variance in the directions of a sudden change of the stage: gain, offset, velocity, acceleration."""
        expect_change(self.config, self.state, self._x, self._P, self._burst)

    def mark(self) -> Mark:
        """The estimate as copies, for `restore` and `go_back`."""
        return Mark(self.beta, self.covariance)

    def restore(self, mark: tuple[FloatArray, FloatArray]) -> None:
        """Return to a marked estimate."""
        self._x[:], self._P[:] = mark

    def go_back(self, mark: tuple[FloatArray, FloatArray]) -> None:
        """Return to a marked estimate, and add variance for changes since then."""
        self.restore(mark)
        self.state.rejected = 0
        self.expect_change()

    def shift_constant(self, by_V: float) -> None:
        """Add ``by_V`` to the constant, V; another part of the model has lost as much."""
        self._x[0] += by_V


# --- Creep at rest.

#: Updates of the filter between two moves of the frame: a new feature map takes as long as an update.
FRAME_EVERY = 10
#: Fastest move of the frame, as a share of the range per second: creep is slow.
FASTEST_PER_S = 0.02
#: Fastest change of a voltage that holds a stage in place, as a share of the span per second. With a stuck sensor the
#: stage seems to rest too, but the voltage changes faster.
STILL_PER_S = 0.1


class RestCreep(Numbers):
    """Creep of a stage at rest, and the move of the frame that compensates it.

    To hold a creeping stage in place, the controller slowly reverses the voltage, and this reversal changes the stage's
    hysteresis. If the constant of the linear part absorbed the change, the modelled hysteresis would not reverse, and
    the model would be wrong as soon as the stage moves. Creep is a displacement without a change of voltage. Therefore
    it becomes an offset of the feature map's frame (``adaptive.features``), and the modelled hysteresis reverses too.
    """

    constant_V: Annotated[
        float, Entry("constant of the linear part when the rest began, NaN in motion", "V", finite=False)
    ] = nan
    steps: Annotated[int, Entry("updates of the filter since then", low=0)] = 0
    u_V: Annotated[float, Entry("voltage at the last possible move of the frame", "V", finite=False)] = nan

    @shared
    def leave(self) -> None:
        """End the rest: the stage moves. The constant keeps its value."""
        self.constant_V, self.steps, self.u_V = nan, 0, nan

    @shared
    def shift_um(
        self, constant_V: float, u_V: float, span_V: float, range_um: float, step_s: float, creep_s: float
    ) -> float:
        """Move of the frame's offset, µm, after one more update of the filter at rest; 0 for most updates.

        ``constant_V`` : present constant of the linear part. ``u_V`` : applied voltage. ``span_V``, ``range_um`` : of
        the model. The change of the constant since the rest began moves to the frame with the time constant ``creep_s``
        (0: never).
        """
        if isnan(self.constant_V):
            self.constant_V, self.u_V = constant_V, u_V
        self.steps += 1
        if creep_s <= 0.0 or self.steps % FRAME_EVERY:
            return 0.0
        change_V, self.u_V = abs(u_V - self.u_V), u_V
        if change_V > STILL_PER_S * span_V * FRAME_EVERY * step_s:
            self.constant_V, self.steps, self.u_V = nan, 0, nan
            return 0.0
        gained_um = (constant_V - self.constant_V) * range_um / span_V
        most_um = FASTEST_PER_S * range_um * FRAME_EVERY * step_s
        return -min(max(gained_um * min(1.0, FRAME_EVERY * step_s / creep_s), -most_um), most_um)
