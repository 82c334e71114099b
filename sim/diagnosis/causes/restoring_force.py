"""Hysteresis in the restoring force of a linear stage's mode, as the Bouc-Wen equation has it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.measured import At, Setting, Slot
from sim.diagnosis.model.restoring_force import Loop, Restoring


@dataclass(frozen=True)
class RestoringLoop(Form):
    """(2.2) with the displacement for the voltage, as a force beside the spring of the nominal stage's mode.

    Only beside a stage without a loop of its own: a second one in the mechanics would be no other cause.
    """

    name: str = "hysteresis_shape"
    variant: str = "restoring_loop"

    def applies(self, setting: Setting) -> str:
        return "" if setting.input_is_linear else "a nominal stage without hysteresis"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        # A loop that levels off nowhere, or at once, is a spring or a friction.
        return float(p[0]) > 0.02 and 0.1 < math.exp(float(p[1])) * setting.range_um < 250.0

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        r = setting.range_um
        return (
            Slot("share", "1", 0.0, 0.0, 30.0, 0.05, At.DYNAMICS),
            Slot("log_beta", "1", math.log(4.0 / r), math.log(0.05 / r), math.log(300.0 / r), 0.1, At.DYNAMICS),
            Slot("gamma_by_beta", "1", 0.0, -4.0, 0.95, 0.1, At.DYNAMICS),
        )

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        return [[np.array([0.1, math.log(reach / setting.range_um), 0.0])] for reach in (1.0, 4.0, 16.0, 60.0)]

    def together(self, nominal: FloatArray, names: tuple[str, ...], setting: Setting) -> list[FloatArray]:
        """The loop takes over a part of the spring: what a linear calibration found is the stiffness of both."""
        if "log_f0" not in names:
            return []
        gain, f0 = names.index("gain_um_per_V"), names.index("log_f0")
        out = []
        for share in (0.3, 1.0, 3.0):
            for reach in (1.0, 4.0, 16.0, 60.0):
                # The wider the motion, the less of the loop is felt as stiffness.
                felt = 1.0 + share * (0.9 if reach < 2.0 else 0.6)
                p = nominal.copy()
                p[gain] *= felt
                p[f0] -= 0.5 * math.log(felt)
                out.append(np.concatenate([p, [share, math.log(reach / setting.range_um), 0.0]]))
        return out

    def restoring(self, p: FloatArray, setting: Setting) -> Restoring | None:
        if p[0] == 0.0:
            return None
        beta = math.exp(float(p[1]))
        return Loop(float(p[0]), beta * (1.0 + float(p[2])), beta * (1.0 - float(p[2])))

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """Stiffness beside the spring's, and both rates of the loop; gamma with the sign of (2.2)."""
        beta = math.exp(float(p[1]))
        share, own, gamma = np.zeros(3), np.zeros(3), np.zeros(3)
        share[0] = 1.0
        own[1] = beta
        gamma[1:] = beta * float(p[2]), beta
        return {
            "stiffness_share": (float(p[0]), share),
            "beta_per_um": (beta, own),
            "gamma_per_um": (beta * float(p[2]), gamma),
        }
