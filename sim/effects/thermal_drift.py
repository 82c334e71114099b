"""Additive slow drift: a relaxation towards another temperature, a steady ramp, and a random walk."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.counter_noise import normal


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: offset, amplitude, dt/tau, ramp per sample, step of the walk, seed. s: walk, µm."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] += p[0] - p[1] * math.expm1(-p[2] * index) + p[3] * index + s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_um_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_um_per_min"] * dt / 60.0
    return values["offset_um"], values["amplitude_um"], dt / values["tau_s"], ramp, walk, float(context.seed)


KIND = Kind(
    name="thermal_drift",
    place=Place.DRIFT,
    parameters=(
        Parameter("amplitude_um", "µm", -20.0, 20.0, 0.5, "total way of the relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "its time constant"),
        Parameter("ramp_um_per_min", "µm/min", -10.0, 10.0, 0.0, "steady drift"),
        Parameter("walk_um_per_sqrt_min", "µm/√min", 0.0, 1.0, 0.0, "random walk, standard deviation after a minute"),
        Parameter("offset_um", "µm", -1e3, 1e3, 0.0, "constant offset"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0,),
    block=run,
    signature="also there at zero input; follows the temperature where that is logged",
    mistaken_for=("creep", "gain_drift"),
    tells_apart="it does not follow the steps, creep does",
    source="up to 1 µm per kelvin and 50 mm of aluminium (expansion 23e-6 per kelvin)",
)
