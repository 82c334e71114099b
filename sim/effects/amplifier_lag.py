"""First-order lag of the amplifier that drives the actuator's capacitance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import first_order


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: pole, weight of the held command. s: output, V."""
    for k in range(n):
        s[0] = p[0] * s[0] + p[1] * x[k]
        x[k] = s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the input is the held level of the converter; later effects take the output's shape from Context.hold_per_s
    a, _, b = first_order(values["tau_s"], context.dt_s, float("inf"))
    return a, b


KIND = Kind(
    name="amplifier_lag",
    place=Place.AMPLIFIER,
    parameters=(Parameter("tau_s", "s", 0.0, 5e-3, 6.4e-5, "time constant; corner frequency 1/(2 pi tau)"),),
    derive=derive,
    rest=lambda values, context: (0.0,),
    block=run,
    signature="small-signal roll-off of first order, the same at every amplitude",
    mistaken_for=("sensor_lag", "delay"),
    tells_apart="a monitor of the voltage; a delay loses no gain",
    source="RC of amplifier and actuator, corners of 1 to 6 kHz (common knowledge of the field); default 2.5 kHz",
)
