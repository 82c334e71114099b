"""``tables.json``: every number of the report, published and computed, and whether the targets are met."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from adaptive.inverse_model import LssvmInverse
from baselines.bouc_wen.model import BoucWenParameters
from baselines.prandtl_ishlinskii.model import MpiParameters, inverse_thresholds, inverse_weights
from lab.reproduce.measured import BENCHMARK_PUBLISHED, WINDOWS, Benchmark, Stack
from lab.reproduce.study import PresetStudy, Study
from sim.chapter import published
from sim.chapter.characterisation import Width
from sim.chapter.control import FROZEN, LEARNING
from sim.chapter.forward_lssvm import MemoryLssvm, TwoInputLssvm

SCHEMA = 1


def json_form(value: Any) -> Any:
    """JSON form: floats with seven digits, non-finite numbers as null, arrays and tuples as lists."""
    if isinstance(value, dict):
        return {str(key): json_form(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [json_form(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.7g}") if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value


def table_2_1(parameters: BoucWenParameters) -> dict[str, float]:
    """m kg, b N s/m, k N/m, d m/V, alpha, beta 1/V, gamma 1/V. Of m, b, k only the ratios m/k and b/k are seen."""
    p = parameters
    values = (p.m_kg, p.b_N_s_per_m, p.k_N_per_m, 1e-6 * p.d_um_per_V, p.alpha, p.beta_per_V, p.gamma_per_V)
    return dict(zip(published.TABLE_2_1, values, strict=True))


def table_2_2(p: MpiParameters) -> dict[str, Any]:
    """r_i V, w_hi, d_j µm, w_sj of the identified model."""
    return {"r": p.r_, "w_h": p.w_h_, "d": p.d_, "w_s": p.w_s_}


def table_2_3(p: MpiParameters) -> dict[str, Any]:
    """The same of its inverse, (2.12)-(2.14), (2.16)-(2.18)."""
    return {
        "r": inverse_thresholds(p.w_h_, p.r_),
        "w_h": inverse_weights(p.w_h_),
        "d": inverse_thresholds(p.w_s_, p.d_),
        "w_s": inverse_weights(p.w_s_),
    }


def _width(width: Width) -> dict[str, float]:
    return {**asdict(width), "width_pct": width.width_pct}


def preset_tables(study: PresetStudy) -> dict[str, Any]:
    """All numbers of one stage."""
    character, control = study.characterisation, study.control
    table_4 = {
        run.key: {
            "label": run.label,
            "route": run.route,
            "parameters": run.parameters,
            "seconds": run.seconds,
            "modelling": asdict(run.training),
            "generalisation": asdict(run.generalisation),
            "third_family": {name: asdict(score) for name, score in run.third.items()},
            "third_family_mae_pct": run.third_mae_pct,
        }
        for run in study.forward
    }
    loops: dict[str, Any] = {}
    for loop in control.loops:
        loops.setdefault(loop.reference, {}).setdefault(loop.model, {})[loop.controller] = asdict(loop.score)
    hyper: dict[str, Any] = {}
    for run in study.forward:
        if isinstance(run.model, TwoInputLssvm | MemoryLssvm) and run.model.evidence is not None:
            evidence = run.model.evidence
            hyper[run.key] = {"gamma": evidence.gamma, "sigma": evidence.widths, "J3": evidence.J3}
    for key, inverse in control.inverses.items():
        if isinstance(inverse.model, LssvmInverse):
            hyper[f"inverse_{key}"] = {"gamma": inverse.model.gamma, "sigma": inverse.model.widths}
    return {
        "range_um": study.data.range_um,
        "seconds": study.seconds,
        "characterisation": {
            "triangles": [_width(width) for width in character.triangle_widths],
            "sines": [_width(width) for width in character.sine_widths],
            "cross_talk_pct": character.cross_talk_pct,
            "cross_talk_back_pct": character.cross_talk_back_pct,
        },
        "table_2_1": {r.key: table_2_1(r.model) for r in study.forward if isinstance(r.model, BoucWenParameters)},
        "table_2_2": {r.key: table_2_2(r.model) for r in study.forward if isinstance(r.model, MpiParameters)},
        "table_2_3": {r.key: table_2_3(r.model) for r in study.forward if isinstance(r.model, MpiParameters)},
        "table_2_4": table_4,
        "table_2_4_inverse": {
            run.model: {
                "scores": {name: asdict(score) for name, score in run.scores.items()},
                "third_family_mae_pct": run.third_mae_pct,
            }
            for run in study.replayed
        },
        "hyper_parameters": hyper,
        "gains": {
            "ultimate_gain_V_per_um": control.ultimate.gain_V_per_um,
            "ultimate_period_s": control.ultimate.period_s,
            "k_p_V_per_um": control.pid.k_p,
            "k_i_V_per_um_s": control.pid.k_i,
            "chapter_gains_stable": control.chapter_gains_stable,
        },
        "table_2_5": loops,
        "inverse_seconds": {key: inverse.seconds for key, inverse in control.inverses.items()},
        "after_gain_change": {loop.model: asdict(loop.score) for loop in control.changed},
    }


def stack_tables(stack: Stack) -> dict[str, Any]:
    """The measured stack: the authors' figures, recomputed from the file, and the models' equivalent errors, µm."""
    return {
        "published_rmse_um": {name: entry[2] for name, entry in WINDOWS.items()},
        "reproduced_rmse_um": stack.reproduced_um,
        "range_um": stack.range_um,
        "models": {
            m.name: {
                "seconds": m.seconds,
                "whole_rmse_um": m.whole_um,
                "whole_rmse_pct": m.whole_pct,
                "windows_rmse_um": m.windows_um,
                "failed": m.failed or None,
            }
            for m in stack.models
        },
    }


def benchmark_tables(found: Benchmark) -> dict[str, Any]:
    """The Bouc-Wen benchmark: parameters, errors, and how the residual spreads over frequency."""
    frequency, amplitude = found.residual_spectrum
    bands = {
        f"{low}-{high} Hz": math.sqrt(0.5 * float(np.sum(amplitude[(frequency >= low) & (frequency < high)] ** 2)))
        for low, high in ((0, 5), (5, 30), (30, 50), (50, 150), (150, 375))
    }
    return {
        "published_rmse_m": BENCHMARK_PUBLISHED,
        "rmse_m": found.rmse_m,
        "max_m": found.max_m,
        "rmse_m_40_steps": found.finer_m,
        "rmse_m_held_input": found.held_m,
        "test_rms_m": found.test_rms_m,
        "training_rmse_m": found.report.rmse_m,
        "training_noise_m": found.report.noise_m,
        "seconds": found.seconds,
        "parameters": asdict(found.model),
        "beta_gamma_beta_delta": found.model.products,
        "parameter_std": found.report.std,
        "residual_rms_m": bands,
    }


def targets(study: Study) -> list[dict[str, Any]]:
    """The targets: name, limit, result, and whether it is met."""
    found: list[tuple[str, float, float]] = []
    for preset in study.presets:
        limits = (("bouc_wen", 5.0), ("mpi", 2.0), ("lssvm", 2.0), ("bouc_wen_pso", 60.0), ("mpi_pso", 60.0))
        for key, limit in limits:
            for run in preset.forward:
                if run.key == key:
                    found.append((f"{preset.name}: {run.label} by {run.route}, s of one core", limit, run.seconds))
        if preset.name != "rich":
            continue
        memory = preset.model("lssvm_memory")
        worst = max(score.mae_pct for score in memory.third.values())
        first = preset.control.loops[0].reference
        found += [
            ("rich: LSSVM with memory on (2.45), MAE %", 0.10, memory.generalisation.mae_pct),
            ("rich: LSSVM with memory, worst of the third family, MAE %", 0.5, worst),
            (f"rich: feedforward alone on {first!r}, LSSVM with memory, MAE %", 0.10,
             preset.control.loop("lssvm_memory", "FF", first).score.mae_pct),
            (f"rich: feedforward and feedback on {first!r}, LSSVM with memory, MAE %", 0.010,
             preset.control.loop("lssvm_memory", "FF+FB", first).score.mae_pct),
        ]  # fmt: skip
    if study.benchmark is not None:
        found.append(("benchmark: test multisine, RMSE m", 2e-6, study.benchmark.rmse_m))
    return [{"what": what, "limit": limit, "found": got, "met": bool(got <= limit)} for what, limit, got in found]


def tables(study: Study) -> dict[str, Any]:
    """The whole of ``tables.json``."""
    whole = {
        "schema": SCHEMA,
        "quick": study.config.quick,
        "epochs": study.config.epochs if study.config.pso else None,
        "seconds": study.seconds,
        "machine": study.machine,
        "labels": {**FROZEN, **{key: label for key, (label, _) in LEARNING.items()}},
        "published": {
            "models": {key: asdict(model) for key, model in published.MODELS.items()},
            "table_2_1": {key: value for key, (_, _, value) in published.TABLE_2_1.items()},
            "table_2_2": dict(zip(("r", "w_h", "d", "w_s"), published.TABLE_2_2, strict=True)),
            "table_2_3": dict(zip(("r", "w_h", "d", "w_s"), published.TABLE_2_3, strict=True)),
            "hyper_parameters": {"forward": published.FORWARD_HYPER, "inverse": published.INVERSE_HYPER},
            "gains": published.GAINS,
            "cross_talk_pct": published.CROSS_TALK_PCT,
        },
        "presets": {preset.name: preset_tables(preset) for preset in study.presets},
        "picma_stack": stack_tables(study.stack) if study.stack is not None else None,
        "boucwen_benchmark": benchmark_tables(study.benchmark) if study.benchmark is not None else None,
        "targets": targets(study),
    }
    done: dict[str, Any] = json_form(whole)
    return done
