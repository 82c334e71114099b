"""The nominal stages that a recording is compared with: Bouc-Wen, linear, or the stage of a stage file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.diagnosis.model.dynamics import Dynamics, respond
from sim.diagnosis.model.fit_data import ActsOn, FitData, ModelParameter
from sim.diagnosis.model.hysteresis_loops import bouc_wen_loop
from sim.effects import Chain, Effect, effect, simulate
from sim.effects.base import Place
from sim.stage.config import StageConfig


class NominalStage(Protocol):
    """A stage that a recording is compared with. Its parameters are calibrated before causes are searched."""

    @property
    def name(self) -> str: ...
    @property
    def hold(self) -> str: ...
    @property
    def substeps(self) -> int:
        """Sub-steps per sample at which drive and hysteresis are simulated."""
        ...

    def with_other_hold(self) -> NominalStage: ...
    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]: ...
    def starts(self, data: FitData) -> list[FloatArray]: ...
    def static(self, drive_V: FloatArray, p: FloatArray, data: FitData) -> tuple[FloatArray, FloatArray]:
        """Hysteresis h and static displacement w (µm, (n,) each) for the voltage at the actuator."""
        ...

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics: ...
    def behind_um(self, x_um: FloatArray, data: FitData) -> FloatArray:
        """(n,) displacement behind the mechanics after what the stage itself adds there."""
        ...

    def offset_um(self, p: FloatArray) -> float: ...
    def start_um(self, p: FloatArray) -> float:
        """Distance (µm) of the first sample from equilibrium with the first voltage."""
        ...


def common_parameters(data: FitData) -> tuple[ModelParameter, ModelParameter]:
    """The sensor's offset, and a latch from two samples early to one late: recorders differ in both."""
    span = 4.0 * data.range_um + abs(data.middle_um)
    return (
        ModelParameter("offset_um", "µm", 0.0, -span, span, 0.1 * data.range_um, ActsOn.READING),
        ModelParameter("latch_samples", "1", 0.0, -2.0, 1.0, 0.1, ActsOn.DYNAMICS),
    )


def loop_numbers(p: FloatArray) -> tuple[float, float, float]:
    """Slope alpha d (µm/V), beta and gamma (1/V) of a Bouc-Wen stage's parameters.

    beta - gamma is kept above -(beta + gamma): below it h diverges for a bounded voltage.
    """
    fall = max(float(p[3]), -0.95 * float(p[2]))
    return float(p[1] * p[0]), 0.5 * (float(p[2]) + fall), 0.5 * (float(p[2]) - fall)


@dataclass(frozen=True)
class BoucWenStage:
    """The chapter's stage, (2.1) and (2.2) with n = 1. A recording (u, y) determines alpha, beta, gamma, d and b/k.

    With sqrt(k/m) = 3.55e4 rad/s the mass of Table 2.1 adds a pole 0.3 µs from the origin, which no recording
    shows; the stage is a lag of b/k = 2.5 ms after the loop. A mode below 10 kHz is therefore not a parameter of
    this stage but something that it lacks.
    """

    hold: str = "zero"
    name: str = "bouc_wen"
    #: The hysteresis at the first sample is a parameter, because the recording does not begin at rest at 0 V.
    free_memory: bool = False

    def with_other_hold(self) -> BoucWenStage:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        # h is curved while the voltage runs linearly between samples; under a held voltage one exact step suffices.
        return 4 if self.hold == "first" else 1

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        g = max(abs(data.gain_um_per_V), 1e-9)
        v = max(data.swing_V, 1e-9)
        offset, latch = common_parameters(data)
        own = (
            ModelParameter("d_um_per_V", "µm/V", g, 0.2 * g, 5.0 * g, 0.1 * g, ActsOn.STATIC),
            ModelParameter("alpha", "1", 0.4754, 0.0, 1.5, 0.1, ActsOn.STATIC),
            ModelParameter("rise_per_V", "1/V", 14.6 / v, 0.3 / v, 80.0 / v, 1.5 / v, ActsOn.STATIC),  # beta + gamma
            ModelParameter("fall_per_V", "1/V", -0.9 / v, -20.0 / v, 40.0 / v, 1.5 / v, ActsOn.STATIC),  # beta - gamma
            ModelParameter("tau_s", "s", 2.5268e-3, 2.0e-6, 4e-3, 2.5e-4, ActsOn.DYNAMICS),
            offset,
            latch,
        )
        if not self.free_memory:
            return own
        r = data.range_um
        start = ModelParameter("start_um", "µm", 0.0, -2.0 * r, 2.0 * r, 0.05 * r, ActsOn.DYNAMICS)
        return (*own, ModelParameter("h0", "1", 0.0, -1.0, 1.0, 0.1, ActsOn.STATIC), start)

    def starts(self, data: FitData) -> list[FloatArray]:
        first = np.array([s.neutral for s in self.parameters(data)])
        first[5] = (
            data.y_um[0] if not self.free_memory else data.middle_um - first[0] * 0.5 * (data.u_high_V + data.u_low_V)
        )
        wide = first.copy()
        wide[2] *= 0.3
        wide[3] = 0.0
        return [first, wide]

    def static(self, drive_V: FloatArray, p: FloatArray, data: FitData) -> tuple[FloatArray, FloatArray]:
        slope, beta, gamma = loop_numbers(p)
        h0 = p[7] * slope / p[2] if self.free_memory else 0.0
        h = bouc_wen_loop(drive_V, slope, beta, gamma, h0)
        return h, p[0] * drive_V - h

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics:
        return Dynamics((float(p[4]),), (), float(p[6]) * data.dt_s, self.hold)

    def behind_um(self, x_um: FloatArray, data: FitData) -> FloatArray:
        return x_um

    def offset_um(self, p: FloatArray) -> float:
        return float(p[5])

    def start_um(self, p: FloatArray) -> float:
        return float(p[8]) if self.free_memory else 0.0


@dataclass(frozen=True)
class LinearStage:
    """A linear stage: gain and one mode, or two lags if overdamped."""

    hold: str = "zero"
    name: str = "linear"

    def with_other_hold(self) -> LinearStage:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        return 1

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        # Near a resonance the regression slope is no estimate of the gain.
        g = max(abs(data.gain_um_per_V), data.range_um / max(data.swing_V, 1e-12), 1e-9)
        offset, latch = common_parameters(data)
        return (
            ModelParameter("gain_um_per_V", "µm/V", data.gain_um_per_V, -20.0 * g, 20.0 * g, 0.1 * g, ActsOn.STATIC),
            ModelParameter(
                "log_f0",
                "1",
                np.log(0.1 / data.dt_s),
                np.log(1e-3 / data.dt_s),
                np.log(4.0 / data.dt_s),
                0.05,
                ActsOn.DYNAMICS,
            ),
            ModelParameter("log_damping", "1", 0.0, np.log(1e-3), np.log(300.0), 0.1, ActsOn.DYNAMICS),
            offset,
            latch,
        )

    def starts(self, data: FitData) -> list[FloatArray]:
        """The three best modes of a grid, each with its least-squares gain and offset."""
        neutral = np.array([s.neutral for s in self.parameters(data)])
        n = min(data.n, 20_000)
        u, y = np.ascontiguousarray(data.u_V[:n]), data.y_um[:n]
        found: list[tuple[float, FloatArray]] = []
        for f_hz in np.geomspace(2e-3, 1.0, 110) / data.dt_s:
            for damping in (0.01, 0.03, 0.1, 0.4, 1.0, 6.0):
                x = respond(u, Dynamics((), ((float(f_hz), damping),), 0.0, self.hold), data.dt_s)
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

    def static(self, drive_V: FloatArray, p: FloatArray, data: FitData) -> tuple[FloatArray, FloatArray]:
        return np.zeros_like(drive_V), p[0] * drive_V

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics:
        mode = (float(np.exp(p[1])), float(np.exp(p[2])))
        return Dynamics((), (mode,), float(p[4]) * data.dt_s, self.hold)

    def behind_um(self, x_um: FloatArray, data: FitData) -> FloatArray:
        return x_um

    def offset_um(self, p: FloatArray) -> float:
        return float(p[3])

    def start_um(self, p: FloatArray) -> float:
        return 0.0


#: Relative spread of the mode frequencies of one type of stage; a larger difference is a payload.
MODE_SPREAD = 0.015
#: Calibration scales the other numbers of the actuator by at most this factor, up or down.
SCALE = 2.0


@dataclass(frozen=True)
class FileStage:
    """The stage of a stage file, in three blocks: effects before the mechanics, modes, and effects behind them.

    Numbers of the actuator that are not zero are calibrated as factors of the file's, between 1/2 and 2; the
    frequency of a lightly damped mode within `MODE_SPREAD`. Effects behind the mechanics are taken as they are; noise
    and changes during a run are left out.
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

    def with_other_hold(self) -> FileStage:
        return replace(self, hold="zero" if self.hold == "first" else "first")

    @property
    def substeps(self) -> int:
        return 4 if self.hold == "first" else 1

    @property
    def has_loop(self) -> bool:
        """Whether the actuator has hysteresis."""
        return any(e.name not in ("linear_actuator", "dac", "creep", "amplifier_lag") for e in self.before)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        span = 1.0 / SCALE
        own = [ModelParameter(path, "1", 1.0, span, SCALE, 0.05, ActsOn.STATIC) for path in self.calibrated]
        modes: list[ModelParameter] = []
        for i, (_, damping) in enumerate(self.modes_hz):
            spread = math.log1p(MODE_SPREAD) if damping < 1.0 else math.log(3.0)
            modes.append(ModelParameter(f"log_f{i + 1}_share", "1", 0.0, -spread, spread, 0.01, ActsOn.DYNAMICS))
            if damping < 1.0:
                modes.append(ModelParameter(f"log_z{i + 1}_share", "1", 0.0, -1.5, 1.5, 0.1, ActsOn.DYNAMICS))
        return (*own, *modes, *common_parameters(data))

    def starts(self, data: FitData) -> list[FloatArray]:
        p = np.array([s.neutral for s in self.parameters(data)])
        p[-2] = data.y_um[0]
        return [p]

    def effects(self, p: FloatArray) -> list[Effect]:
        """The file's effects with the calibrated numbers, modes as ``resonance``. The latch belongs to the recorder."""
        modes = self.modes(p)
        mine = [
            effect("resonance", label=f"nominal_mode_{i + 1}", frequency_Hz=f, damping_ratio=min(max(z, 1e-3), 100.0))
            for i, (f, z) in enumerate(modes)
        ]
        return [*self.actuator(p), *mine, *self.behind]

    def actuator(self, p: FloatArray) -> Chain:
        """The effects before the mechanics, with the calibrated numbers."""
        values = self.before.parameters
        return self.before.replace(
            {
                path: float(np.clip(values[path] * p[i], *_range(self.before, path)))
                for i, path in enumerate(self.calibrated)
            }
        )

    def static(self, drive_V: FloatArray, p: FloatArray, data: FitData) -> tuple[FloatArray, FloatArray]:
        # The reading at t_k does not depend on u_k: one sample later it shows what u_k has done.
        w = simulate(self.actuator(p), np.append(drive_V, drive_V[-1]), data.dt_s)[1:]
        slope = float(np.ptp(w)) / max(float(np.ptp(drive_V)), 1e-12) * math.copysign(1.0, data.gain_um_per_V)
        h = slope * (drive_V - drive_V[0]) - (w - w[0]) if self.has_loop else np.zeros_like(w)
        return np.ascontiguousarray(h), np.ascontiguousarray(w)

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics:
        return Dynamics((), self.modes(p), float(p[-1]) * data.dt_s, self.hold)

    def modes(self, p: FloatArray) -> tuple[tuple[float, float], ...]:
        """Frequency (Hz) and damping ratio of each mode, calibrated."""
        at, modes = len(self.calibrated), []
        for f_hz, damping in self.modes_hz:
            f = f_hz * math.exp(float(p[at]))
            light = damping < 1.0
            modes.append((f, damping * math.exp(float(p[at + 1])) if light else damping))
            at += 2 if light else 1
        return tuple(modes)

    def behind_um(self, x_um: FloatArray, data: FitData) -> FloatArray:
        """(n,) displacement after the file's effects behind the mechanics: drift, cross-talk and sensor."""
        if not len(self.behind):
            return x_um
        later = np.append(x_um[1:], x_um[-1])
        return simulate(self._unit, later, data.dt_s, other_um=data.other_um)

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


def file_stage(config: StageConfig) -> FileStage:
    """The first axis of a stage file as a nominal stage. Raises InputError if it has no actuator."""
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
    return FileStage(Chain(tuple(before)), tuple(modes), Chain(tuple(behind)), tuple(loose))
