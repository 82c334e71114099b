"""What is fast and global: a Kalman filter on the model's linear part, and the detection of sudden changes.

The linear part ``beta`` walks at random. How it may walk is what makes it fast without forgetting: mostly along
itself, which is a change of the stage's gain; in the constant, an offset; in velocity and acceleration, where a lag
and a payload show; and a little in every other coefficient. A gain drop of 6 % is one direction to find, not twenty,
so it is found within tens of milliseconds, while what the plays know of the loop's shape stays.

``filterpy.kalman.KalmanFilter`` does the algebra (Joseph form). The measurement is the voltage minus the kernel part
of the model, so that filter and window learn one model together and neither undoes the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from adaptive.errors import InputError
from adaptive.features import ACCELERATION, MOTION_COLUMNS, VELOCITY
from adaptive.types import FloatArray, StateDict


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
    offset_walk: float = 0.0025
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
        self._filter = KalmanFilter(dim_x=p, dim_z=1)
        self._filter.x = beta.reshape(p, 1).copy()
        self._filter.P = np.array(covariance, dtype=np.float64)
        self._filter.R = np.array([[self._noise_V2]])
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
        return np.array(self._filter.x[:, 0])

    @property
    def covariance(self) -> FloatArray:
        """(p, p) of the estimate, V²; a copy."""
        return np.array(self._filter.P)

    def update(self, basis: FloatArray, target_V: float, moving: bool) -> str:
        """One measurement of ``basis' beta``. Returns "updated", "outlier" or "burst" (a change was detected).

        At rest (``moving`` False) only the constant walks and only it is estimated: nothing else can be told apart
        there. The rest of the covariance is considered, not learnt from (Schmidt's filter), so that minutes in one
        place neither bend what is known of the others nor make the next motion's first samples count for too much.
        """
        c, s, kf = self.config, self.state, self._filter
        x = kf.x[:, 0]
        if moving:
            kf.P[np.diag_indices_from(kf.P)] += self._walk
            self._open_gain(c.gain_walk**2 * self.step_s)
        else:
            kf.P[0, 0] += self._walk[0]
        innovation = target_V - float(basis @ x)
        variance = float(basis @ kf.P @ basis) + self._noise_V2
        if innovation * innovation > c.gate_sigma**2 * variance and s.rejected < c.gate_persistence:
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
            kf.update(target_V, H=basis.reshape(1, -1))
        else:
            self._update_constant(basis, innovation)
        kf.P = 0.5 * (kf.P + kf.P.T)
        s.updates += 1
        return outcome

    def _update_constant(self, basis: FloatArray, innovation: float) -> None:
        """Joseph's form with a gain that is zero but for the constant."""
        kf = self._filter
        towards = kf.P @ basis
        gain = float(towards[0]) / (float(basis @ towards) + self._noise_V2)
        kf.x[0, 0] += gain * innovation
        variance = float(basis @ towards) + self._noise_V2
        kf.P[0, :] -= gain * towards
        kf.P[:, 0] -= gain * towards
        kf.P[0, 0] += gain * gain * variance

    def expect_change(self) -> None:
        """Open the directions in which a sudden change of the stage shows: gain, offset, velocity, acceleration."""
        self._filter.P[np.diag_indices_from(self._filter.P)] += self._burst
        self._open_gain(self.config.burst_gain**2)
        self.state.quiet = 0
        self.state.bursts += 1

    def _open_gain(self, variance: float) -> None:
        x = self._filter.x[:, 0]
        self._filter.P += variance * np.outer(x, x)

    def mark(self) -> tuple[FloatArray, FloatArray]:
        """What ``go_back`` needs to return to the present estimate."""
        return self.beta, self.covariance

    def go_back(self, mark: tuple[FloatArray, FloatArray]) -> None:
        """Return to a marked estimate, ready for what may have changed since."""
        self._filter.x = mark[0].reshape(-1, 1).copy()
        self._filter.P = mark[1].copy()
        self.state.rejected = 0
        self.expect_change()

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
