"""Velocity and acceleration of a desired trajectory where the caller gives only displacement."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adaptive.types import FloatArray
from service.protocol.errors import FieldError
from service.protocol.samples import check_finite


def derivatives(
    y_um: FloatArray, v_um_per_s: ArrayLike | None, a_um_per_s2: ArrayLike | None, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """(v, a), each (n,), µm/s and µm/s², of ``y_um`` (n,) with points ``dt_s`` apart.

    What is given is kept; what is not is taken by central differences, one-sided and of second order at the ends.
    A single point rests. Raises InputError on other lengths and on what is not finite.
    """
    n = y_um.size
    check_finite("y_um", y_um)

    def given(field: str, values: ArrayLike | None, of: FloatArray) -> FloatArray:
        if values is None:
            if n == 1:
                return np.zeros(1)
            slope: FloatArray = np.gradient(of, dt_s, edge_order=2 if n > 2 else 1)
            return slope
        array = np.atleast_1d(np.asarray(values, dtype=np.float64))
        if array.shape != y_um.shape:
            raise FieldError(field, f"shape {array.shape}", f"{y_um.shape}, that of y_um")
        check_finite(field, array)
        return array

    v = given("v_um_per_s", v_um_per_s, y_um)
    return v, given("a_um_per_s2", a_um_per_s2, v)
