"""Additive slow drift: a relaxation towards another temperature, a steady ramp, and a random walk."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.effects.counter_noise import normal
from dehyst.sim.effects.slow_change import SlowChange
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel
from dehyst.sim.readings.sight import Sight
from dehyst.sim.readings.slow_motion import USUAL, cycles_over_time, rests_over_time

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


@block
def run_thermal_drift(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: offset, amplitude, dt/tau, ramp per sample, step of the walk, seed. s: walk, µm."""
    for k in range(n):
        index = k0 + k
        if p[4] > 0.0:
            s[0] += p[4] * normal(p[5], index)
        x[k] += p[0] - p[1] * math.expm1(-p[2] * index) + p[3] * index + s[0]


def derive_thermal_drift(values: Mapping[str, float], context: Context) -> Sequence[float]:
    dt = context.dt_s
    walk = values["walk_um_per_sqrt_min"] * math.sqrt(dt / 60.0)
    ramp = values["ramp_um_per_min"] * dt / 60.0
    return values["offset_um"], values["amplitude_um"], dt / values["tau_s"], ramp, walk, float(context.seed)


# Its form in a diagnosis.


@dataclass(frozen=True)
class ThermalDrift(SlowChange):
    """A slow additive drift."""

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        if self.variant == "temperature":
            return (ModelParameter("um_per_K", "µm/K", 0.0, -0.2 * r, 0.2 * r, 1e-3 * r, ActsOn.MOTION),)
        return tuple(
            ModelParameter(f"drift{j + 1}_um", "µm", 0.0, -0.1 * r, 0.1 * r, 1e-3 * r, ActsOn.MOTION, True)
            for j in range(self.spans(data))
        )

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        fitted = self.agrees(readings.once(rests_over_time).shift, p, readings.data)
        return "" if fitted is None else f"the fit moves them by {fitted:.3g} µm"

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if self.variant == "temperature":
            return x_um if data.warmth_K is None else x_um + p[0] * data.warmth_K
        return x_um + self.course(p, data)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        if self.variant == "temperature":
            return super().reported(p, data)
        rate = np.zeros(p.size)
        rate[-1] = 1.0 / data.duration_s
        # A drift that comes back has no rate.
        most = np.zeros(p.size)
        most[int(np.argmax(np.abs(p)))] = 1.0
        return {"rate_um_per_s": (float(rate @ p), rate), "largest_um": (float(most @ p), most)}


#: Least share of the record that equal cycles cover whose means are the course of a drift.
_COVERED = 0.8


@dataclass(frozen=True)
class Wander(CauseModel):
    """A drift of any course: that of the means of equal cycles, in straight lines, times a share of about 1.

    A spline of a few knots does not follow a walk, and one of many says nothing of a stretch that is held out.
    """

    variant: str = "cycles"
    unseen_is_absent: bool = True
    imitates_others: bool = True
    of_one_recording: bool = True
    times_s: tuple[float, ...] = ()
    means_um: tuple[float, ...] = ()

    def shown(self, readings: Readings) -> Wander:
        times_s, means_um = readings.once(cycles_over_time).course
        covered = times_s.size > 0 and np.ptp(times_s) > _COVERED * readings.data.duration_s
        return replace(self, times_s=tuple(times_s), means_um=tuple(means_um - means_um[0])) if covered else self

    def missing(self, data: FitData) -> str:
        return "" if self.times_s else "equal cycles over most of the record"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 0.7 < float(p[0]) < 1.3

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        return (ModelParameter("share", "1", 0.0, 0.0, 2.0, 0.1, ActsOn.MOTION, True),)

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        course = data.derived((self.times_s, self.means_um), lambda: np.interp(data.t_s, self.times_s, self.means_um))
        return np.asarray(x_um + p[0] * course)

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        rate = np.array([self.means_um[-1] / data.duration_s])
        most = np.array([max(self.means_um, key=abs)])
        return {"rate_um_per_s": (float(rate @ p), rate), "largest_um": (float(most @ p), most)}

    def unresolved(self, data: FitData) -> dict[str, float]:
        # Before the first mean and behind the last one it may move as between two others.
        return {"rate_um_per_s": float(np.max(np.abs(np.diff(self.means_um)))) / data.duration_s}


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    ramp = 60.0 * form.reported(p, data)["rate_um_per_s"][0] if form.variant != "temperature" else 0.0
    start = THERMAL_DRIFT.clipped(amplitude_um=1e-3, tau_s=0.3 * data.duration_s, ramp_um_per_min=ramp)
    return InLibrary((start,), refit=True)


# Its signature in the readings.


def in_rests(readings: Readings) -> Sight:
    """The rests move with time, whatever the voltage."""
    found, data = readings.once(rests_over_time), readings.data
    if found.shift is None:
        return Sight(None, found.missing)
    v, e = found.shift.value, found.shift.error
    least = max(2.0 * readings.sigma_um, 1e-4 * data.range_um)
    words = f"the rests move by {v:.3g} ± {1.96 * e:.1g} µm {found.shift.when}"
    return Sight(found.shift.seen(abs(v), least, USUAL * data.range_um), words)


def in_cycles(readings: Readings) -> Sight:
    """The mean of equal cycles changes, and not clearly as creep. Where creep may do the same, both are one set."""
    found = readings.once(cycles_over_time)
    if found.missing:
        return Sight(None, found.missing)
    if found.goes_on:
        return Sight(True, found.mean_words, found.also)
    return Sight(None if found.creeps else found.moved, found.mean_words, ("creep",) if found.moved else ())


THERMAL_DRIFT = Kind(
    name="thermal_drift",
    place=Place.DRIFT,
    parameters=(
        Parameter("amplitude_um", "µm", -20.0, 20.0, 0.5, "total way of the relaxation"),
        Parameter("tau_s", "s", 1.0, 1e5, 300.0, "its time constant"),
        Parameter("ramp_um_per_min", "µm/min", -10.0, 10.0, 0.0, "steady drift"),
        Parameter("walk_um_per_sqrt_min", "µm/√min", 0.0, 1.0, 0.0, "random walk, standard deviation after a minute"),
        Parameter("offset_um", "µm", -1e3, 1e3, 0.0, "constant offset"),
    ),
    derive=derive_thermal_drift,
    rest=lambda values, context: (0.0,),
    block=run_thermal_drift,
    signature="also there at zero input; follows the temperature where that is logged",
    mistaken_for=("creep", "gain_drift"),
    tells_apart="it does not follow the steps, creep does",
    source="up to 1 µm per kelvin and 50 mm of aluminium (expansion 23e-6 per kelvin)",
    cause=Cause(
        sign="the rests move with time whatever the voltage; or the mean of equal cycles goes with time, settles "
        "exponentially, or wanders",
        forms=(ThermalDrift(), Wander(), ThermalDrift(variant="temperature", of_one_recording=False)),
        tests=(in_rests, in_cycles),
        in_library=in_library,
        picture=pictures.slowly,
    ),
)
