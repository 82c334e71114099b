"""A Bouc-Wen model that learns online: an extended Kalman filter of gain, offset and the shape of the loop.

The model runs beside the stage on the applied voltages. It is linear in gain and offset. Its derivatives by the shape
come from three copies that run with one parameter 0.1 % larger each, hysteresis and dynamics included, so the slopes
of the filter carry the whole history. The modes (b/k, m/k) stay as identified.

Parameters are relative: d/d0, (y0 - y00)/range, alpha/alpha0, lambda/lambda0, rho/rho0 with lambda = beta + gamma and
rho = beta/lambda. They are random walks in the time that samples teach, within bounds that keep the model invertible.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dehyst.adaptive.compiled import all_finite, compiled
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.online import drift as drift_step
from dehyst.adaptive.online.gates import LEARNT, NUMERICS, OUTLIER, PASSED, SETTLING, UNEXCITED
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.model import BoucWenInverse
from dehyst.baselines.bouc_wen.step import hysteresis_step, settled, stage_output, stage_step
from dehyst.baselines.online_baseline import OnlineBaseline

#: Relative increase of one shape parameter in each copy of the model.
_NUDGE = 1e-3
#: Bounds of the relative parameters.
_LOWEST = np.array([0.3, -1.0, 0.3, 0.3, 0.3])
_HIGHEST = np.array([3.0, 1.0, 3.0, 3.0, 3.0])


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """How fast the filter follows.

    Attributes
    ----------
    learn_every : samples between two updates.
    first_std : initial standard deviation of (gain, offset, alpha, lambda, rho), relative.
    walk_std : random walk of the same, per square root of a second of teaching.
    model_error : measurement noise as a multiple of the identification's residual; above 1 because model errors last
        for many samples.
    outlier_sigma : an innovation beyond this many standard deviations is refused.
    outlier_persistence : after this many refusals in a row the variance is raised instead.
    excitation, settle : as in ``LeastSquaresConfig``.

    Raises InputError on a value out of range.
    """

    learn_every: int = 10
    first_std: tuple[float, float, float, float, float] = (0.05, 0.02, 0.1, 0.1, 0.1)
    walk_std: tuple[float, float, float, float, float] = (0.02, 0.01, 0.02, 0.02, 0.02)
    model_error: float = 3.0
    outlier_sigma: float = 6.0
    outlier_persistence: int = 20
    excitation: float = 0.002
    settle: int = 50

    def __post_init__(self) -> None:
        if self.learn_every < 1 or self.settle < 0 or self.outlier_persistence < 1:
            raise InputError(f"learn_every, settle, outlier_persistence: got {self!r}, expected >= 1, >= 0, >= 1")
        stds = np.array([*self.first_std, *self.walk_std])
        if stds.shape != (10,) or not np.all(np.isfinite(stds) & (stds >= 0.0)):
            raise InputError(f"first_std, walk_std: got {self.first_std}, {self.walk_std}, expected 5 values >= 0 each")
        if not (self.model_error > 0.0 and self.outlier_sigma > 0.0):
            raise InputError(f"model_error, outlier_sigma: got {self.model_error}, {self.outlier_sigma}, expected > 0")


@compiled
def _copies_step(
    states: FloatArray,
    shapes: FloatArray,
    u_V: float,
    p1: complex,
    p2: complex,
    T: float,
    linear: bool,
    out: FloatArray,
) -> None:
    """Advance all copies, ``states`` (c, 6), by one sample; ``out`` (c,) are their outputs at its instant, V."""
    for i in range(states.shape[0]):
        if linear:
            stage_step(states[i], u_V, p1, p2, T, shapes[i])
            out[i] = stage_output(states[i], p1, p2)
        else:
            stage_step(states[i], states[i, 0], p1, p2, T, shapes[i])
            out[i] = stage_output(states[i], p1, p2)
            a, b, c = shapes[i]
            states[i, 1] = hysteresis_step(states[i, 1], u_V - states[i, 0], a, b, c)
            states[i, 0] = u_V


class BoucWenOnline(OnlineBaseline):
    """Bouc-Wen stage whose parameters follow the samples. Implements ``adaptive.types.OnlineModel``."""

    BASE, CONFIG = BoucWenInverse, TrackingConfig

    base: BoucWenInverse
    config: TrackingConfig
    _x: Annotated[FloatArray, Entry("gain, offset, alpha, lambda, rho, relative", "", "5")]
    _P: Annotated[FloatArray, Entry("their covariance", "", "5,5")]
    _states: Annotated[FloatArray, Entry("states of the model and of its three copies", "V", "4,6")]
    _taught_u: Annotated[
        float,
        Entry("voltage of the last sample that taught, at first infinite", "V", finite=False, name="taught_u_V"),
    ]
    _refused: Annotated[int, Entry("refusals in a row", low=0)]

    def __init__(self, model: BoucWenInverse, config: TrackingConfig | None = None) -> None:
        self.config = config or TrackingConfig()
        super().__init__(model.dt_s, self.config.settle)
        self.base = model
        p, domain = model.parameters, model.domain
        self._range = max(domain.y_max_um - domain.y_min_um, 1e-9)
        rate = p.beta_per_V + p.gamma_per_V
        self._base_shape = (max(p.alpha, 0.02), rate, max(p.beta_per_V / rate, 0.02))
        self._step_V = self.config.excitation * self._range / p.d_um_per_V
        self._x = np.array([1.0, 0.0, 1.0, 1.0, 1.0])
        self._first = np.array(self.config.first_std) ** 2
        self._P = np.diag(self._first)
        self._walk = np.array(self.config.walk_std) ** 2 * self.config.learn_every * self._dt
        std_um = model.voltage_std_V * p.d_um_per_V
        floor = 1e-4 * self._range
        self._noise = (self.config.model_error * max(std_um if np.isfinite(std_um) else 0.0, floor)) ** 2
        self._square = self._noise / self.config.model_error**2
        self._shapes = np.empty((4, 3))
        self._set_shapes()
        self._states = np.tile(settled(0.0, 0.0), (4, 1))
        self._out = np.zeros(4)
        self._taught_u = np.inf
        self._refused = 0

    def _shape(self, x: FloatArray) -> tuple[float, float, float]:
        """alpha, beta, gamma of relative parameters (5,), limited to an invertible model."""
        alpha0, rate0, rho0 = self._base_shape
        rho = min(max(rho0 * float(x[4]), 0.01), 5.0)
        rate = rate0 * float(x[3])
        alpha = min(max(alpha0 * float(x[2]), 0.0), 0.98 / max(1.0, 2.0 * rho))
        return alpha, rho * rate, (1.0 - rho) * rate

    def _set_shapes(self) -> None:
        self._shapes[0] = self._shape(self._x)
        for i in range(3):
            nudged = self._x.copy()
            nudged[2 + i] += _NUDGE
            self._shapes[1 + i] = self._shape(nudged)

    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        linear = self.base.parameters.hold == "linear"
        for state, shape in zip(self._states, self._shapes, strict=True):
            g = hysteresis_step(float(state[1]), u_V - float(state[0]), *shape)
            state[:] = settled(u_V, g)
            if first and not linear:
                state[2] = state[4] = 0.0

    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        p1, p2 = self.base.parameters.modes
        linear = self.base.parameters.hold == "linear"
        _copies_step(self._states, self._shapes, u_V, p1, p2, self._dt, linear, self._out)
        if not settled:
            return SETTLING
        if self._since_start % self.config.learn_every:
            return PASSED
        if abs(u_V - self._taught_u) < self._step_V:
            return UNEXCITED
        self._taught_u = u_V
        return self._update(y_um)

    def _update(self, y_um: float) -> str:
        p = self.base.parameters
        d = p.d_um_per_V * self._x[0]
        slopes = np.empty(5)
        slopes[0] = p.d_um_per_V * self._out[0]
        slopes[1] = self._range
        slopes[2:] = d * (self._out[1:] - self._out[0]) / _NUDGE
        innovation = y_um - (d * self._out[0] + p.offset_um + self._range * self._x[1])
        P, moved, row = self._P.copy(), np.zeros(5), np.empty(5)
        drift_step.walk(moved, P, self._walk, 0.0)
        variance = drift_step.innovation_of(moved, P, slopes, innovation, row)[1] + self._noise
        if innovation**2 > self.config.outlier_sigma**2 * variance:
            self._refused += 1
            if self._refused >= self.config.outlier_persistence:
                self._P, self._refused = self._P + np.diag(self._first), 0
            return OUTLIER
        self._refused = 0
        # Joseph's form keeps P positive definite; the limit below stops the growth in directions without excitation.
        drift_step.joseph(moved, P, slopes, innovation, self._noise, np.empty(5), row)
        x = self._x + moved
        if not (all_finite(x) and all_finite(P.reshape(-1))):
            self._P = np.diag(self._first)
            return NUMERICS
        shrink = np.sqrt(np.minimum(1.0, 4.0 * self._first / np.maximum(np.diag(P), 1e-300)))
        self._P = P * np.outer(shrink, shrink)
        self._x = np.minimum(np.maximum(x, _LOWEST), _HIGHEST)
        self._set_shapes()
        self._square += (innovation**2 - self._square) / 400.0
        return LEARNT

    def snapshot(self) -> BoucWenInverse:
        """The inverse of the present stage; its standard deviation is that of the recent innovations."""
        p = self.base.parameters
        alpha, beta, gamma = (float(value) for value in self._shapes[0])
        now = replace(
            p,
            d_um_per_V=float(p.d_um_per_V * self._x[0]),
            offset_um=float(p.offset_um + self._range * self._x[1]),
            alpha=alpha,
            beta_per_V=beta,
            gamma_per_V=gamma,
        )
        return replace(self.base, parameters=now, voltage_std_V=float(np.sqrt(self._square)) / now.d_um_per_V)

    def _restored(self) -> None:
        self._set_shapes()
