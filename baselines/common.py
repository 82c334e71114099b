"""What all baselines share: the report of a fit, argument checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray

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


def std_of_voltage(u_V: ArrayLike, report: FitReport) -> float:
    """Standard deviation of the voltage, V: the RMSE divided by the mean slope of the recording."""
    return report.rmse_um * float(np.ptp(np.asarray(u_V, dtype=np.float64))) / report.range_um


# --- Argument checks: each returns the checked value as float64 and raises InputError naming the argument otherwise.


def positive(field: str, value: float, unit: str) -> float:
    """A finite number above zero."""
    number = float(value)
    if not (np.isfinite(number) and number > 0.0):
        raise InputError(f"{field}: got {value!r}, expected a finite number above 0 {unit}")
    return number


def std_or_nan(field: str, value: float, unit: str) -> float:
    """A standard deviation: a finite number of at least 0, or NaN where it is unknown."""
    number = float(value)
    if not (np.isnan(number) or 0.0 <= number < np.inf):
        raise InputError(f"{field}: got {value!r}, expected a finite number of at least 0 {unit}, or NaN for unknown")
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


def of_length(name: str, values: FloatArray, n: int) -> FloatArray:
    """A contiguous array (n,)."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1 or array.shape[0] != n:
        raise InputError(f"{name}: got shape {array.shape}, expected ({n},), as many as y_um; pass one value per point")
    return array


def checked_motion(
    y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement, velocity and acceleration of a query as contiguous arrays (n,) of one length."""
    y = np.ascontiguousarray(y_um, dtype=np.float64)
    if y.ndim != 1:
        raise InputError(f"y_um: got shape {y.shape}, expected (n,); pass a flat trajectory")
    n = y.shape[0]
    return y, of_length("v_um_per_s", v_um_per_s, n), of_length("a_um_per_s2", a_um_per_s2, n)


def checked_memory(memory: FloatArray, size: int) -> FloatArray:
    """A copy of a caller's memory, (size,) and finite."""
    copy = np.array(memory, dtype=np.float64)
    if copy.shape != (size,):
        raise InputError(
            f"memory: got shape {copy.shape}, expected ({size},); send the memory of this model's last reply"
        )
    if size and not all_finite(copy):
        raise InputError(f"memory: got {copy.tolist()}, expected finite values; start from rest_memory")
    return copy
