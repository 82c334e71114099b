"""What every identification asks of a recording, and what it reports back."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

from adaptive.errors import InputError
from adaptive.finite import all_finite
from adaptive.types import FloatArray, StateDict


def positive(field: str, value: float, unit: str) -> float:
    """``value`` as a float; raises InputError unless it is finite and above zero."""
    number = float(value)
    if not (np.isfinite(number) and number > 0.0):
        raise InputError(f"{field}: got {value!r}, expected a finite number above 0 {unit}")
    return number


def deviation(field: str, value: float, unit: str) -> float:
    """``value`` as a float; raises InputError unless it is a finite number of at least 0, or NaN for none."""
    number = float(value)
    if not (np.isnan(number) or 0.0 <= number < np.inf):
        raise InputError(f"{field}: got {value!r}, expected a finite number of at least 0 {unit}, or NaN for none")
    return number


def series(field: str, values: ArrayLike, minimum: int = 1) -> FloatArray:
    """``values`` as a contiguous (n,) array of finite doubles; raises InputError naming ``field`` otherwise."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size < minimum:
        raise InputError(f"{field}: got shape {array.shape}, expected (n,) with n >= {minimum}; record for longer")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise InputError(
            f"{field}: {bad.size} of {array.size} values are not finite (first at index {bad[0]}); cut or repair them"
        )
    return array


def record(u_V: ArrayLike, y_um: ArrayLike, dt_s: float, minimum: int) -> tuple[FloatArray, FloatArray, float]:
    """Check a recording for identification: equal lengths, finite, long enough, and neither column constant."""
    u, y, dt = series("u_V", u_V, minimum), series("y_um", y_um, minimum), positive("dt_s", dt_s, "s")
    if u.size != y.size:
        raise InputError(f"y_um: got {y.size} values for {u.size} of u_V, expected as many; pair them by time")
    for field, column in (("u_V", u), ("y_um", y)):
        if float(np.ptp(column)) == 0.0:
            raise InputError(f"{field}: got a constant column, expected a moving one; excite the stage over its range")
    return u, y, dt


@dataclass(frozen=True, slots=True)
class Domain:
    """The range of motion seen in identification: displacement µm, speed µm/s."""

    y_min_um: float
    y_max_um: float
    v_max_um_per_s: float

    @staticmethod
    def of(y_um: FloatArray, dt_s: float) -> Domain:
        """Range of a recording; the speed is the largest central difference over two samples."""
        speed = np.abs(y_um[2:] - y_um[:-2]) / (2.0 * dt_s)
        return Domain(float(y_um.min()), float(y_um.max()), float(speed.max()))


@dataclass(frozen=True, slots=True)
class IdentificationReport:
    """How well a model fits the recording it was identified on.

    ``rmse_um``, ``mae_um``, ``max_um`` are of the forward model run freely over the whole recording, with its
    state started as said by the method. ``converged`` is False where the optimiser stopped at its limit.
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
        """RMSE in percent of the motion range, as the tables give it."""
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
    ) -> IdentificationReport:
        """Errors (2.43), (2.44) of ``model_um`` against ``y_um``, both (n,) µm."""
        error = y_um - model_um
        return IdentificationReport(
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


# --- What the inverse models share: checking the points of a query, and building models from stored states.


def same_length(name: str, values: FloatArray, n: int) -> FloatArray:
    """``values`` as contiguous doubles (n,); raises InputError on another shape."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1 or array.shape[0] != n:
        raise InputError(f"{name}: got shape {array.shape}, expected ({n},), as many as y_um; pass one value a point")
    return array


def points(
    y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The three inputs of a trajectory as contiguous doubles of one length; raises InputError on bad shapes."""
    y = np.ascontiguousarray(y_um, dtype=np.float64)
    if y.ndim != 1:
        raise InputError(f"y_um: got shape {y.shape}, expected (n,); pass a flat trajectory")
    n = y.shape[0]
    return y, same_length("v_um_per_s", v_um_per_s, n), same_length("a_um_per_s2", a_um_per_s2, n)


def memory_copy(memory: FloatArray, size: int) -> FloatArray:
    """A copy of a caller's memory vector; raises InputError unless it is (size,) and finite."""
    copy = np.array(memory, dtype=np.float64)
    if copy.shape != (size,):
        raise InputError(
            f"memory: got shape {copy.shape}, expected ({size},); bring back the memory that this model's reply carried"
        )
    if size and not all_finite(copy):
        raise InputError(f"memory: got {copy.tolist()}, expected finite values; start from rest_memory")
    return copy


def model_state(dt_s: float, std_V: float, domain: Domain) -> StateDict:
    """The fields that every baseline stores."""
    return {"dt_s": dt_s, "voltage_std_V": std_V, **asdict(domain)}


def model_fields(name: str, state: StateDict) -> tuple[float, float, Domain]:
    """``dt_s``, ``voltage_std_V`` and the domain from a stored state; raises InputError where one is missing."""
    try:
        domain = Domain(float(state["y_min_um"]), float(state["y_max_um"]), float(state["v_max_um_per_s"]))
        return float(state["dt_s"]), float(state["voltage_std_V"]), domain
    except KeyError as missing:
        raise InputError(f"{missing.args[0]}: missing in the state of a {name} model; write the model anew") from None
