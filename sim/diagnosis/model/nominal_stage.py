"""A stage file as the nominal stage: the library's own chain, its actuator calibrated within physical bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics
from sim.diagnosis.model.measured import At, Setting, Slot
from sim.diagnosis.model.nominal import common_slots
from sim.effects import Chain, Effect, effect, simulate
from sim.effects.base import Place
from sim.stage.config import StageConfig

#: Modes of one type of stage differ by about this much from piece to piece; more is a payload.
MODE_SPREAD = 0.015
#: Calibration may scale the other numbers of the actuator by as much either way.
SCALE = 2.0


@dataclass(frozen=True)
class StageNominal:
    """What a stage file says, in the stretches of a model: before the mechanics, its modes, and behind them.

    Numbers of the actuator that are not zero are calibrated as factors of the file's, between 1/2 and 2; the
    frequency of a lightly damped mode within `MODE_SPREAD`. What stands behind the mechanics is taken as it is; noise
    is left out, and so is what the file changes during a run.
    """

    before: Chain
    modes_hz: tuple[tuple[float, float], ...]
    behind: Chain
    calibrated: tuple[str, ...]
    hold: str = "zero"
    name: str = "stage"
    _unit: Chain = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_unit", Chain((effect("linear_actuator", gain_um_per_V=1.0), *self.behind)))

    def with_other_hold(self) -> StageNominal:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        return 4 if self.hold == "first" else 1

    @property
    def has_loop(self) -> bool:
        """Whether the actuator has hysteresis of its own."""
        return any(e.name not in ("linear_actuator", "dac", "creep", "amplifier_lag") for e in self.before)

    def slots(self, setting: Setting) -> tuple[Slot, ...]:
        span = 1.0 / SCALE
        own = [Slot(path, "1", 1.0, span, SCALE, 0.05, At.STATIC) for path in self.calibrated]
        modes: list[Slot] = []
        for i, (_, damping) in enumerate(self.modes_hz):
            spread = math.log1p(MODE_SPREAD) if damping < 1.0 else math.log(3.0)
            modes.append(Slot(f"log_f{i + 1}_share", "1", 0.0, -spread, spread, 0.01, At.DYNAMICS))
            if damping < 1.0:
                modes.append(Slot(f"log_z{i + 1}_share", "1", 0.0, -1.5, 1.5, 0.1, At.DYNAMICS))
        return (*own, *modes, *common_slots(setting))

    def starts(self, setting: Setting) -> list[FloatArray]:
        p = np.array([s.neutral for s in self.slots(setting)])
        p[-2] = setting.y_um[0]
        return [p]

    def effects(self, p: FloatArray) -> list[Effect]:
        """The file's effects with the calibrated numbers, modes as ``resonance``; the latch is no part of a stage."""
        modes = self.modes(p)
        mine = [
            effect("resonance", label=f"nominal_mode_{i + 1}", frequency_Hz=f, damping_ratio=min(max(z, 1e-3), 100.0))
            for i, (f, z) in enumerate(modes)
        ]
        return [*self.actuator(p), *mine, *self.behind]

    def actuator(self, p: FloatArray) -> Chain:
        """What stands before the mechanics, with the calibrated numbers."""
        values = self.before.parameters
        return self.before.replace(
            {
                path: float(np.clip(values[path] * p[i], *_range(self.before, path)))
                for i, path in enumerate(self.calibrated)
            }
        )

    def static(self, drive_V: FloatArray, p: FloatArray, setting: Setting) -> tuple[FloatArray, FloatArray]:
        # The reading at t_k does not depend on u_k: one sample later it shows what u_k has done.
        w = simulate(self.actuator(p), np.append(drive_V, drive_V[-1]), setting.dt_s)[1:]
        slope = float(np.ptp(w)) / max(float(np.ptp(drive_V)), 1e-12) * math.copysign(1.0, setting.gain_um_per_V)
        h = slope * (drive_V - drive_V[0]) - (w - w[0]) if self.has_loop else np.zeros_like(w)
        return np.ascontiguousarray(h), np.ascontiguousarray(w)

    def dynamics(self, p: FloatArray, setting: Setting) -> Dynamics:
        return Dynamics((), self.modes(p), float(p[-1]) * setting.dt_s, self.hold)

    def modes(self, p: FloatArray) -> tuple[tuple[float, float], ...]:
        """Frequency (Hz) and damping ratio of each mode, calibrated."""
        at, modes = len(self.calibrated), []
        for f_hz, damping in self.modes_hz:
            f = f_hz * math.exp(float(p[at]))
            light = damping < 1.0
            modes.append((f, damping * math.exp(float(p[at + 1])) if light else damping))
            at += 2 if light else 1
        return tuple(modes)

    def behind_um(self, x_um: FloatArray, setting: Setting) -> FloatArray:
        """What the file puts behind the mechanics: creep has been before, drift, cross-talk and sensor are here."""
        if not len(self.behind):
            return x_um
        later = np.append(x_um[1:], x_um[-1])
        return simulate(self._unit, later, setting.dt_s, other_um=setting.other_um)

    def offset_um(self, p: FloatArray) -> float:
        return float(p[-2])

    def start_um(self, p: FloatArray) -> float:
        return 0.0


def _range(chain: Chain, path: str) -> tuple[float, float]:
    label, _, name = path.rpartition(".")
    parameter = chain[label].kind.parameter(name)
    return parameter.low, parameter.high


def _mode(e: Effect, payload: float) -> tuple[float, float]:
    """Frequency (Hz) and damping ratio of one mechanical effect with its payloads."""
    v = e.values
    if e.name == "resonance":
        mass = (1.0 + v["payload_ratio"]) * (1.0 + payload)
        return v["frequency_Hz"] / math.sqrt(mass), v["damping_ratio"] / math.sqrt(mass)
    m = (v["mass_kg"] + v["payload_kg"]) * (1.0 + payload)
    b, k = v["damping_N_s_per_m"], v["stiffness_N_per_m"]
    return math.sqrt(k / m) / (2.0 * math.pi), b / (2.0 * math.sqrt(k * m))


def stage_nominal(config: StageConfig) -> StageNominal:
    """The first axis of a stage file as a nominal stage. Raises InputError where it has no actuator."""
    chain = config.effects
    before, behind, modes, loose = [], [], [], []
    payload = sum(e.values["payload_ratio"] for e in chain if e.name == "payload_change")
    for e in chain:
        place = e.kind.place
        if e.name in ("payload_change", "sensor_noise", "mains_hum", "timing", "quantisation"):
            continue
        if e.name in ("resonance", "mechanics"):
            modes.append(_mode(e, payload))
        elif place < Place.MECHANICS:
            before.append(e)
            if place in (Place.ACTUATOR, Place.HYSTERESIS, Place.CREEP):
                loose += [f"{e.label}.{k}" for k, v in e.values.items() if v != 0.0 and not k.startswith("offset")]
        else:
            still = {k: 0.0 for k in e.values if k.startswith("walk")}
            behind.append(e.replace(**still) if still else e)
    if not any(e.kind.place == Place.ACTUATOR for e in before):
        raise InputError(
            f"stage {config.name!r}: got no actuator among its effects, expected bouc_wen, linear_actuator or "
            "generalised_play: a stage without one does not move"
        )
    return StageNominal(Chain(tuple(before)), tuple(modes), Chain(tuple(behind)), tuple(loose))
