"""First-order low-pass of the sensor electronics; it attenuates signal and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block
from sim.effects.holds import first_order


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: (a, b0, b1). s: output, input so far, µm; whether it has begun."""
    for k in range(n):
        now = x[k]
        if s[2] == 0.0:  # start settled
            s[0], s[1], s[2] = now, now, 1.0
        s[0] = p[0] * s[0] + p[1] * s[1] + p[2] * now
        s[1] = now
        x[k] = s[0]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the displacement is linear between samples
    return first_order(values["tau_s"], context.dt_s, 0.0)


KIND = Kind(
    name="sensor_lag",
    place=Place.SENSOR_LAG,
    parameters=(Parameter("tau_s", "s", 0.0, 0.01, 3e-4, "time constant"),),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run,
    signature="gain AND noise roll off",
    mistaken_for=("amplifier_lag", "delay"),
    tells_apart="a monitor of the voltage; the spectrum of the noise at rest",
    source="0.3 ms at a bandwidth setting of 1 kHz (sensor electronics data sheet)",
)
