"""The form of a cause that a fit can move: where it enters the signal's way, its numbers, its first guesses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics
from sim.diagnosis.model.measured import Setting, Slot
from sim.diagnosis.model.restoring_force import Restoring

#: Vectors whose simulated differences from the neutral span one linearised guess, and whether they may be scaled.
Trial = list[FloatArray]


@dataclass(frozen=True)
class Form:
    """A cause, neutral in every hook that it does not override. ``variant`` tells forms of one name apart."""

    name: str = ""
    variant: str = ""
    #: Slots of the nominal stage that would mean the same number twice, and stand still while this form is in.
    pins: tuple[str, ...] = ()
    #: Sub-steps of a sample at which drive and loop are simulated while this form is in.
    substeps: int = 1
    #: What it makes of the drive has no jumps: from one sub-step to the next it runs in a straight line.
    continuous: bool = False
    #: Acts within a few samples of a step, where the hold between two samples would have been chosen to imitate it.
    fast: bool = False
    #: Its numbers belong to one recording and say nothing of another (a drift over time, a hum's phase).
    of_one_recording: bool = False
    #: Share (rms) of what it removes that its fitted form may leave behind in a real stage: no form is exact.
    form_error: float = 0.025

    def applies(self, setting: Setting) -> str:
        """Empty where the recording could show this cause at all, else what is missing."""
        return ""

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        raise NotImplementedError

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        """Guesses. The default for a linear form: one trial with a unit of every number."""
        slots = self.slots(setting)
        neutral = np.array([s.neutral for s in slots])
        rows = []
        for i, slot in enumerate(slots):
            row = neutral.copy()
            row[i] += slot.step
            rows.append(row)
        return [rows]

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        """Whether the fitted numbers are of a size and a sign that this cause has."""
        return True

    def drive(self, u_V: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return u_V

    def static(
        self, u_V: FloatArray, h_um: FloatArray, w_um: FloatArray, p: FloatArray, nominal: FloatArray, setting: Setting
    ) -> FloatArray | None:
        """What is added to the static displacement, (n,), or None."""
        return None

    def dynamics(self, system: Dynamics, p: FloatArray) -> Dynamics:
        return system

    def later(self, system: Dynamics, p: FloatArray) -> tuple[float, Dynamics] | None:
        """A moment (s) from which the linear part is another, and that other one; None where it stays."""
        return None

    def beside(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, setting: Setting, system: Dynamics
    ) -> FloatArray | None:
        """What moves beside the nominal mechanics, (n,), driven by the voltage or by the static displacement."""
        return None

    def restoring(self, p: FloatArray, setting: Setting) -> Restoring | None:
        """Hysteresis in the restoring force, or None."""
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return x_um

    def reading(self, y_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        return y_um

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """Reported numbers by name: value and its gradient by ``p`` (for the interval)."""
        out = {}
        for i, slot in enumerate(self.slots(setting)):
            gradient = np.zeros(p.size)
            gradient[i] = 1.0
            out[slot.name] = (float(p[i]), gradient)
        return out


def single(values: list[float]) -> list[Trial]:
    """Trials of a form of one number."""
    return [[np.array([v])] for v in values]
