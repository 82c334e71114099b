"""The stages that a recording is first compared with: the chapter's Bouc-Wen stage, or a linear one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics, respond
from sim.diagnosis.model.loops import bouc_wen_loop
from sim.diagnosis.model.measured import At, Setting, Slot


class Nominal(Protocol):
    """A stage with parameters of its own, which are calibrated before anything is called missing."""

    @property
    def name(self) -> str: ...
    @property
    def hold(self) -> str: ...
    @property
    def substeps(self) -> int:
        """Sub-steps of a sample at which drive and loop are simulated."""
        ...

    def with_other_hold(self) -> Nominal: ...
    def slots(self, setting: Setting) -> tuple[Slot, ...]: ...
    def starts(self, setting: Setting) -> list[FloatArray]: ...
    def static(self, drive_V: FloatArray, p: FloatArray, setting: Setting) -> tuple[FloatArray, FloatArray]:
        """Hysteresis h and static displacement w (µm, (n,) each) for the voltage at the actuator."""
        ...

    def dynamics(self, p: FloatArray, setting: Setting) -> Dynamics: ...
    def behind_um(self, x_um: FloatArray, setting: Setting) -> FloatArray:
        """What the stage itself makes of the displacement behind the mechanics, before the reading."""
        ...

    def offset_um(self, p: FloatArray) -> float: ...
    def start_um(self, p: FloatArray) -> float:
        """How far from equilibrium with its first voltage the stage was at rest when the record began."""
        ...


def common_slots(setting: Setting) -> tuple[Slot, Slot]:
    """A free sensor offset, and a latch up to one sample early or late: recorders differ in both."""
    span = 4.0 * setting.range_um + abs(setting.middle_um)
    return (
        Slot("offset_um", "µm", 0.0, -span, span, 0.1 * setting.range_um, At.READING),
        Slot("latch_samples", "1", 0.0, -1.0, 1.0, 0.1, At.DYNAMICS),
    )


def loop_numbers(p: FloatArray) -> tuple[float, float, float]:
    """Slope alpha d (µm/V), beta and gamma (1/V) of a Bouc-Wen stage's parameters.

    beta - gamma is kept above -(beta + gamma): beyond, h runs away from any bounded voltage.
    """
    fall = max(float(p[3]), -0.95 * float(p[2]))
    return float(p[1] * p[0]), 0.5 * (float(p[2]) + fall), 0.5 * (float(p[2]) - fall)


@dataclass(frozen=True)
class BoucWen:
    """(2.1), (2.2) with n = 1. Only ratios show in (u, y): alpha, beta, gamma, d, b/k; m/k as in Table 2.1.

    With sqrt(k/m) = 3.55e4 rad/s the mass of Table 2.1 adds a pole 0.3 µs from the origin, which no recording
    shows; the stage is a lag of b/k = 2.5 ms after the loop. A mode below 10 kHz is therefore not a parameter of
    this stage but something that it lacks.
    """

    hold: str = "zero"
    name: str = "bouc_wen"
    #: The loop's memory at the first sample is free where the recording does not begin at rest at zero volts.
    free_memory: bool = False

    def with_other_hold(self) -> BoucWen:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        # Along a straight way between two samples h bends; under a held voltage it jumps, and needs no more steps.
        return 4 if self.hold == "first" else 1

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        g = max(abs(setting.gain_um_per_V), 1e-9)
        v = max(setting.swing_V, 1e-9)
        offset, latch = common_slots(setting)
        own = (
            Slot("d_um_per_V", "µm/V", g, 0.2 * g, 5.0 * g, 0.1 * g, At.STATIC),
            Slot("alpha", "1", 0.4754, 0.0, 1.5, 0.1, At.STATIC),
            Slot("rise_per_V", "1/V", 14.6 / v, 0.3 / v, 80.0 / v, 1.5 / v, At.STATIC),  # beta + gamma
            Slot("fall_per_V", "1/V", -0.9 / v, -20.0 / v, 40.0 / v, 1.5 / v, At.STATIC),  # beta - gamma
            Slot("tau_s", "s", 2.5268e-3, 2.0e-6, 4e-3, 2.5e-4, At.DYNAMICS),
            offset,
            latch,
        )
        if not self.free_memory:
            return own
        r = setting.range_um
        start = Slot("start_um", "µm", 0.0, -2.0 * r, 2.0 * r, 0.05 * r, At.DYNAMICS)
        return (*own, Slot("h0", "1", 0.0, -1.0, 1.0, 0.1, At.STATIC), start)

    def starts(self, setting: Setting) -> list[FloatArray]:
        first = np.array([s.neutral for s in self.slots(setting)])
        first[5] = (
            setting.y_um[0]
            if not self.free_memory
            else setting.middle_um - first[0] * 0.5 * (setting.u_high_V + setting.u_low_V)
        )
        wide = first.copy()
        wide[2] *= 0.3
        wide[3] = 0.0
        return [first, wide]

    def static(self, drive_V: FloatArray, p: FloatArray, setting: Setting) -> tuple[FloatArray, FloatArray]:
        slope, beta, gamma = loop_numbers(p)
        h0 = p[7] * slope / p[2] if self.free_memory else 0.0
        h = bouc_wen_loop(drive_V, slope, beta, gamma, h0)
        return h, p[0] * drive_V - h

    def dynamics(self, p: FloatArray, setting: Setting) -> Dynamics:
        return Dynamics((float(p[4]),), (), float(p[6]) * setting.dt_s, self.hold)

    def behind_um(self, x_um: FloatArray, setting: Setting) -> FloatArray:
        return x_um

    def offset_um(self, p: FloatArray) -> float:
        return float(p[5])

    def start_um(self, p: FloatArray) -> float:
        return float(p[8]) if self.free_memory else 0.0


@dataclass(frozen=True)
class Linear:
    """y = gain u through one mode or, overdamped, two lags: what a linear identification would have given."""

    hold: str = "zero"
    name: str = "linear"

    def with_other_hold(self) -> Linear:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        return 1

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        # Across a resonance the slope of the readings over the voltage says little about the gain.
        g = max(abs(setting.gain_um_per_V), setting.range_um / max(setting.swing_V, 1e-12), 1e-9)
        offset, latch = common_slots(setting)
        return (
            Slot("gain_um_per_V", "µm/V", setting.gain_um_per_V, -20.0 * g, 20.0 * g, 0.1 * g, At.STATIC),
            Slot(
                "log_f0",
                "1",
                np.log(0.1 / setting.dt_s),
                np.log(1e-3 / setting.dt_s),
                np.log(4.0 / setting.dt_s),
                0.05,
                At.DYNAMICS,
            ),
            Slot("log_damping", "1", 0.0, np.log(1e-3), np.log(300.0), 0.1, At.DYNAMICS),
            offset,
            latch,
        )

    def starts(self, setting: Setting) -> list[FloatArray]:
        """The best of a grid of modes, each with the gain and offset that suit it best."""
        neutral = np.array([s.neutral for s in self.slots(setting)])
        n = min(setting.n, 20_000)
        u, y = np.ascontiguousarray(setting.u_V[:n]), setting.y_um[:n]
        found: list[tuple[float, FloatArray]] = []
        for f_hz in np.geomspace(2e-3, 1.0, 110) / setting.dt_s:
            for damping in (0.01, 0.03, 0.1, 0.4, 1.0, 6.0):
                x = respond(u, Dynamics((), ((float(f_hz), damping),), 0.0, self.hold), setting.dt_s)
                d = x - x.mean()
                power = float(d @ d)
                if not np.isfinite(power) or power <= 0.0:
                    continue
                gain = float(d @ y) / power
                offset = float(y.mean() - gain * x.mean())
                p = neutral.copy()
                p[:4] = gain, np.log(f_hz), np.log(damping), offset
                found.append((float(np.sum(np.square(y - gain * x - offset))), p))
        found.sort(key=lambda item: item[0])
        return [p for _, p in found[:3]]

    def static(self, drive_V: FloatArray, p: FloatArray, setting: Setting) -> tuple[FloatArray, FloatArray]:
        return np.zeros_like(drive_V), p[0] * drive_V

    def dynamics(self, p: FloatArray, setting: Setting) -> Dynamics:
        mode = (float(np.exp(p[1])), float(np.exp(p[2])))
        return Dynamics((), (mode,), float(p[4]) * setting.dt_s, self.hold)

    def behind_um(self, x_um: FloatArray, setting: Setting) -> FloatArray:
        return x_um

    def offset_um(self, p: FloatArray) -> float:
        return float(p[3])

    def start_um(self, p: FloatArray) -> float:
        return 0.0
