"""Branches without point symmetry: a one-sided dead zone (2.8) on the output of a play (2.4).

It is single-valued in the output of the play, but not in the voltage. Above the dead zone both the slope and the loop
of the stage change, below it neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slope, dead zone, threshold. s: play output, V."""
    for k in range(n):
        z = min(max(s[0], v[k] - p[2]), v[k] + p[2])
        s[0] = z
        x[k] += p[0] * max(z - p[1], 0.0)


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["slope_um_per_V"], values["dead_zone_V"], values["threshold_V"]


KIND = Kind(
    name="asymmetry",
    place=Place.HYSTERESIS,
    parameters=(
        Parameter("slope_um_per_V", "µm/V", -100.0, 100.0, 0.5, "slope added above the dead zone"),
        Parameter("dead_zone_V", "V", -200.0, 200.0, 4.0, "where the additional slope begins"),
        Parameter("threshold_V", "V", 0.0, 100.0, 1.0, "half-width of the play that the dead zone acts on"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0,),
    block=run,
    signature="the two branches are not point-symmetric; even harmonics",
    mistaken_for=("sensor_nonlinearity", "hysteresis_shape"),
    tells_apart="a sensor's polynomial is single-valued and the same in both directions",
    source="0.5 to 3 % of the stroke (common knowledge of the field); form of the MPI model (2.8)-(2.10)",
)
