"""White noise of the sensor, before the lag of its electronics."""

from __future__ import annotations

from typing import Any

from dehyst.sim.effects.base import Kind, Parameter, Place, block
from dehyst.sim.effects.counter_noise import normal


@block
def run_sensor_noise(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: standard deviation µm, seed."""
    if p[0] > 0.0:
        for k in range(n):
            x[k] += p[0] * normal(p[1], k0 + k)


SENSOR_NOISE = Kind(
    name="sensor_noise",
    place=Place.NOISE,
    parameters=(Parameter("rms_um", "µm", 0.0, 10.0, 0.005, "standard deviation before any lag of the electronics"),),
    derive=lambda values, context: (values["rms_um"], float(context.seed)),
    block=run_sensor_noise,
    signature="white, the same at rest and in motion",
    source="about 5 nm rms at full bandwidth for a 100 µm capacitive sensor",
)
