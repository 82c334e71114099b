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


#: Frequencies, relative to the known mode, between which a payload may have moved it, and how near two peaks may lie.
_LOWEST, _HIGHEST, _NEAR = 0.4, 1.6, 0.015
_PEAKS = 3


def _ratios_that_ring(data: FitData) -> list[float]:
    """Payload ratios that move the known mode to the highest peaks in the spectrum of the readings' differences.

    A mode that is hardly damped answers in a band of its damping: steps of the ratio would miss it.
    """
    from scipy.signal import welch  # a simulated stage does not wait for it

    if not data.known_modes_hz:
        return []
    f_hz, power = welch(np.diff(data.y_um), 1.0 / data.dt_s, nperseg=min(data.n - 1, round(4.0 / data.dt_s)))
    share = f_hz / data.known_modes_hz[0]
    open_ = (share > _LOWEST) & (share < _HIGHEST) & (np.abs(share - 1.0) > _NEAR)
    out: list[float] = []
    while open_.any() and len(out) < _PEAKS:
        peak = share[open_][np.argmax(power[open_])]
        out.append(float(peak**-2.0 - 1.0))
        open_ &= np.abs(share - peak) > _NEAR * peak
    return out


@dataclass(frozen=True)
class PayloadChange(CauseModel):
    """A payload M: the known mode lies at f0 sqrt(m/(m+M)). Negative if a payload was removed.

    ``variant`` "": throughout the recording, against a frequency that a stage file states; "midway": from a moment in
    the recording on, which the nominal stage's own mode cannot imitate.
    """

    fast: bool = True
    takes_over: bool = True
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

    def joint_starts(self, nominal: FloatArray, names: tuple[str, ...], data: FitData) -> list[FloatArray]:
        """The numbers of the stage file, which the calibration has bent to the moved mode, and each mode that rings."""
        stated = np.array(
            [0.0 if n.startswith("log_") else 1.0 if "." in n else p for n, p in zip(names, nominal, strict=True)]
        )
        ringing = _ratios_that_ring(data)
        if self.variant != "midway":
            return [np.append(stated, r) for r in ringing]
        t = data.duration_s
        return [np.append(stated, (r, share * t)) for r in ringing for share in np.arange(0.1, 0.95, 0.1)]

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
