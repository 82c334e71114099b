"""The linear model: displacement is gain times voltage plus an offset. Identification, inverse, and online form."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.baselines.bounded_least_squares import SLOPE_FLOOR
from dehyst.baselines.common import BaselineInverse, FitReport, checked_recording
from dehyst.baselines.online_baseline import LeastSquaresConfig, LeastSquaresOnline


@dataclass(frozen=True)
class LinearParameters:
    """``y = gain u + offset``. Raises InputError unless both are finite and the gain is not zero."""

    gain_um_per_V: Annotated[float, Entry("gain", "µm/V")]
    offset_um: Annotated[float, Entry("displacement at 0 V", "µm")] = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gain_um_per_V) and self.gain_um_per_V != 0.0):
            raise InputError(f"gain_um_per_V: got {self.gain_um_per_V!r}, expected a finite value other than 0")
        if not math.isfinite(self.offset_um):
            raise InputError(f"offset_um: got {self.offset_um!r}, expected a finite value")

    def simulate(self, u_V: FloatArray, dt_s: float) -> FloatArray:
        """Displacement (n,) µm for voltages (n,) V; ``dt_s`` has no influence."""
        return np.asarray(u_V, dtype=np.float64) * self.gain_um_per_V + self.offset_um


def identify_linear(u_V: ArrayLike, y_um: ArrayLike, dt_s: float) -> tuple[LinearParameters, FitReport]:
    """Gain and offset by least squares; ``u_V`` V and ``y_um`` µm are (n,), n >= 3, ``dt_s`` s apart.

    Raises InputError on an unusable recording.
    """
    u, y, dt = checked_recording(u_V, y_um, dt_s, 3)
    gain, offset = np.polynomial.polynomial.polyfit(u, y, 1)[::-1]
    parameters = LinearParameters(float(gain), float(offset))
    report = FitReport.of("linear", "least squares", y, parameters.simulate(u, dt), dt, 1, True)
    return parameters, report


@dataclass(frozen=True)
class LinearInverse(BaselineInverse):
    """Inverse of :class:`LinearParameters`. It has no memory."""

    parameters: Annotated[LinearParameters, Entry("the identified stage", name="")]
    name: Annotated[str, Entry("by which it is served", most=1000)] = "linear"

    @property
    def memory_size(self) -> int:
        return 0

    def _run(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray, u_V: FloatArray,
        inside: BoolArray,
    ) -> None:  # fmt: skip
        u_V[:] = (y_um - self.parameters.offset_um) / self.parameters.gain_um_per_V
        inside[:] = (y_um >= self.domain.y_min_um) & (y_um <= self.domain.y_max_um)

    def _drive(self, u_V: FloatArray, memory: FloatArray) -> None:
        return


def fit_linear(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, serve_dt_s: float | None = None
) -> tuple[LinearInverse, FitReport]:
    """Identify a line and invert it. ``serve_dt_s``: sample time of the queries, s; by default that of the recording.

    The three functions take (n,) voltages V and displacements µm, ``dt_s`` s apart, and raise InputError on an unusable
    recording.
    """
    parameters, report = identify_linear(u_V, y_um, dt_s)
    return LinearInverse.of(parameters, report, u_V, serve_dt_s)


class LinearOnline(LeastSquaresOnline):
    """Gain and offset by least squares with forgetting; the gain keeps its sign. Implements ``OnlineModel``.

    By default a sample is remembered for 100 samples that teach.
    """

    BASE = LinearInverse

    base: LinearInverse
    _gain: Annotated[float, Entry("gain", "µm/V", name="gain_now")]
    _offset: Annotated[float, Entry("offset", "µm", name="offset_now")]

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

    @property
    def pending_size(self) -> int:
        return 2

    def _regressors_now(self) -> FloatArray:
        return np.array([self._recent[-1][0], 1.0])

    def _row(self, pending: FloatArray, y_um: float, v_um_per_s: float) -> FloatArray:
        return np.append(pending, y_um)

    def _residual(self, row: FloatArray) -> float:
        return float(self._gain * row[0] + self._offset - row[2])

    def _solve(self) -> bool:
        # A lower bound keeps the sign of the gain; the problem is mirrored where displacement falls with voltage.
        signs = np.array([self._sign, 1.0, 1.0])
        floor = SLOPE_FLOOR * abs(self.base.parameters.gain_um_per_V)
        try:
            gain, offset = self._minimum(self._normal * np.outer(signs, signs), np.array([floor, -np.inf]))
        except RuntimeError:
            return False
        self._gain, self._offset = float(gain * self._sign), float(offset)
        return True

    def snapshot(self) -> LinearInverse:
        """The present line; its standard deviation is that of the recent residuals."""
        std = float(np.sqrt(self._square)) / abs(self._gain)
        return replace(self.base, parameters=LinearParameters(self._gain, self._offset), voltage_std_V=std)
