"""What all baselines share: the report of a fit, argument checks, the served inverse."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry, load, save
from dehyst.adaptive.types import BoolArray, Feedforward, FloatArray, StateDict

# --- How well an identified baseline fits its recording, and the motion that the recording covers.


@dataclass(frozen=True, slots=True)
class Domain:
    """Range of the motion in an identification: displacement µm, largest speed µm/s."""

    y_min_um: Annotated[float, Entry("lowest displacement", "µm")]
    y_max_um: Annotated[float, Entry("highest displacement", "µm")]
    v_max_um_per_s: Annotated[float, Entry("largest speed", "µm/s")]

    @staticmethod
    def of(y_um: FloatArray, dt_s: float) -> Domain:
        """Range of a recording (n,) µm; the speed is the largest central difference."""
        speed = np.abs(y_um[2:] - y_um[:-2]) / (2.0 * dt_s)
        return Domain(float(y_um.min()), float(y_um.max()), float(speed.max()))


@dataclass(frozen=True, slots=True)
class FitReport:
    """Errors of an identified forward model, run freely over the whole recording it was identified on.

    Attributes
    ----------
    model, method : names for people; the method says how the state at the first sample was chosen.
    samples, dt_s, range_um : of the recording.
    rmse_um, mae_um, max_um : errors, µm.
    evaluations : runs of the model, or solutions of the least-squares problem.
    converged : False where the optimiser stopped at its limit.
    domain : range of motion of the recording.
    """

    model: str
    method: str
    samples: int
    dt_s: float
    range_um: float
    rmse_um: float
    mae_um: float
    max_um: float
    evaluations: int
    converged: bool
    domain: Domain
    notes: tuple[str, ...] = ()

    @property
    def rmse_pct(self) -> float:
        """RMSE in percent of the motion range."""
        return 100.0 * self.rmse_um / self.range_um

    @property
    def mae_pct(self) -> float:
        """MAE in percent of the motion range."""
        return 100.0 * self.mae_um / self.range_um

    @staticmethod
    def of(
        model: str,
        method: str,
        y_um: FloatArray,
        model_um: FloatArray,
        dt_s: float,
        evaluations: int,
        converged: bool,
        notes: tuple[str, ...] = (),
    ) -> FitReport:
        """Errors (2.43), (2.44) of ``model_um`` against ``y_um``, both (n,) µm."""
        error = y_um - model_um
        return FitReport(
            model=model,
            method=method,
            samples=int(y_um.size),
            dt_s=dt_s,
            range_um=float(np.ptp(y_um)),
            rmse_um=float(np.sqrt(np.mean(error**2))),
            mae_um=float(np.mean(np.abs(error))),
            max_um=float(np.max(np.abs(error))),
            evaluations=evaluations,
            converged=converged,
            domain=Domain.of(y_um, dt_s),
            notes=notes,
        )


# --- Argument checks: each returns the checked value as float64 and raises InputError naming the argument otherwise.


def positive(field: str, value: float, unit: str) -> float:
    """A finite number above zero."""
    number = float(value)
    if not (np.isfinite(number) and number > 0.0):
        raise InputError(f"{field}: got {value!r}, expected a finite number above 0 {unit}")
    return number


def finite_series(field: str, values: ArrayLike, minimum: int = 1) -> FloatArray:
    """A contiguous array (n,) of at least ``minimum`` finite values."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size < minimum:
        raise InputError(f"{field}: got shape {array.shape}, expected (n,) with n >= {minimum}; record for longer")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise InputError(
            f"{field}: {bad.size} of {array.size} values are not finite (first at index {bad[0]}); cut or repair them"
        )
    return array


def checked_recording(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, minimum: int
) -> tuple[FloatArray, FloatArray, float]:
    """(u_V, y_um, dt_s) fit for identification: equal lengths of at least ``minimum``, finite, neither constant."""
    u = finite_series("u_V", u_V, minimum)
    y, dt = finite_series("y_um", y_um, minimum), positive("dt_s", dt_s, "s")
    if u.size != y.size:
        raise InputError(f"y_um: got {y.size} values, expected as many as of u_V, {u.size}; pair them by time")
    for field, column in (("u_V", u), ("y_um", y)):
        if float(np.ptp(column)) == 0.0:
            raise InputError(f"{field}: got a constant column, expected a moving one; excite the stage over its range")
    return u, y, dt


# --- The served inverse.


@dataclass(frozen=True)
class BaselineInverse(ABC):
    """Inverse of an identified stage; implements ``adaptive.types.InverseModel``. A model derives from it.

    ``voltage_std_V`` is one standard deviation of the voltage, from the residual of the identification; NaN: unknown.
    """

    parameters: Any
    dt_s: Annotated[float, Entry("sample time", "s")]
    domain: Annotated[Domain, Entry("motion of the identification", name="")]
    voltage_std_V: Annotated[float, Entry("standard deviation of the voltage", "V", finite=False)] = math.nan
    name: Annotated[str, Entry("by which it is served", most=1000)] = ""

    def __post_init__(self) -> None:
        positive("dt_s", self.dt_s, "s")
        std_V = float(self.voltage_std_V)
        if not (math.isnan(std_V) or 0.0 <= std_V < math.inf):
            raise InputError(
                f"voltage_std_V: got {std_V}, expected a finite number of at least 0 V, or NaN for unknown"
            )

    @classmethod
    def of(cls, parameters: Any, report: FitReport, u_V: ArrayLike, serve_dt_s: float | None) -> tuple[Self, FitReport]:
        """The inverse of ``parameters``, and their ``report``. u_V : voltages of the recording. serve_dt_s : sample
        time of the queries, s; None: that of the recording. The deviation is the RMSE divided by the mean slope.
        """
        std_V = report.rmse_um * float(np.ptp(np.asarray(u_V, dtype=np.float64))) / report.range_um
        return cls(parameters, serve_dt_s or report.dt_s, report.domain, std_V), report

    # ---- what a model has of its own

    @property
    @abstractmethod
    def memory_size(self) -> int:
        """Number of values in a memory."""

    @abstractmethod
    def _run(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray, u_V: FloatArray,
        inside: BoolArray,
    ) -> None:  # fmt: skip
        """Write voltages and domain flags of (n,) points; ``memory`` is advanced in place."""

    @abstractmethod
    def _drive(self, u_V: FloatArray, memory: FloatArray) -> None:
        """Advance ``memory`` in place by (n,) applied voltages; values that are not finite are skipped."""

    def _start(self) -> FloatArray:
        """(m,) memory at rest at 0 V."""
        return np.zeros(self.memory_size)

    # ---- the inverse model

    def rest_memory(self, y_um: float) -> FloatArray:
        """(m,) memory after a monotone motion from rest at 0 V to ``y_um`` µm."""
        y, rest = np.array([float(y_um)]), np.zeros(1)
        return self.feedforward(y, rest, rest, self._start()).memory

    def feedforward(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, memory: FloatArray
    ) -> Feedforward:
        """Voltages (n,) V for points (n,). Raises InputError on bad shapes."""
        y, v, a = _columns(y_um=y_um, v_um_per_s=v_um_per_s, a_um_per_s2=a_um_per_s2)
        after = self._checked(memory)
        u, inside = np.empty(y.size), np.empty(y.size, dtype=np.bool_)
        self._run(y, v, a, after, u, inside)
        return Feedforward(u, np.full(y.size, self.voltage_std_V), inside, after)

    def track(
        self, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray, u_V: FloatArray, memory: FloatArray
    ) -> FloatArray:
        """(m,) memory after the voltages ``u_V`` (n,) were applied: they alone drive it, and carry no sensor noise.

        Values that are not finite are skipped. Raises InputError on bad shapes.
        """
        *_, u = _columns(y_um=y_um, v_um_per_s=v_um_per_s, a_um_per_s2=a_um_per_s2, u_V=u_V)
        after = self._checked(memory)
        self._drive(u, after)
        return after

    def carry(self, y_um: FloatArray, u_V: FloatArray, memory: FloatArray) -> None:
        """``track`` in place and without checks; ``u_V`` (n,) V is contiguous."""
        self._drive(u_V, memory)

    def _checked(self, memory: FloatArray) -> FloatArray:
        """A copy of a caller's memory, (m,) and finite."""
        copy, size = np.array(memory, dtype=np.float64), self.memory_size
        if copy.shape != (size,):
            raise InputError(
                f"memory: got shape {copy.shape}, expected ({size},); send the memory of this model's last reply"
            )
        if size and not all_finite(copy):
            raise InputError(f"memory: got {copy.tolist()}, expected finite values; start from rest_memory")
        return copy

    def state_dict(self) -> StateDict:
        """Flat numbers and vectors by name."""
        return save(self)

    @classmethod
    def from_state(cls, state: StateDict) -> Self:
        """Inverse of ``state_dict``. Raises ModelFileError where a field is missing or wrong."""
        return load(cls, state)


def _columns(**given: FloatArray) -> list[FloatArray]:
    """The columns of a query as contiguous arrays (n,) of one length."""
    arrays = [np.ascontiguousarray(values, dtype=np.float64) for values in given.values()]
    for name, array in zip(given, arrays, strict=True):
        if array.ndim != 1 or array.shape != arrays[0].shape:
            n = arrays[0].size if arrays[0].ndim == 1 else "n"
            raise InputError(f"{name}: got shape {array.shape}, expected ({n},); pass flat columns, a value a point")
    return arrays
