"""A/D converter: readings on a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: step µm (0: none)."""
    if p[0] > 0.0:
        for k in range(n):
            x[k] = p[0] * round(x[k] / p[0])


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return (values["step_um"],)


KIND = Kind(
    name="quantisation",
    place=Place.ADC,
    parameters=(Parameter("step_um", "µm", 0.0, 10.0, 100.0 / 65536, "step of the grid; 0: none"),),
    derive=derive,
    block=run,
    signature="few distinct levels, dead patches at low rate",
    mistaken_for=("stick_slip",),
    tells_apart="the levels lie on one grid everywhere",
    source="16 bit over 100 µm: 1.5 nm",
)
