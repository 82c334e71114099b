"""Gain and offset of a displacement against a model's, by a Kalman filter: the frame in which a slower fit is made."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray, StateDict


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
        # Two by two, written out in plain numbers: as arrays the same takes ten times as long.
        (p00, p01), (_, p11) = self.covariance.tolist()
        w0, w1 = self.walk.tolist()
        p00, p11 = p00 + w0, p11 + w1
        along0, along1 = p00 * model_um + p01, p01 * model_um + p11
        variance = model_um * along0 + along1 + noise_um2
        gain0, gain1 = along0 / variance, along1 / variance
        innovation = y_um - self.gain * model_um - self.offset_um
        # Joseph's form, (I - K h') P (I - K h')' + r K K', stays positive.
        k00, k01, k10, k11 = 1.0 - gain0 * model_um, -gain0, -gain1 * model_um, 1.0 - gain1
        a00, a01 = k00 * p00 + k01 * p01, k00 * p01 + k01 * p11
        a10, a11 = k10 * p00 + k11 * p01, k10 * p01 + k11 * p11
        new00 = a00 * k00 + a01 * k01 + noise_um2 * gain0 * gain0
        new01 = a00 * k10 + a01 * k11 + noise_um2 * gain0 * gain1
        new11 = a10 * k10 + a11 * k11 + noise_um2 * gain1 * gain1
        gain, offset_um = self.gain + gain0 * innovation, self.offset_um + gain1 * innovation
        if all(map(math.isfinite, (new00, new01, new11, gain, offset_um))):
            self.covariance = np.array([[new00, new01], [new01, new11]])
            # A stage whose gain has changed its sign or by more than this is another stage.
            self.gain, self.offset_um = min(max(gain, 0.2), 5.0), offset_um

    def undo(self, y_um: float) -> float:
        """The displacement as the model would have it."""
        return (y_um - self.offset_um) / self.gain

    def state_dict(self) -> StateDict:
        return {"gain": self.gain, "offset_um": self.offset_um, "covariance": self.covariance.copy()}

    def restore(self, state: StateDict) -> None:
        """Go on from a ``state_dict``."""
        self.gain, self.offset_um = float(state["gain"]), float(state["offset_um"])
        self.covariance = np.array(state["covariance"], dtype=np.float64)
