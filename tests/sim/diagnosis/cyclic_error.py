"""Cyclic error of a guide: the displacement ripples, once every ``pitch_um`` of the way.

No effect of the library. `test_new_cause` adds it to the catalogue: a whole cause in one file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight

# Its step in the simulation.


@block
def run_cyclic_error(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: sine and cosine part, µm; radians per µm."""
    for k in range(n):
        angle = p[2] * x[k]
        x[k] += p[0] * math.sin(angle) + p[1] * math.cos(angle)


# Its form in a diagnosis.


def _ripple(x_um: FloatArray, left_um: FloatArray, pitches_um: FloatArray) -> FloatArray:
    """(m,) amplitude, µm, of the ripple of ``left_um`` (n,) over ``x_um`` (n,) at each pitch, by correlation."""
    return np.array([2.0 * abs(np.mean(left_um * np.exp(-2j * np.pi * x_um / pitch))) for pitch in pitches_um])


def _pitches_um(data: FitData) -> FloatArray:
    """Pitches of which the stage passes three to fifty, a fifth of a turn over the range apart."""
    return data.range_um / np.arange(3.0, 50.0, 0.2)


@dataclass(frozen=True)
class CyclicError(CauseModel):
    """A sine and a cosine of the way, with the pitch."""

    unseen_is_absent: bool = True

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        pitches, top = _pitches_um(data), 0.01 * data.range_um
        turns = ModelParameter(
            "turns_per_um", "1/µm", 1.0 / pitches[0], 1.0 / pitches[0], 1.0 / pitches[-1], 0.02 / data.range_um,
            ActsOn.MOTION,
        )  # fmt: skip
        return (
            turns,
            *(ModelParameter(f"{w}_um", "µm", 0.0, -top, top, 0.01 * top, ActsOn.MOTION) for w in ("sin", "cos")),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        pitches, sine, cosine = _pitches_um(data), self.parameters(data)[1], self.parameters(data)[2]
        turns = 1.0 / float(pitches[int(np.argmax(_ripple(data.y_um, residual_um, pitches)))])
        return [[np.array([turns, sine.step, 0.0]), np.array([turns, 0.0, cosine.step])]]

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        angle = 2.0 * np.pi * p[0] * x_um
        return np.asarray(x_um + p[1] * np.sin(angle) + p[2] * np.cos(angle))

    def reported(self, p: FloatArray, data: FitData) -> dict[str, tuple[float, FloatArray]]:
        size = max(float(np.hypot(p[1], p[2])), 1e-15)
        pitch, amplitude = np.array([-1.0 / p[0] ** 2, 0.0, 0.0]), np.array([0.0, p[1] / size, p[2] / size])
        return {"pitch_um": (1.0 / float(p[0]), pitch), "amplitude_um": (size, amplitude)}


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    return InLibrary((CYCLIC_ERROR.clipped(sine_um=p[1], cosine_um=p[2], pitch_um=1.0 / p[0]),))


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """In motion, what a quasi-static description leaves ripples at one pitch, far above the pitches beside it."""
    data = readings.data
    moving = readings.mask & (data.rate_V_per_s > 0.0)
    pitches = _pitches_um(data)
    sizes = _ripple(data.y_um[moving], readings.left_um[moving], pitches)
    beside = np.array([np.median(sizes[np.abs(np.log(pitches / pitch)) < 0.4]) for pitch in pitches])
    best = int(np.argmax(sizes / beside))
    words = f"the readings ripple by {1e3 * sizes[best]:.3g} nm every {pitches[best]:.3g} µm"
    return Sight(bool(sizes[best] > 4.0 * beside[best]), words)


CYCLIC_ERROR = Kind(
    name="cyclic_error",
    place=Place.FRICTION,
    parameters=(
        Parameter("sine_um", "µm", -1.0, 1.0, 0.01, "sine part of the ripple"),
        Parameter("cosine_um", "µm", -1.0, 1.0, 0.0, "cosine part of the ripple"),
        Parameter("pitch_um", "µm", 0.1, 100.0, 5.0, "displacement from ripple to ripple"),
    ),
    derive=lambda values, context: (values["sine_um"], values["cosine_um"], 2.0 * math.pi / values["pitch_um"]),
    block=run_cyclic_error,
    signature="a ripple over the displacement, the same at every rate and in both directions",
    mistaken_for=("sensor_nonlinearity",),
    tells_apart="a polynomial has no pitch",
    source="made up for a test",
    cause=Cause(
        sign="the readings ripple with the displacement",
        forms=(CyclicError(),),
        tests=(seen,),
        in_library=in_library,
        picture=pictures.over_reading,
    ),
)
