"""What the inverse models share: checking the points of a query, and building models from stored states."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from adaptive.errors import InputError
from adaptive.finite import all_finite
from adaptive.types import FloatArray, StateDict
from baselines.records import Domain


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
