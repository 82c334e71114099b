"""Nonlinearity of the sensor: a single-valued polynomial of the displacement, zero at both ends of the range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel
from dehyst.sim.readings.cycles import mirrored_branches

# Its step in the simulation.


@block
def run_sensor_nonlinearity(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: 1/range, square, cubic term in µm."""
    for k in range(n):
        q = x[k] * p[0]
        # q (1-q) has its extremum 1/4 at the middle; q (1-q)(1-2q) has sqrt(3)/18 at q = 0.21 and 0.79
        bow = q * (1.0 - q)
        x[k] += 4.0 * p[1] * bow + 10.392304845413264 * p[2] * bow * (1.0 - 2.0 * q)


def derive_sensor_nonlinearity(values: Mapping[str, float], context: Context) -> Sequence[float]:
    full = values["range_um"]
    return 1.0 / full, values["square"] * full, values["cubic"] * full


# Its form in a diagnosis.


@dataclass(frozen=True)
class SensorNonlinearity(CauseModel):
    """A static curve of the sensor: a polynomial of second to fourth order, at most 0.4 % of the range."""

    test_answers_to_others: bool = True

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return bool(np.max(np.abs(p)) < 0.99 * 0.008)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return tuple(ModelParameter(f"order{j}", "1", 0.0, -0.008, 0.008, 5e-4, ActsOn.READING) for j in (2, 3, 4))

    def reading(self, y_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        half = 0.5 * data.range_um
        x = (y_um - data.centre_um) / half
        # Near-orthogonal polynomials: the share of each order can be read on its own.
        x2 = x * x
        bend = p[0] * (x2 - 1.0) + x * (p[1] * (x2 - 1.0)) + p[2] * (x2 * x2 - x2)
        return np.asarray(y_um + half * bend)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        out = {}
        for i, name in enumerate(("quadratic", "cubic", "quartic")):
            row = np.zeros(p.size)
            row[i] = 0.5
            out[name] = (0.5 * float(p[i]), row)
        return out


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    start = SENSOR_NONLINEARITY.clipped(square=v["quadratic"], cubic=v["cubic"], range_um=data.range_um)
    return InLibrary((start,), refit=True)


SENSOR_NONLINEARITY = Kind(
    name="sensor_nonlinearity",
    place=Place.SENSOR_CURVE,
    parameters=(
        Parameter("square", "1", -0.02, 0.02, 0.0006, "largest error of the square term, relative to the range"),
        Parameter("cubic", "1", -0.02, 0.02, 0.0, "largest error of the cubic term, relative to the range"),
        Parameter("range_um", "µm", 0.1, 1e4, 100.0, "range of the sensor"),
    ),
    derive=derive_sensor_nonlinearity,
    block=run_sensor_nonlinearity,
    signature="the same error at the same displacement, at all rates and in both directions",
    mistaken_for=("asymmetry",),
    tells_apart="the curve of the actuator needs a second sensor to be told apart",
    source="0.03 to 0.1 % of the range (capacitive sensor data sheets)",
    cause=Cause(
        sign="the mean of both branches, mirrored, is curved, in cycles of one height",
        forms=(SensorNonlinearity(),),
        tests=(mirrored_branches,),
        in_library=in_library,
        picture=pictures.over_reading,
        same_as=("asymmetry",),
    ),
)
