"""payload_change: a mode that is known beforehand has moved, or moves in the middle of the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.measured import At, Setting, Slot


def loaded(system: Dynamics, ratio: float) -> Dynamics:
    """The system whose lightly damped mode of the nominal stage carries ``ratio`` of its own mass more.

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
class PayloadChange(Form):
    """A payload: the known mode lies at f0 sqrt(m/(m+M)). Negative where a payload was taken off.

    ``variant`` "": throughout the recording, against a frequency that a stage file states; "midway": from a moment in
    the recording on, which the nominal stage's own mode cannot imitate.
    """

    name: str = "payload_change"
    fast: bool = True

    def applies(self, setting: Setting) -> str:
        if self.variant == "midway":
            return "" if setting.has_mode else "a nominal stage with a mode"
        return "" if setting.known_modes_hz else "a nominal stage whose mode is known beforehand"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        if self.variant == "midway" and not 0.02 < p[1] / setting.duration_s < 0.98:
            return False
        return abs(float(p[0])) > 0.02

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        ratio = Slot("payload_ratio", "1", 0.0, -0.6, 8.0, 0.02, At.DYNAMICS)
        if self.variant != "midway":
            return (ratio,)
        t = setting.duration_s
        return (ratio, Slot("change_s", "s", 0.5 * t, 0.0, t, 0.01 * t, At.DYNAMICS))

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        ratios = (-0.3, -0.15, -0.06, 0.06, 0.15, 0.3, 0.6, 1.0, 2.0)
        if self.variant != "midway":
            return [[np.array([r])] for r in ratios]
        t = setting.duration_s
        return [[np.array([r, share * t])] for r in (-0.3, -0.1, 0.1, 0.3, 1.0) for share in (0.25, 0.5, 0.75)]

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system if self.variant == "midway" else loaded(system, float(p[0]))

    def later(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        if self.variant != "midway" or p[0] == 0.0:
            return None
        other = loaded(system, float(p[0]))
        # A mode that is damped out has no frequency that could be seen to move.
        return None if other.modes_hz == system.modes_hz else (float(p[1]), other)
