"""Gain drift ``y = (1 + g(t)) H[u]``, from ageing, temperature or a change in the amplifier."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.counter_noise import normal


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain, ramp per sample, amplitude, dt/tau, step of the walk, seed. s: walk."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] *= 1.0 + p[0] + p[1] * index - p[2] * math.expm1(-p[3] * index) + s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_per_min"] * dt / 60.0
    return values["gain"], ramp, values["amplitude"], dt / values["tau_s"], walk, float(context.seed)


KIND = Kind(
    name="gain_drift",
    place=Place.GAIN,
    parameters=(
        Parameter("gain", "1", -0.5, 0.5, 0.0, "constant relative change of the gain"),
        Parameter("ramp_per_min", "1/min", -0.2, 0.2, 0.01, "steady relative change"),
        Parameter("amplitude", "1", -0.5, 0.5, 0.0, "relative change by relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "time constant of the relaxation"),
        Parameter("walk_per_sqrt_min", "1/√min", 0.0, 0.05, 0.0, "random walk, standard deviation after a minute"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0,),
    block=run,
    signature="residual in proportion to the displacement, the slope changes over time",
    mistaken_for=("creep", "thermal_drift"),
    tells_apart="gain drift by temperature needs a log of the temperature",
    source="0.05 to 0.3 % per kelvin (common knowledge of the field)",
)
