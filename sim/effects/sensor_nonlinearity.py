"""Nonlinearity of the sensor: a single-valued polynomial of the displacement, zero at both ends of the range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: 1/range, square, cubic term in µm."""
    for k in range(n):
        q = x[k] * p[0]
        # q (1-q) has its extremum 1/4 at the middle; q (1-q)(1-2q) has sqrt(3)/18 at q = 0.21 and 0.79
        bow = q * (1.0 - q)
        x[k] += 4.0 * p[1] * bow + 10.392304845413264 * p[2] * bow * (1.0 - 2.0 * q)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    full = values["range_um"]
    return 1.0 / full, values["square"] * full, values["cubic"] * full


KIND = Kind(
    name="sensor_nonlinearity",
    place=Place.SENSOR_CURVE,
    parameters=(
        Parameter("square", "1", -0.02, 0.02, 0.0006, "largest error of the square term, relative to the range"),
        Parameter("cubic", "1", -0.02, 0.02, 0.0, "largest error of the cubic term, relative to the range"),
        Parameter("range_um", "µm", 0.1, 1e4, 100.0, "range of the sensor"),
    ),
    derive=derive,
    block=run,
    signature="the same error at the same displacement, at all rates and in both directions",
    mistaken_for=("asymmetry",),
    tells_apart="the curve of the actuator needs a second sensor to be told apart",
    source="0.03 to 0.1 % of the range (capacitive sensor data sheets)",
)
