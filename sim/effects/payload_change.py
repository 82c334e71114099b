"""A payload on the stage: the known mode moves to ``f0 sqrt(m/(m+M))``, the DC gain does not.

In the simulation it multiplies the mass of `resonance` and `mechanics` in the same chain; a chain without either is
refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim import pictures
from dehyst.sim.effects.base import Cause, Context, Kind, Parameter, Place, same_numbers
from dehyst.sim.fitting.dynamics import Dynamics, first_ringing
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.stage_model import CauseModel, Guess
from dehyst.sim.readings.ringing import SIGMAS, ringing
from dehyst.sim.readings.sight import Sight

if TYPE_CHECKING:
    from dehyst.sim.readings.readings import Readings

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
    at = first_ringing(system.modes_hz)
    if at is None:
        return system
    f_hz, damping = modes[at]
    modes[at] = (f_hz * slower, damping * slower)
    return replace(system, modes_hz=tuple(modes))


def _ratio(known_hz: float, now_hz: float) -> float:
    """The payload, relative to the moving mass, that moves the mode from ``known_hz`` to ``now_hz``."""
    return (known_hz / now_hz) ** 2 - 1.0


@dataclass(frozen=True)
class PayloadChange(CauseModel):
    """A payload M: the known mode lies at f0 sqrt(m/(m+M)). Negative if a payload was removed.

    ``variant`` "": throughout the recording, against a frequency that a stage file states; "midway": from a moment in
    the recording on, which the nominal stage's own mode cannot imitate.
    """

    fast: bool = True
    takes_over: bool = True
    shown_by_a_drive: bool = False
    #: Calibration may move the stated frequency, and a payload throughout does the same: the frequency stays as stated.
    pins: tuple[str, ...] = ("log_f_ringing_share",)

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

    def joint_starts(self, nominal: FloatArray, names: tuple[str, ...], data: FitData) -> list[FloatArray]:
        """The stage as its file states it, since calibration has bent it to the moved mode, with the payload that the
        frequency of its ringing shows."""
        found = ringing(data)
        if found is None or not found.f_hz.size:
            return []
        stated = np.array(
            [0.0 if n.startswith("log_") else 1.0 if "." in n else p for n, p in zip(names, nominal, strict=True)]
        )
        if self.variant != "midway":
            return [np.append(stated, _ratio(data.known_modes_hz[0], found.level().f_hz))]
        change = found.change()
        if change is None:
            return []
        k, before, after = change
        middle_s = 0.5 * (found.begin_s + found.end_s)
        ratio = _ratio(before.f_hz, after.f_hz)
        return [np.append(stated, (ratio, t)) for t in np.linspace(middle_s[k - 1], middle_s[k], 9)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system if self.variant == "midway" else loaded(system, float(p[0]))

    def changed_dynamics(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        if self.variant != "midway" or p[0] == 0.0:
            return None
        other = loaded(system, float(p[0]))
        # A mode that is damped out has no frequency that could be seen to move.
        return None if other.modes_hz == system.modes_hz else (float(p[1]), other)


# Its signature in the readings.


def seen(readings: Readings) -> Sight:
    """The stage rings at another frequency than the one that is known, or at another one from some moment on."""
    found = ringing(readings.data)
    if found is None:
        return Sight(None, "no stage file states the mode")
    if not found.f_hz.size:
        return Sight(None, "the mode does not ring long enough to tell its frequency")
    known_hz = readings.data.known_modes_hz[0]
    count, change = found.f_hz.size, found.change()
    if change is not None:
        k, before, after = change
        words = (
            f"the stage rings at {before.f_hz:.4g} ± {1.96 * before.error_hz:.1g} Hz until {found.end_s[k - 1]:.3g} s, "
            f"and at {after.f_hz:.4g} ± {1.96 * after.error_hz:.1g} Hz from {found.begin_s[k]:.3g} s on"
        )
        return Sight(True, words)
    level = found.level()
    words = f"in {count} stretches the stage rings at {level.f_hz:.4g} ± {1.96 * level.error_hz:.1g} Hz"
    words += f" where {known_hz:.4g} Hz is stated"
    apart = abs(level.f_hz - known_hz)
    if apart > max(SIGMAS * level.error_hz, 0.01 * known_hz):
        return Sight(True, words)
    # Two stretches in each half must show the mode: in the others a payload might have been put on.
    half_s = 0.5 * readings.data.duration_s
    throughout = min(int(np.sum(found.end_s < half_s)), int(np.sum(found.begin_s > half_s))) >= 2
    return Sight(False if throughout and level.error_hz < 2e-3 * known_hz else None, words)


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
        sign="the stage rings at another frequency than the known mode, or at another one from some moment on",
        tests=(seen,),
        forms=(PayloadChange(), PayloadChange(variant="midway", pins=())),
        in_library=same_numbers("payload_change", payload_ratio="payload_ratio"),
        picture=pictures.frequency_response,
    ),
)
