"""The nominal stages that a recording is compared with, and their calibration: Bouc-Wen, linear, or a stage file's."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.sim.effects import Chain, Effect, effect, simulate
from dehyst.sim.effects.base import Place
from dehyst.sim.fitting.calibration import calibrate, with_dynamics_anew, with_free_memory
from dehyst.sim.fitting.dynamics import LIGHT, Dynamics, first_ringing, respond
from dehyst.sim.fitting.fit_data import ActsOn, FitData, ModelParameter
from dehyst.sim.fitting.hysteresis_loops import bouc_wen_loop, loop_numbers
from dehyst.sim.fitting.stage_model import INITIAL_STATE, ModelFit, NominalStage, StageModel
from dehyst.sim.stage.config import StageConfig


def common_parameters(data: FitData) -> tuple[ModelParameter, ModelParameter]:
    """The sensor's offset, and a latch from two samples early to one late: recorders differ in both."""
    span = 4.0 * data.range_um + abs(data.middle_um)
    return (
        ModelParameter("offset_um", "µm", 0.0, -span, span, 0.1 * data.range_um, ActsOn.READING),
        ModelParameter("latch_samples", "1", 0.0, -2.0, 1.0, 0.1, ActsOn.DYNAMICS),
    )


@dataclass(frozen=True)
class BoucWenStage(NominalStage):
    """The chapter's stage, (2.1) and (2.2) with n = 1. A recording (u, y) determines alpha, beta, gamma, d and b/k.

    With sqrt(k/m) = 3.55e4 rad/s the mass of Table 2.1 adds a pole 0.3 µs from the origin, which no recording
    shows; the stage is a lag of b/k = 2.5 ms after the loop. A mode below 10 kHz is therefore not a parameter of
    this stage but something that it lacks.
    """

    name: str = "bouc_wen"

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
        most = 2.0 * r
        if data.begins_at_rest:
            # The first 20 ms are not judged then: a start would be free to grow until the end of its tail fits. It is
            # no larger than what moves there.
            first = data.y_um[: max(4, round(0.02 / data.dt_s))]
            most = float(np.ptp(first)) + 1e-5 * r
        start = ModelParameter("start_um", "µm", 0.0, -most, most, min(0.05 * r, 0.5 * most), ActsOn.DYNAMICS)
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

    def offset_um(self, p: FloatArray) -> float:
        return float(p[5])

    def start_um(self, p: FloatArray) -> float:
        return float(p[8]) if self.free_memory else 0.0


@dataclass(frozen=True)
class LinearStage(NominalStage):
    """A linear stage: gain and one mode, or two lags if overdamped."""

    name: str = "linear"

    @property
    def remembers(self) -> bool:
        return False

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

    def offset_um(self, p: FloatArray) -> float:
        return float(p[3])


#: Relative spread of the mode frequencies of one type of stage; a larger difference is a payload.
MODE_SPREAD = 0.015
#: Calibration scales the other numbers of the actuator by at most this factor, up or down.
SCALE = 2.0


@dataclass(frozen=True)
class FileStage(NominalStage):
    """The stage of a stage file, in three blocks: effects before the mechanics, modes, and effects behind them.

    Numbers of the actuator that are not zero are calibrated as factors of the file's, between 1/2 and 2; the
    frequency of a lightly damped mode within `MODE_SPREAD`. Effects behind the mechanics are taken as they are; noise
    and changes during a run are left out.
    """

    name: str = "stage"
    before: Chain = field(default_factory=Chain)
    modes_hz: tuple[tuple[float, float], ...] = ()
    behind: Chain = field(default_factory=Chain)
    calibrated: tuple[str, ...] = ()
    _unit: Chain = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_unit", Chain((effect("linear_actuator", gain_um_per_V=1.0), *self.behind)))

    @property
    def remembers(self) -> bool:
        return self.has_loop

    @property
    def has_loop(self) -> bool:
        """Whether the actuator has hysteresis."""
        return any(e.name not in ("linear_actuator", "dac", "creep", "amplifier_lag") for e in self.before)

    @property
    def has_lag(self) -> bool:
        """Whether amplifier, sensor or a mode that does not ring lags behind."""
        lags = any(e.name in ("amplifier_lag", "sensor_lag") for e in (*self.before, *self.behind))
        return lags or any(damping >= LIGHT for _, damping in self.modes_hz)

    def parameters(self, data: FitData) -> tuple[ModelParameter, ...]:
        span = 1.0 / SCALE
        own = [ModelParameter(path, "1", 1.0, span, SCALE, 0.05, ActsOn.STATIC) for path in self.calibrated]
        modes: list[ModelParameter] = []
        ringing = first_ringing(self.modes_hz)
        for i, (_, damping) in enumerate(self.modes_hz):
            spread = math.log1p(MODE_SPREAD) if damping < 1.0 else math.log(3.0)
            # A payload moves the first mode that rings, and keeps its stated frequency by this name.
            name = "log_f_ringing_share" if i == ringing else f"log_f{i + 1}_share"
            modes.append(ModelParameter(name, "1", 0.0, -spread, spread, 0.01, ActsOn.DYNAMICS))
            if damping < 1.0:
                modes.append(ModelParameter(f"log_z{i + 1}_share", "1", 0.0, -1.5, 1.5, 0.1, ActsOn.DYNAMICS))
        before = (ModelParameter("before_share", "1", 0.0, -1.0, 1.0, 0.1, ActsOn.STATIC),) if self.free_memory else ()
        return (*own, *modes, *common_parameters(data), *before)

    def starts(self, data: FitData) -> list[FloatArray]:
        p = np.array([s.neutral for s in self.parameters(data)])
        p[self._offset] = data.y_um[0]
        return [p]

    @property
    def _offset(self) -> int:
        """Index of the offset; the latch comes next."""
        return len(self.calibrated) + sum(2 if damping < 1.0 else 1 for _, damping in self.modes_hz)

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
        actuator = self.actuator(p)
        past = self._past_V(actuator, float(p[-1]), drive_V, data) if self.free_memory else drive_V[:0]
        w = simulate(actuator, np.concatenate([past, drive_V, drive_V[-1:]]), data.dt_s)[past.size + 1 :]
        slope = float(np.ptp(w)) / max(float(np.ptp(drive_V)), 1e-12) * math.copysign(1.0, data.gain_um_per_V)
        h = slope * (drive_V - drive_V[0]) - (w - w[0]) if self.has_loop else np.zeros_like(w)
        return np.ascontiguousarray(h), np.ascontiguousarray(w)

    def _past_V(self, actuator: Chain, share: float, drive_V: FloatArray, data: FitData) -> FloatArray:
        """The voltage before the first sample: up or down and back, as slowly as the amplifier's lag asks for.

        What remains of a small excursion goes with its square, so the excursion goes with the root of ``share``.
        """
        if share == 0.0:
            return drive_V[:0]
        lag_s = sum(e.values["tau_s"] for e in actuator if e.name == "amplifier_lag")
        n = 1 + math.ceil(10.0 * lag_s / data.dt_s)
        there_V = drive_V[0] + math.copysign(math.sqrt(abs(share)), share) * data.swing_V
        return np.repeat([there_V, drive_V[0]], n)

    def dynamics(self, p: FloatArray, data: FitData) -> Dynamics:
        return Dynamics((), self.modes(p), float(p[self._offset + 1]) * data.dt_s, self.hold)

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
        return float(p[self._offset])


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
    return FileStage(
        before=Chain(tuple(before)), modes_hz=tuple(modes), behind=Chain(tuple(behind)), calibrated=tuple(loose)
    )


# Calibration of the nominal stage, before a cause is looked for.

#: Nominal stages with a name of their own. Any other one comes from a stage file.
NAMED = ("bouc_wen", "linear")


def nominal_candidates(kind: str | StageConfig, data: FitData) -> list[NominalStage]:
    """The nominal stage with each hold between two samples: recorders differ in how they sample the drive."""
    if isinstance(kind, StageConfig):
        stage = file_stage(kind)
        return [stage, stage.with_other_hold()]
    if kind == "linear":
        return [LinearStage("zero"), LinearStage("first")]
    free = not data.begins_at_rest
    return [BoucWenStage("zero", free_memory=free), BoucWenStage("first", free_memory=free)]


def with_nominal_kind(kind: str | StageConfig, data: FitData) -> FitData:
    """The data, marked with the kind of the nominal stage that they are compared with."""
    if not isinstance(kind, StageConfig):
        linear = kind == "linear"
        return replace(data, input_is_linear=linear, nominal_kind=kind, has_mode=linear)
    stage = file_stage(kind)
    known = tuple(f for f, damping in stage.modes_hz if damping < LIGHT)
    return replace(
        data,
        input_is_linear=not stage.has_loop,
        nominal_kind="stage",
        known_modes_hz=known,
        has_mode=bool(known),
        has_lag=stage.has_lag,
    )


def calibrate_nominal(kind: str | StageConfig, data: FitData, mask: BoolArray) -> ModelFit:
    """The best calibration of the nominal stage within its physical bounds, from several starts."""
    best: ModelFit | None = None
    for nominal in nominal_candidates(kind, data):
        model = StageModel(data, nominal)
        for start in nominal.starts(data):
            fit = calibrate(model, start, mask, 8, 1e-2)
            # Sub-steps cost time, and few recorders need them: they must reduce the error by 5 %.
            dearer = best is not None and nominal.substeps > best.model.nominal.substeps
            if best is None or fit.sse_um2 < best.sse_um2 * (0.95 if dearer else 1.0 - 1e-3):
                best = fit
    assert best is not None
    best = calibrate(best.model, best.p, mask, 12, 1e-5)
    anew = with_dynamics_anew(best, mask)
    dearer = anew.model.nominal.substeps > best.model.nominal.substeps
    if anew.sse_um2 < best.sse_um2 * (0.95 if dearer else 1.0 - 1e-3):
        best = calibrate(anew.model, anew.p, mask, 12, 1e-5)
    return with_free_memory(best, mask)


def with_other_axis(fit: ModelFit, mask: BoolArray, *, refit: bool = True) -> ModelFit:
    """The same fit on data that include the displacement of the other axis.

    The displacement is the measured one, or, without a measurement, that of an equal stage driven by the other axis'
    voltage. The rate comes from that equal stage where possible: differences of readings are mostly noise.
    """
    data = fit.model.data
    modelled = None
    if data.u2_V is not None and float(np.ptp(data.u2_V)) > 1e-9:
        mine = fit.model.parameters_of(fit.p, -1)
        _, w = fit.model.nominal.static(data.u2_V, mine, data)
        modelled = respond(w, fit.model.dynamics(fit.p), data.dt_s)
    measured = data.y2_um
    if measured is not None and float(np.ptp(measured)) <= 0.0:
        measured = None
    other = measured if measured is not None else modelled
    if other is None:
        return fit
    other = other - float(np.mean(other[: max(1, data.n // 500)]))
    source = modelled if modelled is not None else other
    known = replace(data, other_um=other, other_um_per_s=np.gradient(source, data.dt_s), scales_from=data.scales)
    model = StageModel(known, fit.model.nominal, fit.model.causes)
    return calibrate(model, fit.p, mask, 2, 1e-4) if refit else replace(fit, model=model)


# A fitted model on another recording of the same stage.

#: Parameters that belong to one recording: the sensor's offset, and what happened before the first sample.
OF_ONE_RECORDING = ("offset_um", *INITIAL_STATE)


def fit_on_other_recording(fit: ModelFit, data: FitData, mask: BoolArray) -> ModelFit:
    """The fitted model on another recording ``data``, where only what belongs to one recording is calibrated again.

    That is the sensor's offset, the memory at the start, and causes that do not carry over (drift over time, phase
    of a hum, clock). ``mask`` (n,) is False where samples do not count.
    """
    home = fit.model
    _, static_um = home.nominal.static(
        fit.signals.drive_V, home.parameters_of(fit.p, -1), home.data.subdivided(home.substeps, home.nominal.hold)
    )
    there = replace(
        data,
        fitted_low_um=float(np.min(static_um)),
        fitted_loop_um=float(np.max(np.abs(fit.signals.h_um))),
        input_is_linear=home.data.input_is_linear,
        nominal_kind=home.data.nominal_kind,
        known_modes_hz=home.data.known_modes_hz,
        has_mode=home.data.has_mode,
        has_lag=home.data.has_lag,
        scales_from=home.data.scales,
    )
    nominal = home.nominal
    if isinstance(nominal, BoucWenStage) and not data.begins_at_rest:
        nominal = nominal.with_free_memory()
    model = StageModel(there, nominal, home.causes)
    known = {parameter.name: fit.p[i] for i, parameter in enumerate(home.parameters[: home.n_nominal])}
    own_parameters = model.parameters[: model.n_nominal]
    start = np.array([known.get(parameter.name, parameter.neutral) for parameter in own_parameters])
    own = {i for i, parameter in enumerate(own_parameters) if parameter.name in OF_ONE_RECORDING}
    for i, cause in enumerate(model.causes):
        # The number of parameters of such a cause may depend on the length of the recording.
        fresh = np.array([parameter.neutral for parameter in cause.parameters(there)])
        start = np.concatenate([start, fresh if cause.of_one_recording else home.parameters_of(fit.p, i)])
        first = start.size - fresh.size
        for k, parameter in enumerate(cause.parameters(there)):
            if cause.of_one_recording or parameter.name in OF_ONE_RECORDING:
                own.add(first + k)
                start[first + k] = parameter.neutral
    unfitted = ModelFit(model, start, fit.signals, there.y_um, 0.0, [])
    known_axis = with_other_axis(unfitted, mask, refit=False)
    return calibrate(known_axis.model, start, mask, 20, 1e-6, frozenset(own))
