"""Saturation: the amplifier limits the voltage to its rails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: lowest, highest voltage, V."""
    for k in range(n):
        x[k] = min(max(x[k], p[0]), p[1])


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["low_V"], values["high_V"]


KIND = Kind(
    name="saturation",
    place=Place.RAILS,
    parameters=(
        Parameter("low_V", "V", -1000.0, 0.0, -3.0, "lower rail, at the command's scale"),
        Parameter("high_V", "V", 0.1, 1000.0, 12.0, "upper rail, at the command's scale"),
    ),
    derive=derive,
    block=run,
    signature="flat tops at the same voltage at every rate",
    mistaken_for=("slew_limit",),
    tells_apart="a sensor that ends is told apart by a monitor of the voltage",
    source="-30 to 130 V at the actuator behind a tenfold amplifier (E-503 class data sheet range)",
)
