"""First-order lag of the amplifier that drives the actuator's capacitance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Kind, Parameter, Place, block, same_numbers
from dehyst.sim.effects.holds import first_order
from dehyst.sim.effects.sampled_lags import FurtherLag, second_lag
from dehyst.sim.fitting.fit_data import ActsOn, FitData
from dehyst.sim.fitting.lags import lag_ends

# Its step in the simulation.


@block
def run_amplifier_lag(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: pole, weight of the held command. s: output, V."""
    for k in range(n):
        s[0] = p[0] * s[0] + p[1] * x[k]
        x[k] = s[0]


def derive_amplifier_lag(values: Mapping[str, float], context: Context) -> Sequence[float]:
    # the input is the held level of the converter; later effects take the output's shape from Context.hold_per_s
    a, _, b = first_order(values["tau_s"], context.dt_s, float("inf"))
    return a, b


def hold_of_later_effects(values: Mapping[str, float], context: Context) -> Context:
    tau_s = values["tau_s"]
    return replace(context, hold_per_s=min(context.hold_per_s, 1.0 / tau_s)) if tau_s > 0.0 else context


# Its form in a diagnosis.


@dataclass(frozen=True)
class AmplifierLag(FurtherLag):
    """First-order lag of the voltage before the hysteresis."""

    at: ActsOn = ActsOn.DRIVE
    substeps: int = 4
    continuous: bool = True

    def drive(self, u_V: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        ratio = p[0] / data.dt_s
        return lag_ends(u_V, max(ratio, 1e-3), data.straight)


AMPLIFIER_LAG = Kind(
    name="amplifier_lag",
    place=Place.AMPLIFIER,
    parameters=(Parameter("tau_s", "s", 0.0, 5e-3, 6.4e-5, "time constant; corner frequency 1/(2 pi tau)"),),
    derive=derive_amplifier_lag,
    rest=lambda values, context: (0.0,),
    block=run_amplifier_lag,
    shares=hold_of_later_effects,
    signature="small-signal roll-off of first order, the same at every amplitude",
    mistaken_for=("sensor_lag", "delay"),
    tells_apart="a monitor of the voltage; a delay loses no gain",
    source="RC of amplifier and actuator, corners of 1 to 6 kHz (common knowledge of the field); default 2.5 kHz",
    cause=Cause(
        sign="a lag beside the stage's own in phase and gain of the response, with what happens within a sample",
        forms=(AmplifierLag(),),
        tests=(second_lag,),
        in_library=same_numbers("amplifier_lag", tau_s="tau_s"),
        picture=pictures.after_steps,
    ),
)
