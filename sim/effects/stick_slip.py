"""Stick-slip: friction in the guidance holds the displacement until the pull exceeds it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, InLibrary, Kind, Parameter, Place, block
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.hysteresis_loops import plays_nested
from dehyst.sim.fitting.stage_model import CauseModel, Guess

# Its step in the simulation.


@block
def run_stick_slip(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: half-width µm, share still stuck. s: where it sticks µm, 1 while slipping."""
    for k in range(n):
        away = x[k] - s[0]
        # sliding ends when the pull no longer exceeds sliding friction
        if s[1] * away <= p[0] * p[1]:
            s[1] = 0.0
        # it sticks until the pull exceeds static friction, then jumps and slides
        if s[1] == 0.0 and abs(away) > p[0]:
            s[1] = 1.0 if away > 0.0 else -1.0
        if s[1] != 0.0:
            s[0] = x[k] - s[1] * p[0] * p[1]
        x[k] = s[0]


# Its form in a diagnosis.


@compiled
def friction(x: FloatArray, width: float, share: float) -> FloatArray:
    """Friction: the output sticks after each reversal until x is ``width`` away, then follows ``share * width`` behind.

    share = 1 is a play of radius ``width``; below 1, the output jumps when it breaks free.
    """
    n = x.shape[0]
    out = np.empty(n)
    s = x[0]
    slide = share * width
    direction = 0.0
    for k in range(n):
        gap = x[k] - s
        if direction > 0.0 and gap >= slide:
            s = x[k] - slide
        elif direction < 0.0 and -gap >= slide:
            s = x[k] + slide
        else:
            direction = 0.0
            if gap > width:
                s = x[k] - slide
                direction = 1.0
            elif -gap > width:
                s = x[k] + slide
                direction = -1.0
        out[k] = s
    return out


#: Distances at which eighths of the contact break free where they do so gradually, relative to their mean: the middles
#: of eighths of an exponential distribution.
_BREAKS = -np.log1p(-(np.arange(8) + 0.5) / 8.0)
_BREAKS = _BREAKS / _BREAKS.mean()


@dataclass(frozen=True)
class StickSlip(CauseModel):
    """Friction, see `friction`: the stage sticks after each reversal, then slides behind by a share of the width.

    ``variant`` "gradual": the contact breaks free in parts, so the stage begins to slide before it has moved by the
    width (presliding): parallel plays of the motion; ``gradual_share`` spreads their radii.
    """

    def plausible(self, p: FloatArray, data: FitData) -> bool:
        return 1e-5 * data.range_um < float(p[0]) < 0.0099 * data.range_um

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        r = data.range_um
        second = "gradual_share" if self.variant else "sliding_share"
        return (
            ModelParameter("width_um", "µm", 0.0, 0.0, 0.01 * r, 1e-4 * r, ActsOn.MOTION),
            ModelParameter(second, "1", 1.0, 0.0, 1.0, 0.1, ActsOn.MOTION),
        )

    def guesses(self, data: FitData, residual_um: FloatArray) -> list[Guess]:
        r = data.range_um
        return [[np.array([w * r, share])] for w in (1e-4, 2.5e-4, 5e-4, 1e-3, 3e-3) for share in (1.0, 0.6, 0.2)]

    def refined(self, p: FloatArray, left_floors: float, data: FitData) -> tuple[CauseModel, list[FloatArray]] | None:
        if left_floors <= 1.1 or self.variant:
            return None
        return replace(self, variant="gradual"), [np.array([p[0] * p[1], share]) for share in (0.3, 1.0)]

    def motion(self, x_um: FloatArray, p: FloatArray, data: FitData) -> FloatArray:
        if p[0] <= 0.0:
            return x_um
        if not self.variant:
            return np.asarray(friction(x_um, float(p[0]), float(p[1])))
        radii_um = float(p[0]) * (1.0 + float(p[1]) * (_BREAKS - 1.0))
        equal = np.full(radii_um.size, 1.0 / radii_um.size)
        return np.asarray(x_um[0] + plays_nested(x_um - x_um[0], radii_um, equal))


def in_library(form: CauseModel, p: FloatArray, data: FitData) -> InLibrary | None:
    v = {name: value for name, (value, _) in form.reported(p, data).items()}
    effect = STICK_SLIP.clipped(width_um=v["width_um"], sliding_share=v.get("sliding_share", 1.0))
    return InLibrary((effect,), refit=bool(form.variant))


STICK_SLIP = Kind(
    name="stick_slip",
    place=Place.FRICTION,
    parameters=(
        Parameter("width_um", "µm", 0.0, 5.0, 0.03, "half-width of the flat part after a reversal"),
        Parameter("sliding_share", "1", 0.0, 1.0, 0.5, "sliding friction as a share of static friction; 1: no jump"),
    ),
    derive=lambda values, context: (values["width_um"], values["sliding_share"]),
    rest=lambda values, context: (0.0, 0.0),
    block=run_stick_slip,
    signature="flat after each reversal, then a jump; constant width at all amplitudes",
    mistaken_for=("hysteresis_shape", "quantisation"),
    tells_apart="the loop of piezoelectric hysteresis shrinks with the amplitude",
    source="about 0 in flexures, tens of nm in loose ones (common knowledge of the field)",
    cause=Cause(
        forms=(StickSlip(),),
        in_library=in_library,
        picture=pictures.after_reversals,
    ),
)
