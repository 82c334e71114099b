"""First-order low-pass of the sensor electronics; it attenuates signal and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Kind, Parameter, Place, block, same_numbers
from dehyst.sim.effects.holds import first_order
from dehyst.sim.effects.sampled_lags import FurtherLag, second_lag
from dehyst.sim.fitting.dynamics import Dynamics

# Its step in the simulation.


@block
def run_sensor_lag(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: (a, b0, b1). s: output, input so far, µm; whether it has begun."""
    for k in range(n):
        now = x[k]
        if s[2] == 0.0:  # start settled
            s[0], s[1], s[2] = now, now, 1.0
        s[0] = p[0] * s[0] + p[1] * s[1] + p[2] * now
        s[1] = now
        x[k] = s[0]


def derive_sensor_lag(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the displacement is linear between samples
    return first_order(values["tau_s"], context.dt_s, 0.0)


# Its form in a diagnosis.


@dataclass(frozen=True)
class SensorLag(FurtherLag):
    """A first-order low-pass in the sensor's electronics."""

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, lags_s=(*system.lags_s, float(p[0]))) if p[0] > 1e-7 else system


SENSOR_LAG = Kind(
    name="sensor_lag",
    place=Place.SENSOR_LAG,
    parameters=(Parameter("tau_s", "s", 0.0, 0.01, 3e-4, "time constant"),),
    derive=derive_sensor_lag,
    rest=lambda values, context: (0.0, 0.0, 0.0),
    block=run_sensor_lag,
    signature="gain AND noise roll off",
    mistaken_for=("amplifier_lag", "delay"),
    tells_apart="a monitor of the voltage; the spectrum of the noise at rest",
    source="0.3 ms at a bandwidth setting of 1 kHz (sensor electronics data sheet)",
    cause=Cause(
        sign="a lag beside the stage's own in phase and gain of the response, with what happens within a sample",
        forms=(SensorLag(),),
        tests=(second_lag,),
        in_library=same_numbers("sensor_lag", tau_s="tau_s"),
        picture=pictures.after_steps,
        same_as=("amplifier_lag",),
    ),
)
