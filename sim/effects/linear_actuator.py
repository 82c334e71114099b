"""An actuator without hysteresis: displacement in proportion to voltage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain, µm/V; offset, µm."""
    for k in range(n):
        x[k] = p[1] + p[0] * x[k]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["gain_um_per_V"], values["offset_um"]


KIND = Kind(
    name="linear_actuator",
    place=Place.ACTUATOR,
    parameters=(
        Parameter("gain_um_per_V", "µm/V", -1e4, 1e4, 11.35, "displacement per volt of command"),
        Parameter("offset_um", "µm", -1e4, 1e4, 0.0, "displacement at 0 V"),
    ),
    derive=derive,
    block=run,
    signature="a straight line",
    source="d of Table 2.1: 1.1351e-5 m/V",
    cause=False,
)
