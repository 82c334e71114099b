"""The line that learns online: gain and offset by least squares with forgetting, the sign of the gain kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, StateDict
from baselines.least_squares import LeastSquaresConfig, LeastSquaresOnline, config_from
from baselines.linear import LinearInverse, LinearParameters
from baselines.online import field_of
from baselines.prandtl_ishlinskii.identify import SLOPE_FLOOR


class LinearOnline(LeastSquaresOnline):
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
        made = cls(LinearInverse.from_state(under("base_", state)), config_from(state))
        made._restore_learning(state)
        made._gain = float(field_of(state, "gain_now", "linear"))
        made._offset = float(field_of(state, "offset_now", "linear"))
        return made
