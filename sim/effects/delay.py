"""A pure delay between the motion and its reading."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.effects.sampled_lags import has_response, lags_of_response
from dehyst.sim.fitting.dynamics import Dynamics
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess, ModelFit, single_guesses
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings


# Its step in the simulation.


LONGEST_S = 0.05


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
    #: Without a frequency response, a delay shows only its sum with the stage's own lag (`Late`).
    told: bool = True

    def missing(self, data: FitData) -> str:
        return "" if self.told else "a frequency response"

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        dt = data.dt_s
        return (ModelParameter("tau_s", "s", dt, dt, max(0.01, 20.0 * dt), 0.1 * dt, ActsOn.DYNAMICS),)

    def shown(self, readings: Readings) -> CauseModel:
        return replace(self, told=has_response(readings))

    def unresolved(self, data: FitData) -> dict[str, float]:
        # A voltage that runs straight to the next sample in place of being held moves it by so much.
        return {"tau_s": 0.5 * data.dt_s}

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([f * data.dt_s for f in (1.3, 1.8, 2.5, 3.2, 4.0, 5.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, delay_s=float(p[0]))


@dataclass(frozen=True)
class Late(CauseModel):
    """Readings that are later than the nominal stage may be: its latch stands at its upper bound.

    In motion too slow for a frequency response, lag, delay and the stage's own lag show only their sum. There its lag
    stands at its bound as well; lag and latch keep their neutral values, and ``tau_s`` is the lateness beside them.
    ``most_s``: lateness of a nominal stage at its bounds; 0 where it is not, and then nothing is later than it may be.
    """

    variant: str = "late"
    fast: bool = True
    widens: bool = True
    pins: tuple[str, ...] = ("tau_s", "latch_samples")
    most_s: float = 0.0

    def shown(self, readings: Readings) -> CauseModel:
        return replace(self, pins=("latch_samples",)) if has_response(readings) else self

    def missing(self, data: FitData) -> str:
        return "" if self.most_s else "a lateness that the nominal stage may not have"

    def found_again(self, fit: ModelFit, mask: BoolArray) -> CauseModel:
        if any(cause.name == self.name for cause in fit.model.causes):
            return self
        data = fit.model.data
        own = {s.name: (s, v) for s, v in zip(fit.model.parameters[: fit.model.n_nominal], fit.p, strict=False)}
        ends = [own[name] for name in self.pins if name in own]
        if len(ends) < len(self.pins) or any(value < s.high - 0.02 * s.step for s, value in ends):
            return replace(self, most_s=0.0)
        most_s = sum((value - s.neutral) * (1.0 if s.unit == "s" else data.dt_s) for s, value in ends)
        return replace(self, most_s=most_s)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        dt_s = data.dt_s
        return (ModelParameter("tau_s", "s", self.most_s, 0.0, max(0.05, 20.0 * dt_s), 0.1 * dt_s, ActsOn.DYNAMICS),)

    def agreement(self, p: FloatArray, readings: Readings) -> str:
        if p[0] < self.most_s + 0.15 * readings.data.dt_s:
            return ""
        return f"without it the stage's own lag stands at its bound, and the readings are {1e3 * p[0]:.3g} ms late"

    def also(self, data: FitData) -> tuple[str, ...]:
        return ("sensor_lag", "amplifier_lag")

    def unresolved(self, data: FitData) -> dict[str, float]:
        # A lag's readings are half a sample earlier than its time constant says.
        return {"tau_s": 0.5 * data.dt_s + self.own_s}

    @property
    def own_s(self) -> float:
        """Half of the lateness that may be the stage's own: all or nothing of it, where only the sum shows."""
        return 0.5 * self.most_s if len(self.pins) > 1 else 0.0

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        return {"tau_s": (float(p[0]) - self.own_s, np.ones(1))}

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        return single_guesses([self.most_s + f * data.dt_s for f in (0.3, 1.0, 2.0, 4.0)])

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return replace(system, delay_s=float(p[0]))


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    return InLibrary((DELAY.clipped(delay_s=float(p[0])),))


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
        forms=(Delay(), Late()),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.after_steps,
    ),
)
