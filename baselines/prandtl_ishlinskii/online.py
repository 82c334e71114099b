"""The MPI model that learns online: weights by least squares with forgetting, gain and offset by a fast filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.online.drift import joseph, walk
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.online_baseline import LeastSquaresConfig, LeastSquaresOnline
from dehyst.baselines.prandtl_ishlinskii.identify import MpiGrid
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters, inverse_thresholds, inverse_weights
from dehyst.baselines.prandtl_ishlinskii.operators import dead_zone_sum, play_run, play_start, play_step, ramps

#: Random walk of gain and offset per square root of a second of teaching: relative, and as a share of the stroke.
GAIN_WALK, OFFSET_WALK = 0.02, 0.01
#: The filter's measurement noise is the residual times this, because model errors last for many samples; and at least
#: this share of the stroke.
FRAME_ERROR, FRAME_NOISE = 3.0, 1e-3
#: Limits of the relative gain.
_GAIN_MIN, _GAIN_MAX = 0.2, 5.0


@dataclass(slots=True)
class GainFilter:
    """Kalman filter of gain and offset in y = gain · model + offset; both are random walks.

    A slower least-squares fit on (y - offset)/gain then sees samples from before and after a change of the gain or of
    the sensor's zero as samples of one stage.

    walk : (2,) variances added per sample, of the gain and of the offset (µm²).
    """

    walk: FloatArray
    covariance: Annotated[FloatArray, Entry("of the estimate", "1, µm, µm²", "2,2")]
    gain: Annotated[float, Entry("the estimated gain", low=_GAIN_MIN, high=_GAIN_MAX)] = 1.0
    offset_um: Annotated[float, Entry("the estimated offset", "µm")] = 0.0

    @classmethod
    def start(cls, gain_walk: float, offset_walk_um: float, step_s: float) -> GainFilter:
        """Walks are standard deviations per square root of a second; samples are ``step_s`` s apart."""
        walk = np.array([gain_walk, offset_walk_um]) ** 2 * step_s
        return cls(walk, np.diag(100.0 * walk))

    def update(self, y_um: float, model_um: float, noise_um2: float) -> None:
        """Take one pair; ``noise_um2`` is the variance of the model error. An update that is not finite is dropped."""
        x, P, h = np.array([self.gain, self.offset_um]), self.covariance.copy(), np.array([model_um, 1.0])
        walk(x, P, self.walk, 0.0)
        joseph(x, P, h, y_um, noise_um2, np.empty(2), np.empty(2))
        if np.isfinite(x).all() and np.isfinite(P).all():
            self.covariance = P
            gain, offset_um = x.tolist()
            self.gain, self.offset_um = min(max(gain, _GAIN_MIN), _GAIN_MAX), offset_um

    def to_model(self, y_um: float) -> float:
        """The displacement without the filter's gain and offset, in the frame of the model, µm."""
        return (y_um - self.offset_um) / self.gain


class MpiOnline(LeastSquaresOnline):
    """Play weights, offset and inverse-saturation slopes that follow the stage, fitted to (2.40) with a fixed scale.

    Implements ``adaptive.types.OnlineModel``. The thresholds stay those of the identified model. A fast filter follows
    gain and offset, and the weights are fitted in its frame. Without it, least squares over samples from before and
    after a change of gain would explain the difference by the shape for as long as they are remembered.
    """

    BASE = MpiInverse

    base: MpiInverse
    _unknowns: Annotated[FloatArray, Entry("weights, offset and inverse-saturation slopes", "", "unknowns")]
    _states: Annotated[FloatArray, Entry("states of the plays", "V", "plays", name="states_V")]
    _shape: Annotated[MpiParameters, Entry("the present model", name="now")]
    _frame: Annotated[GainFilter, Entry("gain and offset")]

    @property
    def pending_size(self) -> int:
        return self._states.size + 1

    @property
    def sizes(self) -> dict[str, int]:
        plays, zones = self._states.size, len(self._shape.d_um)
        return super().sizes | {"unknowns": self._unknowns.size, "plays": plays, "zones": zones}

    @property
    def given(self) -> dict[str, Any]:
        return {"_frame": {"walk": self._frame.walk}}

    def __init__(self, model: MpiInverse, config: LeastSquaresConfig | None = None) -> None:
        p, domain = model.parameters, model.domain
        stroke = max(domain.y_max_um - p.y_ref_um, 1e-9)
        self._grid = MpiGrid(p.r_.copy(), inverse_thresholds(p.w_s_, p.d_), p.y_ref_um, stroke)
        weights = inverse_weights(p.w_s_)
        self._unknowns = np.concatenate([p.w_h_, [p.c_um], np.cumsum(weights)])
        top = float(model.feedforward(np.array([domain.y_max_um]), np.zeros(1), np.zeros(1), p.start()).u_V[0])
        # Samples of the identified model: loops of decreasing size over its range, which move every play.
        turns = top * np.ravel(np.column_stack([np.linspace(1.0, 0.05, 12), np.zeros(12)]))
        u = np.interp(np.arange(0.0, 23.0, 0.05), np.arange(-1, 23), np.concatenate([[0.0], turns[:23]]))
        plays = play_run(u, p.r_, play_start(float(u[0]), p.r_))
        y = replace(p, lag_s=0.0).simulate(u, model.dt_s)
        rows = np.hstack([plays, np.ones((u.size, 1)), -ramps(y - p.y_ref_um, self._grid.d_star_um)])
        rows = np.hstack([rows, np.zeros((u.size, 1))])
        super().__init__(model.dt_s, abs(top), config or LeastSquaresConfig(), rows)
        self.base = model
        self._lower = self._grid.lower_bounds(max(abs(top), 1e-9))
        self._states = p.start()
        scale = float(np.mean(self._unknowns[p.r_.size + 1 :]))
        self._square = (model.voltage_std_V * p.w_h_[0] / scale) ** 2 if np.isfinite(model.voltage_std_V) else 0.0
        self._shape = p
        self._floor_um2 = (FRAME_NOISE * stroke) ** 2
        self._frame = GainFilter.start(GAIN_WALK, OFFSET_WALK * stroke, self.config.learn_every * model.dt_s)

    def _step_memory(self, u_V: float, first: bool) -> None:
        play_step(u_V, self._grid.r_V, self._states)

    def _regressors_now(self) -> FloatArray:
        return np.append(self._states, 1.0)

    def _row(self, pending: FloatArray, y_um: float, v_um_per_s: float) -> FloatArray:
        p, lead = self._shape, y_um + self.base.parameters.lag_s * v_um_per_s
        model = p.y_ref_um + float(dead_zone_sum(float(p.w_h_ @ pending[:-1]) + p.c_um, p.d_, p.w_s_))
        self._frame.update(lead, model, max(FRAME_ERROR**2 * self._square, self._floor_um2))
        curve = ramps(np.array([self._frame.to_model(lead) - self._grid.y_ref_um]), self._grid.d_star_um)[0]
        return np.concatenate([pending, -curve, [0.0]])

    def _residual(self, row: FloatArray) -> float:
        # The mean slope over the visited range is 1, so an error in x is one in displacement.
        return float(row[:-1] @ self._unknowns)

    def _scale_row(self) -> tuple[FloatArray, float]:
        """(size,) row and value of the scale constraint cov(S*(y), y) = var(y), both divided by its value.

        It is taken over the remembered samples, not over the stroke of the identification. Slopes outside the visited
        range could otherwise take up the scale; all others, and with them every error, would shrink.
        """
        size, n = self._grid.size, self._grid.r_V.size
        ramp = slice(n + 1, size)
        mean = self._normal[n, ramp] / self._normal[n, n]
        covariance = self._normal[ramp, ramp] - self._normal[n, n] * np.outer(mean, mean)
        row = np.zeros(size)
        row[ramp] = covariance.sum(axis=1)
        return row / float(row.sum()), 1.0

    def _solve(self) -> bool:
        # The scale row outweighs all samples. The weight of a thousandth of a sample holds each unknown at its value.
        size = self._grid.size
        normal = self._normal.copy()
        mass = float(np.mean(np.diag(normal)[:size]))
        row, one = self._scale_row()
        present = self._unknowns / float(row @ self._unknowns)
        scale = np.append(row, one)
        hold = 1e-3 * np.maximum(np.diag(normal)[:size], 1e-3 * mass) / self.config.remember
        normal += 1e4 * mass * np.outer(scale, scale)
        normal[np.arange(size), np.arange(size)] += hold
        normal[:size, size] += hold * present
        normal[size, :size] += hold * present
        normal[size, size] += float(hold @ present**2)
        try:
            unknowns = self._minimum(normal, self._lower)
            shape = self._grid.model(unknowns, self.base.parameters.lag_s)
        except (InputError, RuntimeError):
            return False
        self._unknowns = unknowns / float(row @ unknowns)
        self._shape = shape
        return True

    def snapshot(self) -> MpiInverse:
        """The present model; its standard deviation is that of the recent residuals."""
        f, shape = self._frame, self._shape
        w_s = tuple(f.gain * weight for weight in shape.w_s)
        now = replace(shape, w_s=w_s, y_ref_um=f.gain * shape.y_ref_um + f.offset_um)
        std_V = float(np.sqrt(self._square)) / float(np.sum(shape.w_h_) * shape.w_s_[0])
        return replace(self.base, parameters=now, voltage_std_V=std_V)
