"""Gain and offset of a displacement against a model's, by a Kalman filter of two states: the frame of a slower fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.online.drift import joseph, walk
from adaptive.types import FloatArray, StateDict

#: Least and most that a gain may be: a stage whose gain has changed its sign or by more than this is another stage.
_GAIN_MIN, _GAIN_MAX = 0.2, 5.0


@dataclass(slots=True)
class GainFilter:
    """y = gain · model + offset, both walking at random with each sample that teaches.

    A slower least-squares fit on (y - offset)/gain then sees samples from before and after a change of gain or of the
    sensor's zero as samples of one and the same stage.

    Attributes
    ----------
    walk : (2,) variances added a sample, of the gain and of the offset (µm²).
    gain, offset_um : the estimate. covariance : (2, 2).
    """

    walk: FloatArray
    covariance: FloatArray
    gain: float = 1.0
    offset_um: float = 0.0

    @classmethod
    def start(cls, gain_walk: float, offset_walk_um: float, step_s: float) -> GainFilter:
        """Walks are deviations per root of a second of teaching; samples that teach are ``step_s`` apart."""
        walk = np.array([gain_walk, offset_walk_um]) ** 2 * step_s
        return cls(walk, np.diag(100.0 * walk))

    def update(self, y_um: float, model_um: float, noise_um2: float) -> None:
        """One pair; ``noise_um2`` is the variance of the model's error. What would not stay finite changes nothing."""
        x, P, h = np.array([self.gain, self.offset_um]), self.covariance.copy(), np.array([model_um, 1.0])
        walk(x, P, self.walk, 0.0)
        joseph(x, P, h, y_um, noise_um2, np.empty(2), np.empty(2))
        if np.isfinite(x).all() and np.isfinite(P).all():
            self.covariance = P
            gain, offset_um = x.tolist()
            self.gain, self.offset_um = min(max(gain, _GAIN_MIN), _GAIN_MAX), offset_um

    def undo(self, y_um: float) -> float:
        """The displacement as the model would have it."""
        return (y_um - self.offset_um) / self.gain

    def state_dict(self) -> StateDict:
        return {"gain": self.gain, "offset_um": self.offset_um, "covariance": self.covariance.copy()}

    def restore(self, state: StateDict) -> None:
        """Go on from a ``state_dict``."""
        self.gain, self.offset_um = float(state["gain"]), float(state["offset_um"])
        self.covariance = np.array(state["covariance"], dtype=np.float64)
