"""Export of a diagnosed stage: its nominal stage and causes as effects of the library, for a stage file.

Where a cause model and the effect of the library differ, the effect is fitted to the cause model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.nominal import BoucWenStage, FileStage, LinearStage
from dehyst.sim.diagnosis.result import Diagnosis
from dehyst.sim.effects import EFFECTS, Chain, Effect, simulate
from dehyst.sim.fitting.calibration import DampingRule, damped_step
from dehyst.sim.fitting.fit_data import ActsOn, FitData
from dehyst.sim.fitting.hysteresis_loops import loop_numbers
from dehyst.sim.fitting.stage_model import ModelFit, StageModel
from dehyst.sim.stage.config import StageConfig

#: Label of the effect that carries the sensor's offset.
OFFSET = "sensor_offset"


def nominal_effects(fit: ModelFit) -> list[Effect]:
    """The calibrated nominal stage as effects of the library, without the recorder's latch."""
    p = fit.model.parameters_of(fit.p, -1)
    nominal = fit.model.nominal
    # The offset comes after the mechanics: before them it would cause a transient from zero.
    drift = {"amplitude_um": 0.0, "ramp_um_per_min": 0.0, "walk_um_per_sqrt_min": 0.0}
    offset = EFFECTS["thermal_drift"].clipped(OFFSET, offset_um=nominal.offset_um(p), **drift)
    if isinstance(nominal, FileStage):
        found = nominal.effects(p)
        # A stage file that came from a diagnosis has an offset already, and what is fitted now comes on top of it.
        before = sum(e.values["offset_um"] for e in found if e.label == OFFSET)
        total = EFFECTS["thermal_drift"].clipped(OFFSET, offset_um=before + nominal.offset_um(p), **drift)
        return [*(e for e in found if e.label != OFFSET), total]
    if nominal.name == "linear":
        f, z = float(np.exp(p[1])), float(np.exp(p[2]))
        return [
            EFFECTS["linear_actuator"].clipped(gain_um_per_V=float(p[0])),
            offset,
            EFFECTS["resonance"].clipped("nominal_mode", frequency_Hz=f, damping_ratio=z),
        ]
    slope, beta, gamma = loop_numbers(p)
    d = float(p[0])
    k = EFFECTS["mechanics"].parameter("stiffness_N_per_m").default
    return [
        EFFECTS["bouc_wen"].clipped(d_um_per_V=d, alpha=slope / d, beta_per_V=beta, gamma_per_V=gamma),
        offset,
        EFFECTS["mechanics"].clipped(damping_N_s_per_m=float(p[4]) * k, stiffness_N_per_m=k),
    ]


#: A chain, its free run (n,), and the error of that run without the samples that settle.
_Run = tuple[Chain, FloatArray, FloatArray]
_RULE = DampingRule(least=1e-8, least_after_failure=0.0, rcond=1e-12)


@dataclass(frozen=True)
class ExportedStage:
    """A stage configuration and the RMS difference (µm) of its free run from the extended model.

    ``left_out``: causes that the effects library cannot express.
    """

    config: StageConfig
    rms_um: float
    left_out: tuple[str, ...] = ()


def export_stage(diagnosis: Diagnosis, name: str = "diagnosed", seed: int = 0) -> ExportedStage:
    """The extended stage as a stage configuration.

    Effects that differ from their cause models are fitted by simulating the library's chain against the extended
    model, without the recorder's latch and noise.
    """
    fit = diagnosis.extended
    data = fit.model.data
    own, loose = nominal_effects(fit), {"bouc_wen", "linear_actuator", OFFSET}
    effects, named, missing = list(own), list[str](), list[str]()
    for i, cause in enumerate(fit.model.causes):
        if not any(c.index == i for c in diagnosis.causes):
            continue
        named.append(cause.name)
        mine = diagnosis.catalogue.causes[cause.name].in_library(cause, fit.model.parameters_of(fit.p, i), data)
        if mine is None:
            missing.append(cause.name)
            continue
        if mine.changed is not None:
            effects = [mine.changed(e) for e in effects]
        added = [_apart(e, effects) for e in mine.effects]
        effects += added
        if mine.refit:
            loose |= {e.label for e in added}
    extras, extras_um2 = list[Effect](), 0.0
    for c in (c for c in diagnosis.causes if c.index < 0):
        without_fit = diagnosis.catalogue.causes[c.name].in_readings
        if without_fit is not None:
            more, noise_um2 = without_fit.effects(c.parameters)
            extras += more
            extras_um2 += noise_um2
    clean = Chain(tuple(effects))
    target, skip = _target(fit), _settling(fit)
    fitted, after = clean, _rms((_free_run(clean, data) - target)[skip:])
    if not loose <= {"bouc_wen", "linear_actuator", OFFSET}:
        fitted, after = _fit(clean, loose, data, target, skip)
    left_out = tuple(missing)
    plain = Chain(tuple(own))
    if named and not after < _rms((_free_run(plain, data) - target)[skip:]):
        # The library has the effect at another place of the chain, so the export is worse with it than without.
        fitted, left_out = plain, tuple(dict.fromkeys(named))
        after = _rms((_free_run(plain, data) - target)[skip:])
    noise_um = float(np.sqrt(max(diagnosis.noise_floor_um**2 - extras_um2, 0.0)))
    extras.insert(0, EFFECTS["sensor_noise"].clipped(rms_um=noise_um))
    margin = 0.05 * data.swing_V
    config = StageConfig(
        name,
        Chain((*fitted, *extras)),
        dt_s=data.dt_s,
        seed=seed,
        u_min_V=min(0.0, data.u_low_V - margin),
        u_max_V=max(0.0, data.u_high_V + margin),
    )
    return ExportedStage(config, after, left_out)


def _apart(e: Effect, others: list[Effect]) -> Effect:
    """The effect with a label that none of ``others`` has: a stage file may hold one of its kind already."""
    taken = {other.label for other in others}
    if e.label not in taken:
        return e
    number = next(k for k in range(2, len(taken) + 3) if f"{e.label}_{k}" not in taken)
    return e.kind(label=f"{e.label}_{number}", **e.values)


def _settling(fit: ModelFit) -> int:
    """Number of first samples to leave out, because a simulated stage starts at rest at 0 V and this one did not."""
    u = fit.model.data.u_V
    nominal = fit.model.nominal
    free_memory = isinstance(nominal, BoucWenStage | FileStage) and nominal.free_memory
    at_rest = abs(float(u[0])) < 1e-3 * fit.model.data.swing_V and not free_memory
    return 0 if at_rest else fit.model.data.n // 5


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _target(fit: ModelFit) -> FloatArray:
    """(n,) reading of the extended model without the recorder's latch and, for a linear stage, with a held drive."""
    model: StageModel = fit.model
    if isinstance(model.nominal, LinearStage):
        # A simulated stage is driven by a D/A converter that holds.
        model = StageModel(model.data, replace(model.nominal, hold="zero"), model.causes)
    p = fit.p.copy()
    for i, parameter in enumerate(model.parameters[: model.n_nominal]):
        if parameter.name == "latch_samples":
            p[i] = 0.0
    return model.simulate(p, ActsOn.DRIVE).reading_um


def _free_run(chain: Chain, data: FitData) -> FloatArray:
    return simulate(chain, data.u_V, data.dt_s, other_um=data.other_um)


def _fit(chain: Chain, loose: set[str], data: FitData, target: FloatArray, skip: int = 0) -> tuple[Chain, float]:
    """Fit the numbers of the effects ``loose`` (labels) by Levenberg-Marquardt, without the first ``skip`` samples."""
    paths: list[str] = []
    for e in chain:
        if e.label in loose:
            fixed = ("walk", "range_um") if e.label == OFFSET else ("walk", "range_um", "offset_um")
            names = [p.name for p in e.kind.parameters if not p.name.startswith(fixed)]
            paths += [f"{e.label}.{name}" for name in names if e.label != OFFSET or name == "offset_um"]
    spec: dict[str, Any] = {
        path: chain[path.rpartition(".")[0]].kind.parameter(path.rpartition(".")[2]) for path in paths
    }
    run = _free_run(chain, data)
    error = (target - run)[skip:]
    best = float(error @ error)
    damping = 1e-3
    for _ in range(12):
        now = chain.parameters
        scale = np.array([max(abs(now[path]), 0.02 * abs(spec[path].default), 1e-6) for path in paths])
        rows = np.empty((len(paths), data.n - skip))
        for i, path in enumerate(paths):
            h = 1e-3 * scale[i] * (1.0 if now[path] + 1e-3 * scale[i] <= spec[path].high else -1.0)
            moved = _free_run(chain.replace({path: now[path] + h}), data)
            rows[i] = (moved - run)[skip:] / h * scale[i]
        gram, slope = rows @ rows.T, rows @ error
        size = np.maximum(np.diag(gram), 1e-9 * float(np.max(np.diag(gram))))

        def trial(move: FloatArray, chain: Chain = chain, scale: FloatArray = scale) -> tuple[float, _Run]:
            now, step = chain.parameters, move * scale
            values = {
                path: float(np.clip(now[path] + step[i], spec[path].low, spec[path].high))
                for i, path in enumerate(paths)
            }
            moved = chain.replace(values)
            reading = _free_run(moved, data)
            left = (target - reading)[skip:]
            return float(left @ left), (moved, reading, left)

        better, damping = damped_step(gram, slope, size, damping, _RULE, 5, best, trial)
        if better is None:
            break
        chain, run, error = better
        sse = float(error @ error)
        gained, best = 1.0 - sse / best, sse
        if gained <= 1e-3:
            break
    return chain, float(np.sqrt(best / (data.n - skip)))
