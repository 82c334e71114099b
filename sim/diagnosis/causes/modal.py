"""Causes that are several modes side by side: a structure's resonances, and cross-talk that has modes of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics
from sim.diagnosis.model.fit import Fit
from sim.diagnosis.model.forms import Form, Trial
from sim.diagnosis.model.measured import At, Setting, Slot
from sim.diagnosis.model.modal import Mode, modal_response, modal_slots, peaks

#: Most modes that one cause may have.
MOST = 10


@dataclass(frozen=True)
class Modes(Form):
    """Modes beside the nominal stage, found in the residual's spectrum anew each time.

    Only beside a nominal stage without a loop: what a loop leaves is no structure's answer to the voltage.
    """

    variant: str = "modes"
    found: tuple[Mode, ...] = ()

    def applies(self, setting: Setting) -> str:
        return "" if self.found and setting.input_is_linear else "modes that stand out of a linear stage's residual"

    def plausible(self, p: FloatArray, setting: Setting) -> bool:
        return bool(np.any(np.exp(p.reshape(-1, 4)[:, 1]) < 0.2))

    def size(self, setting: Setting) -> float:
        """Natural scale of a share."""
        return 0.2

    def at(self) -> At:
        return At.DYNAMICS

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        return modal_slots(setting, len(self.found), self.size(setting), self.at())

    def trials(self, setting: Setting, residual_um: FloatArray) -> list[Trial]:
        if not self.found:
            return []
        p = np.concatenate([[math.log(m.f_hz), math.log(m.damping), m.share, m.rate] for m in self.found])
        return [[p]]

    def driving(self, fit: Fit) -> FloatArray | None:
        """What drives these modes, (n,), or None where it was not recorded."""
        return fit.signals.static_um[:: fit.model.substeps]

    def sought(self, fit: Fit) -> Modes:
        """The same cause with the modes that this residual shows."""
        setting = fit.model.setting
        x = self.driving(fit)
        if x is None or not setting.input_is_linear:
            return replace(self, found=())
        return replace(self, found=tuple(peaks(x, fit.residual_um, setting.dt_s, MOST)))

    def beside(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, setting: Setting, system: Dynamics
    ) -> FloatArray | None:
        return modal_response(static_um, p, setting, system)

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """Frequency and damping of the strongest mode, then of the others by frequency."""
        rows = p.reshape(-1, 4)
        f, z = np.exp(rows[:, 0]), np.exp(rows[:, 1])
        height = np.hypot(rows[:, 2], rows[:, 3]) / z
        order = [int(np.argmax(height))]
        order += [int(i) for i in np.argsort(f) if int(i) != order[0]]
        out: dict[str, tuple[float, FloatArray]] = {}
        for rank, i in enumerate(order):
            one, two = np.zeros(p.size), np.zeros(p.size)
            one[4 * i], two[4 * i + 1] = f[i], z[i]
            tail = "" if rank == 0 else f"_{rank + 1}"
            out[f"f0{tail}_hz"] = (float(f[i]), one)
            out[f"damping{tail}"] = (float(z[i]), two)
        return out


@dataclass(frozen=True)
class StructureModes(Modes):
    """Resonances of a structure, driven by what the actuator does."""

    name: str = "resonance"
    fast: bool = True


@dataclass(frozen=True)
class CrossModes(Modes):
    """The other axes' drives, heard through modes of their own."""

    name: str = "cross_talk"
    #: By mode: which of the other drives it answers.
    heard: tuple[int, ...] = ()

    def at(self) -> At:
        return At.MOTION

    def size(self, setting: Setting) -> float:
        swings = [float(np.ptp(u)) for u in _others(setting)]
        return 0.2 * setting.range_um / max(*swings, 1e-9) if swings else 1.0

    def sought(self, fit: Fit) -> Modes:
        setting = fit.model.setting
        if not setting.input_is_linear:
            return replace(self, found=(), heard=())
        found: list[Mode] = []
        heard: list[int] = []
        for which, u in enumerate(_others(setting)):
            more = peaks(u, fit.residual_um, setting.dt_s, MOST)
            found += more
            heard += [which] * len(more)
        return replace(self, found=tuple(found), heard=tuple(heard))

    def beside(
        self, drive_V: FloatArray, static_um: FloatArray, p: FloatArray, setting: Setting, system: Dynamics
    ) -> FloatArray | None:
        return None

    def motion(self, x_um: FloatArray, p: FloatArray, setting: Setting) -> FloatArray:
        out, rows = x_um, p.reshape(-1, 4)
        for which, u in enumerate(_others(setting)):
            mine = np.flatnonzero(np.array(self.heard) == which)
            if mine.size:
                out = out + modal_response(u, np.ascontiguousarray(rows[mine]), setting, Dynamics())
        return out

    def physical(self, p: FloatArray, setting: Setting) -> dict[str, tuple[float, FloatArray]]:
        """Static share as a part of this axis' own gain, then the modes."""
        row = np.zeros(p.size)
        row[2::4] = np.where(np.array(self.heard) == 0, 1.0 / setting.gain_um_per_V, 0.0)
        return {"static": (float(row @ p), row)} | super().physical(p, setting)


def _others(setting: Setting) -> list[FloatArray]:
    """Voltages of the other axes, as far as they were recorded."""
    return [u for u in (setting.u2_V, setting.u3_V) if u is not None]
