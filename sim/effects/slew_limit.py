"""Slew limit: the actuator is a capacitor, so the amplifier's current limit I limits the voltage rate to I/C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: largest change per sample, V. s: output, V."""
    for k in range(n):
        s[0] += min(max(x[k] - s[0], -p[0]), p[0])
        x[k] = s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return (values["rate_V_per_s"] * context.dt_s,)


KIND = Kind(
    name="slew_limit",
    place=Place.SLEW,
    parameters=(Parameter("rate_V_per_s", "V/s", 10.0, 1e6, 2000.0, "largest rate, at the command's scale"),),
    derive=derive,
    rest=lambda values, context: (0.0,),
    block=run,
    signature="triangle-like output, only above a rate; straight ramps after steps",
    mistaken_for=("saturation", "amplifier_lag"),
    tells_apart="saturation depends on the level, a lag does not depend on the amplitude",
    source="about 20 V/ms at the actuator, that is 2 V/ms at the command of a tenfold amplifier (field knowledge)",
)
