"""Linear and MPI models that learn online: least squares with forgetting, signs kept.

Both are linear in their weights. The normal matrix of all samples, each forgotten by the same factor with every
newer one, is the exact recursive least squares in information form; unlike the covariance form it takes bounds
on the weights, and nothing in it winds up. It starts from samples that the identified model gives over its own
range, so that learning begins at the identified weights and moves off as real samples take their place. Samples
are forgotten by samples that teach, not by time: a stage at rest forgets nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, replace

import numpy as np

from adaptive.admission import LEARNT, NUMERICS, PASSED, SETTLING, UNEXCITED
from adaptive.compiled import compiled
from adaptive.errors import InputError
from adaptive.types import FloatArray, StateDict
from baselines.bounded import bounded_minimum
from baselines.dead_zone import dead_zone_sum, ramps
from baselines.gain_filter import GainFilter
from baselines.identify_mpi import SLOPE_FLOOR, MpiGrid
from baselines.linear import LinearInverse, LinearParameters
from baselines.mpi_inverse import MpiInverse
from baselines.online import OnlineBaseline, field_of, prefixed, without_prefix
from baselines.play import play_run, play_start, play_step
from baselines.prandtl_ishlinskii import inverse_thresholds, inverse_weights

#: How gain and offset of the MPI model's frame walk, per root of a second of teaching: of one, and of the stroke.
GAIN_WALK, OFFSET_WALK = 0.02, 0.01
#: Errors of the model last for many samples: their deviation counts this many times. Least one, of the stroke.
FRAME_ERROR, FRAME_NOISE = 3.0, 1e-3
#: The velocity is a difference over this many samples on each side.
_HALF = 2


@dataclass(frozen=True, slots=True)
class LeastSquaresConfig:
    """How fast the least-squares baselines learn.

    learn_every : samples between two that may teach; at least 5. solve_every : taught ones between two solutions.
    remember : taught samples after which one counts 1/e; by default 300, for the line 100.
    trust : samples that the identified model counts for.
    excitation : share of the voltage range by which u must have moved for a sample to teach.
    settle : samples after a start or gap that do not teach.
    """

    learn_every: int = 10
    solve_every: int = 10
    remember: float = 300.0
    trust: float = 200.0
    excitation: float = 0.002
    settle: int = 50

    def __post_init__(self) -> None:
        if self.learn_every < 2 * _HALF + 1 or self.solve_every < 1:
            raise InputError(
                f"learn_every, solve_every: got {self.learn_every}, {self.solve_every}, expected at least 5 and 1"
            )
        if not (self.remember >= 10.0 and self.trust > 0.0 and self.excitation >= 0.0 and self.settle >= 0):
            raise InputError(f"remember, trust, excitation, settle: got {self!r}, expected >= 10, > 0, >= 0, >= 0")


@compiled
def forget_and_add(normal: FloatArray, row: FloatArray, keep: float) -> None:
    """normal <- keep normal + row row', in place; exactly symmetric."""
    for i in range(row.size):
        for j in range(i, row.size):
            value = keep * normal[i, j] + row[i] * row[j]
            normal[i, j] = value
            normal[j, i] = value


class _LeastSquaresOnline(OnlineBaseline):
    """One row [regressors, target] per taught sample; the models say how it is made and solved."""

    def __init__(self, dt_s: float, u_range_V: float, config: LeastSquaresConfig, rows: FloatArray) -> None:
        super().__init__(dt_s, config.settle)
        self.config = config
        self._step_V = config.excitation * u_range_V
        self._keep = 1.0 - 1.0 / config.remember
        self._normal = (rows.T @ rows) * (config.trust / rows.shape[0])
        self._recent: deque[tuple[float, float]] = deque(maxlen=2 * _HALF + 1)
        self._taught_u = np.inf
        self._pending = np.empty(0)

    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        self._recent.clear()
        self._recent.append((u_V, y_um))
        self._step_memory(u_V, first)

    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        self._step_memory(u_V, False)
        self._recent.append((u_V, y_um))
        phase = self._since_start % self.config.learn_every
        if phase == 0:
            self._pending = self._regressors_now()
        if not settled:
            return SETTLING
        if phase != _HALF or len(self._recent) <= 2 * _HALF:
            return PASSED
        u, y = self._recent[_HALF]
        if abs(u - self._taught_u) < self._step_V:
            return UNEXCITED
        speed = (self._recent[-1][1] - self._recent[0][1]) / (2.0 * _HALF * self._dt)
        self._taught_u = u
        row = self._row(self._pending, y, speed)
        forget_and_add(self._normal, row, self._keep)
        residual = self._residual(row)
        self._square += (residual * residual - self._square) / self.config.remember
        if (self._counters[LEARNT] + 1) % self.config.solve_every == 0 and not self._solve():
            return NUMERICS
        return LEARNT

    def _step_memory(self, u_V: float, first: bool) -> None:
        """Advance what the model remembers of the voltage."""

    def _regressors_now(self) -> FloatArray:
        """The part of a row that depends on voltages, at this instant."""
        raise NotImplementedError

    def _row(self, pending: FloatArray, y_um: float, v_um_per_s: float) -> FloatArray:
        raise NotImplementedError

    def _residual(self, row: FloatArray) -> float:
        """Residual of the model as it stands, µm."""
        raise NotImplementedError

    def _solve(self) -> bool:
        """New weights from the normal matrix; False, and nothing changed, where that fails."""
        raise NotImplementedError

    @staticmethod
    def _minimum(normal: FloatArray, lower: FloatArray) -> FloatArray:
        """Weights (p,) of least squares above ``lower`` (p,), ``normal`` having the target as its last column.

        Raises RuntimeError where there are none.
        """
        matrix = normal[:-1, :-1] + 1e-12 * np.diag(normal).max() * np.eye(lower.size)
        return bounded_minimum(matrix, normal[:-1, -1], lower)

    def _learning_state(self) -> StateDict:
        return {
            **self._common_state(),
            **prefixed("config_", asdict(self.config)),
            "normal": self._normal.copy(),
            "recent": np.array(list(self._recent), dtype=np.float64).reshape(-1, 2),
            "taught_u_V": float(self._taught_u) if np.isfinite(self._taught_u) else None,
            "pending": self._pending.copy(),
        }

    def _restore_learning(self, state: StateDict) -> None:
        self._restore_common(state)
        self._normal = np.array(state["normal"], dtype=np.float64)
        self._recent.extend((float(u), float(y)) for u, y in np.asarray(state["recent"]).reshape(-1, 2))
        taught = state["taught_u_V"]
        self._taught_u = np.inf if taught is None else float(taught)
        self._pending = np.array(state["pending"], dtype=np.float64)


def _config_from(state: StateDict) -> LeastSquaresConfig:
    values = without_prefix("config_", state)
    whole = {name: int(field_of(values, name, "online")) for name in ("learn_every", "solve_every", "settle")}
    real = {name: float(field_of(values, name, "online")) for name in ("remember", "trust", "excitation")}
    return LeastSquaresConfig(
        learn_every=whole["learn_every"], solve_every=whole["solve_every"], settle=whole["settle"], **real
    )


class LinearOnline(_LeastSquaresOnline):
    """Gain and offset that follow the stage. Implements ``adaptive.types.OnlineModel``."""

    def __init__(self, model: LinearInverse, config: LeastSquaresConfig | None = None) -> None:
        p, domain = model.parameters, model.domain
        y = np.linspace(domain.y_min_um, domain.y_max_um, 50)
        u = (y - p.offset_um) / p.gain_um_per_V
        super().__init__(
            model.dt_s,
            float(abs(u[-1] - u[0])),
            config or LeastSquaresConfig(remember=100.0),
            np.column_stack([u, np.ones(50), y]),
        )
        self.base = model
        self._gain, self._offset, self._sign = p.gain_um_per_V, p.offset_um, np.sign(p.gain_um_per_V)
        self._square = (model.voltage_std_V * p.gain_um_per_V) ** 2 if np.isfinite(model.voltage_std_V) else 0.0

    def _regressors_now(self) -> FloatArray:
        return np.array([self._recent[-1][0], 1.0])

    def _row(self, pending: FloatArray, y_um: float, v_um_per_s: float) -> FloatArray:
        return np.append(pending, y_um)

    def _residual(self, row: FloatArray) -> float:
        return float(self._gain * row[0] + self._offset - row[2])

    def _solve(self) -> bool:
        # The slope keeps its sign: a bound, mirrored where displacement falls with voltage.
        signs = np.array([self._sign, 1.0, 1.0])
        floor = SLOPE_FLOOR * abs(self.base.parameters.gain_um_per_V)
        try:
            gain, offset = self._minimum(self._normal * np.outer(signs, signs), np.array([floor, -np.inf]))
        except RuntimeError:
            return False
        self._gain, self._offset = float(gain * self._sign), float(offset)
        return True

    def snapshot(self) -> LinearInverse:
        """The line as it stands; its deviation is that of the recent residuals."""
        std = float(np.sqrt(self._square)) / abs(self._gain)
        return replace(self.base, parameters=LinearParameters(self._gain, self._offset), voltage_std_V=std)

    def state_dict(self) -> StateDict:
        """Everything; ``from_state`` continues to the same last bit."""
        now = {"gain_now": self._gain, "offset_now": self._offset}
        return {**self._learning_state(), **now, **prefixed("base_", self.base.state_dict())}

    @classmethod
    def from_state(cls, state: StateDict) -> LinearOnline:
        """Inverse of :meth:`state_dict`; raises InputError where a field is missing."""
        made = cls(LinearInverse.from_state(without_prefix("base_", state)), _config_from(state))
        made._restore_learning(state)
        made._gain = float(field_of(state, "gain_now", "linear"))
        made._offset = float(field_of(state, "offset_now", "linear"))
        return made


class MpiOnline(_LeastSquaresOnline):
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
        made = cls(MpiInverse.from_state(without_prefix("base_", state)), _config_from(state))
        made._restore_learning(state)
        made._unknowns = np.array(field_of(state, "unknowns", "mpi"), dtype=np.float64)
        made._states = np.array(field_of(state, "states_V", "mpi"), dtype=np.float64)
        made._shape = made._shape.from_state(without_prefix("now_", state))
        made._frame.restore(without_prefix("frame_", state))
        return made
