"""The MPI model that learns online: its weights by least squares with forgetting, in a frame a fast filter moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.errors import InputError
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, StateDict
from baselines.gain_filter import GainFilter
from baselines.least_squares import LeastSquaresConfig, LeastSquaresOnline, config_from
from baselines.online import field_of
from baselines.prandtl_ishlinskii.dead_zone import dead_zone_sum, ramps
from baselines.prandtl_ishlinskii.identify import MpiGrid
from baselines.prandtl_ishlinskii.inverse import MpiInverse
from baselines.prandtl_ishlinskii.model import inverse_thresholds, inverse_weights
from baselines.prandtl_ishlinskii.play import play_run, play_start, play_step

#: How gain and offset of the MPI model's frame walk, per root of a second of teaching: of one, and of the stroke.
GAIN_WALK, OFFSET_WALK = 0.02, 0.01
#: Errors of the model last for many samples: their deviation counts this many times. Least one, of the stroke.
FRAME_ERROR, FRAME_NOISE = 3.0, 1e-3


class MpiOnline(LeastSquaresOnline):
    """Play weights, offset and inverse-saturation slopes that follow the stage, on (2.40) with its scale fixed.

    Implements ``adaptive.types.OnlineModel``. Thresholds stay those of the identified model. A fast filter follows gain
    and offset, and the weights are fitted in its frame: least squares over samples from before and after a change of
    gain would else explain the difference by the shape, and be wrong for as long as it remembers.
    """

    def __init__(self, model: MpiInverse, config: LeastSquaresConfig | None = None) -> None:
        p, domain = model.parameters, model.domain
        stroke = max(domain.y_max_um - p.y_ref_um, 1e-9)
        self._grid = MpiGrid(p.r_.copy(), inverse_thresholds(p.w_s_, p.d_), p.y_ref_um, stroke)
        weights = inverse_weights(p.w_s_)
        self._unknowns = np.concatenate([p.w_h_, [p.c_um], np.cumsum(weights)])
        top = float(model.feedforward(np.array([domain.y_max_um]), np.zeros(1), np.zeros(1), p.start()).u_V[0])
        # Samples of the identified model: loops of falling size over its range, so that every play has moved.
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
        curve = ramps(np.array([self._frame.undo(lead) - self._grid.y_ref_um]), self._grid.d_star_um)[0]
        return np.concatenate([pending, -curve, [0.0]])

    def _residual(self, row: FloatArray) -> float:
        # The slopes are one on the mean of what was visited: the error in x is one in displacement.
        return float(row[:-1] @ self._unknowns)

    def _scale_row(self) -> tuple[FloatArray, float]:
        """(size,) row and value of the scale constraint, both in parts of the latter: cov(S*(y), y) = var(y).

        Over the samples remembered, and not over the stroke of the identification: slopes that nobody visits would
        take up the scale, all others would shrink, and with them every error.
        """
        size, n = self._grid.size, self._grid.r_V.size
        ramp = slice(n + 1, size)
        mean = self._normal[n, ramp] / self._normal[n, n]
        covariance = self._normal[ramp, ramp] - self._normal[n, n] * np.outer(mean, mean)
        row = np.zeros(size)
        row[ramp] = covariance.sum(axis=1)
        return row / float(row.sum()), 1.0

    def _solve(self) -> bool:
        # The scale row is heavy against all samples; a thousandth of a sample holds each weight where it is.
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
        """The model as it stands; its deviation is that of the recent residuals."""
        f, shape = self._frame, self._shape
        w_s = tuple(f.gain * weight for weight in shape.w_s)
        now = replace(shape, w_s=w_s, y_ref_um=f.gain * shape.y_ref_um + f.offset_um)
        std_V = float(np.sqrt(self._square)) / float(np.sum(shape.w_h_) * shape.w_s_[0])
        return replace(self.base, parameters=now, voltage_std_V=std_V)

    def state_dict(self) -> StateDict:
        """Everything; ``from_state`` continues to the same last bit."""
        now = {
            "unknowns": self._unknowns.copy(),
            "states_V": self._states.copy(),
            **prefixed("now_", self._shape.state_dict()),
            **prefixed("frame_", self._frame.state_dict()),
        }
        return {**self._learning_state(), **now, **prefixed("base_", self.base.state_dict())}

    @classmethod
    def from_state(cls, state: StateDict) -> MpiOnline:
        """Inverse of :meth:`state_dict`; raises InputError where a field is missing."""
        made = cls(MpiInverse.from_state(under("base_", state)), config_from(state))
        made._restore_learning(state)
        made._unknowns = np.array(field_of(state, "unknowns", "mpi"), dtype=np.float64)
        made._states = np.array(field_of(state, "states_V", "mpi"), dtype=np.float64)
        made._shape = made._shape.from_state(under("now_", state))
        made._frame.restore(under("frame_", state))
        return made
