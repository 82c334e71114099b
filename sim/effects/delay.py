"""A pure delay between the motion and its reading."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Kind, Parameter, Place, block, same_numbers
from dehyst.sim.effects.sampled_lags import lags_of_response
from dehyst.sim.fitting.dynamics import Dynamics
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess, single_guesses
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


LONGEST_S = 0.005


def _delay_slots(context: Context) -> int:
    return math.ceil(LONGEST_S / context.dt_s) + 2


@block
def run_delay(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: slots, whole samples, fraction. s: newest slot (-1: not begun), then a ring of past values, µm."""
    slots, whole = int(p[0]), int(p[1])
    for k in range(n):
        if s[0] < 0.0:  # start at rest
            for j in range(slots):
                s[1 + j] = x[k]
        newest = (int(s[0]) + 1) % slots
        s[0] = newest
        s[1 + newest] = x[k]
        late = s[1 + (newest - whole + slots) % slots]
        later = s[1 + (newest - whole - 1 + 2 * slots) % slots]
        x[k] = late + p[2] * (later - late)


def derive_delay(values: Mapping[str, float], context: Context) -> Sequence[float]:
    samples = values["delay_s"] / context.dt_s
    whole = math.floor(samples)
    return float(_delay_slots(context)), float(whole), samples - whole


# Its form in a diagnosis.


@dataclass(frozen=True)
class Delay(CauseModel):
    """A dead time of more than the one sample of the recorder."""

    unseen_is_absent: bool = True
    fast: bool = True
    pins: tuple[str, ...] = ("latch_samples",)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        dt = data.dt_s
        return (ModelParameter("tau_s", "s", dt, dt, max(0.01, 20.0 * dt), 0.1 * dt, ActsOn.DYNAMICS),)

    def unresolved(self, data: FitData) -> dict[str, float]:
        # A voltage that runs straight to the next sample in place of being held moves it by so much.
        return {"tau_s": 0.5 * data.dt_s}

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([f * data.dt_s for f in (1.3, 1.8, 2.5, 3.2, 4.0, 5.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, delay_s=float(p[0]))


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """Phase in proportion to frequency. A latency of up to one sample belongs to the recorder."""
    found = readings.once(lags_of_response)
    return Sight(None, found.missing) if found.missing else Sight(found.late, found.late_words)


DELAY = Kind(
    name="delay",
    place=Place.DELAY,
    parameters=(
        Parameter("delay_s", "s", 0.0, LONGEST_S, 5e-4, "delay; between samples the motion is a straight line"),
    ),
    derive=derive_delay,
    rest=lambda values, context: [-1.0] + [0.0] * _delay_slots(context),
    block=run_delay,
    signature="phase in proportion to the frequency at gain 1",
    mistaken_for=("amplifier_lag", "sensor_lag", "hysteresis_shape"),
    tells_apart="a lag also loses gain; the loop of a hysteresis persists as the frequency goes to zero",
    source="0.1 to 2 ms of converters and buses (common knowledge of the field)",
    cause=Cause(
        sign="a straight part of the phase over frequency, beyond a sample",
        forms=(Delay(),),
        tests=(seen,),
        in_library=same_numbers("delay", delay_s="tau_s"),
        picture=pictures.after_steps,
    ),
)
