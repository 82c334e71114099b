"""Gain drift ``y = (1 + g(t)) H[u]``, from ageing, temperature or a change in the amplifier."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.effects.counter_noise import normal
from dehyst.sim.effects.slow_change import SlowChange
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.sight import Sight
from dehyst.sim.readings.slow_motion import USUAL, cycles_over_time, rests_over_time

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_gain_drift(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: gain, ramp per sample, amplitude, dt/tau, step of the walk, seed. s: walk."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] *= 1.0 + p[0] + p[1] * index - p[2] * math.expm1(-p[3] * index) + s[0]


def derive_gain_drift(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_per_min"] * dt / 60.0
    return values["gain"], ramp, values["amplitude"], dt / values["tau_s"], walk, float(context.seed)


# Its form in a diagnosis.


@dataclass(frozen=True)
class GainDrift(SlowChange):
    """A slow change of the gain about a fixed displacement: the actuator's zero, or a sensor's, with any offset."""

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        if self.variant == "temperature":
            return (ModelParameter("gain_per_K", "1/K", 0.0, -0.05, 0.05, 1e-3, ActsOn.MOTION),)
        r = data.range_um
        return (
            ModelParameter("stays_um", "µm", 0.0, -3.0 * r, 3.0 * r, 0.1 * r, ActsOn.MOTION),
            *(
                ModelParameter(f"gain{j + 1}", "1", 0.0, -0.2, 0.2, 2e-3, ActsOn.MOTION, True)
                for j in range(self.spans(data))
            ),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        rows = super().guesses(data, residual_um)
        return rows if self.variant == "temperature" else [trial[1:] for trial in rows]

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        found = super().refined(p[1:], left_floors, data)
        return None if found is None else (found[0], [np.append(p[0], start) for start in found[1]])

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        fitted = self.agrees(readings.once(rests_over_time).gain, p[1:], readings.data)
        return "" if fitted is None else f"the fit by {100.0 * fitted:.3g} %"

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if self.variant == "temperature":
            return x_um if data.warmth_K is None else x_um * (1.0 + p[0] * data.warmth_K)
        return np.asarray(x_um + (x_um - p[0]) * self.course(p[1:], data))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().reported(p, data)
        last = np.zeros(p.size)
        last[-1] = 1.0
        return {
            "gain": (float(p[-1]), last),
            "rate_per_s": (float(p[-1]) / data.duration_s, last / data.duration_s),
        }


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    ramp = 60.0 * float(p[-1]) / data.duration_s if form.variant != "temperature" else 0.0
    start = GAIN_DRIFT.clipped(ramp_per_min=ramp, amplitude=1e-4, tau_s=0.3 * data.duration_s)
    return InLibrary((start,), refit=True)


# Its signature in the readings.


def in_rests(readings: Readings) -> Sight:
    """The rests move in proportion to their voltage."""
    found = readings.once(rests_over_time)
    if found.missing:
        return Sight(None, found.missing)
    if found.gain is None:
        return Sight(None, "all rests are at one voltage")
    v, e = found.gain.value, found.gain.error
    words = f"the rests move by {100.0 * v:.3g} ± {1.96 * 100.0 * e:.1g} % of the motion {found.gain.when}"
    return Sight(found.gain.seen(abs(v), 5e-4, USUAL), words)


def in_cycles(readings: Readings) -> Sight:
    """The height of equal cycles changes with time."""
    found = readings.once(cycles_over_time)
    if found.missing:
        return Sight(None, found.missing)
    # Creep settles with the logarithm of time, which is almost a straight line long after the start.
    return Sight(found.grew, found.height_words, found.also if found.grew else ())


GAIN_DRIFT = Kind(
    name="gain_drift",
    place=Place.GAIN,
    parameters=(
        Parameter("gain", "1", -0.5, 0.5, 0.0, "constant relative change of the gain"),
        Parameter("ramp_per_min", "1/min", -0.2, 0.2, 0.01, "steady relative change"),
        Parameter("amplitude", "1", -0.5, 0.5, 0.0, "relative change by relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "time constant of the relaxation"),
        Parameter("walk_per_sqrt_min", "1/√min", 0.0, 0.05, 0.0, "random walk, standard deviation after a minute"),
    ),
    derive=derive_gain_drift,
    rest=lambda values, context: (0.0,),
    block=run_gain_drift,
    signature="residual in proportion to the displacement, the slope changes over time",
    mistaken_for=("creep", "thermal_drift"),
    tells_apart="gain drift by temperature needs a log of the temperature",
    source="0.05 to 0.3 % per kelvin (common knowledge of the field)",
    cause=Cause(
        sign="the rests move in proportion to their voltage; or the height of equal cycles goes with time",
        forms=(GainDrift(), GainDrift(variant="temperature", of_one_recording=False)),
        tests=(in_rests, in_cycles),
        in_library=in_library,
        picture=pictures.gain_over_time,
    ),
)
