"""A payload on the stage: the known mode moves to ``f0 sqrt(m/(m+M))``, the DC gain does not.

In the simulation it multiplies the mass of `resonance` and `mechanics` in the same chain; a chain without either is
refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim import pictures
from sim.effects.base import Cause, Context, InLibrary, Kind, Parameter, Place
from sim.fitting.dynamics import Dynamics
from sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from sim.fitting.stage_model import CauseModel, Guess

# Its step in the simulation: that of the modes, with more mass.


def mass_of_modes(values: Mapping[str, float], context: Context) -> Context:
    return replace(context, payload_ratio=context.payload_ratio + values["payload_ratio"])


# Its form in a diagnosis.


def loaded(system: Dynamics, ratio: float) -> Dynamics:
    """The system with ``ratio`` of its moving mass added to the first lightly damped mode.

    Spring and dashpot stay: f0 and damping ratio both fall by sqrt(1 + ratio), the DC gain does not change.
    """
    slower = 1.0 / math.sqrt(1.0 + ratio)
    modes = list(system.modes_hz)
    light = next((i for i, (_, damping) in enumerate(modes) if damping < 0.5), None)
    if light is None:
        return system
    f_hz, damping = modes[light]
    modes[light] = (f_hz * slower, damping * slower)
    return replace(system, modes_hz=tuple(modes))


@dataclass(frozen=True)
class PayloadChange(CauseModel):
    """A payload M: the known mode lies at f0 sqrt(m/(m+M)). Negative if a payload was removed.

    ``variant`` "": throughout the recording, against a frequency that a stage file states; "midway": from a moment in
    the recording on, which the nominal stage's own mode cannot imitate.
    """

    fast: bool = True
    shown_by_a_drive: bool = False

    def missing(self, data: FitData) -> str:
        if self.variant == "midway":
            return "" if data.has_mode else "a nominal stage with a mode"
        return "" if data.known_modes_hz else "a nominal stage whose mode is known beforehand"

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        if self.variant == "midway" and not 0.02 < p[1] / data.duration_s < 0.98:
            return False
        return abs(float(p[0])) > 0.02

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        ratio = ModelParameter("payload_ratio", "1", 0.0, -0.6, 8.0, 0.02, ActsOn.DYNAMICS)
        if self.variant != "midway":
            return (ratio,)
        t = data.duration_s
        return (ratio, ModelParameter("change_s", "s", 0.5 * t, 0.0, t, 0.01 * t, ActsOn.DYNAMICS))

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        ratios = (-0.3, -0.15, -0.06, 0.06, 0.15, 0.3, 0.6, 1.0, 2.0)
        if self.variant != "midway":
            return [[np.array([r])] for r in ratios]
        t = data.duration_s
        return [[np.array([r, share * t])] for r in (-0.3, -0.1, 0.1, 0.3, 1.0) for share in (0.25, 0.5, 0.75)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system if self.variant == "midway" else loaded(system, float(p[0]))

    def changed_dynamics(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        if self.variant != "midway" or p[0] == 0.0:
            return None
        other = loaded(system, float(p[0]))
        # A mode that is damped out has no frequency that could be seen to move.
        return None if other.modes_hz == system.modes_hz else (float(p[1]), other)


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    return InLibrary((PAYLOAD_CHANGE.clipped(payload_ratio=v["payload_ratio"]),))


PAYLOAD_CHANGE = Kind(
    name="payload_change",
    place=Place.MECHANICS,
    parameters=(Parameter("payload_ratio", "1", 0.0, 20.0, 1.0, "added mass relative to the moved mass"),),
    derive=lambda values, context: (),
    block=None,
    shares=mass_of_modes,
    needs=("resonance", "mechanics"),
    signature="the known mode moves, the DC gain does not",
    mistaken_for=("resonance",),
    tells_apart="a change of stiffness moves the DC gain too",
    source="-30 % of f0 when the mass doubles: f0 sqrt(m/(m+M))",
    cause=Cause(
        forms=(PayloadChange(), PayloadChange(variant="midway")),
        in_library=in_library,
        picture=pictures.frequency_response,
    ),
)
