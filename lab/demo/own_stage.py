"""Fits the plan of the demonstration to a stage from a file, by measuring the stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adaptive.errors import InputError
from lab.demo.plan import Plan
from sim.diagnosis.export import OFFSET
from sim.effects import effect
from sim.stage.config import StageConfig
from sim.stage.file import load_stage, save_stage
from sim.stage.stage import Stage

#: Share of the voltage limits that identification uses, and range of the reference as shares of the range found by it.
DRIVE_SHARE, LOW_SHARE, HIGH_SHARE = 0.8, 0.045, 0.9
#: A stage with a rise time up to this, s, gets the usual reference; a slower one a slower reference.
QUICK_S = 4e-3


def plan_for(path: Path, folder: Path, run_s: float, seed: int) -> Plan:
    """The plan for the stage in the file ``path``; the stage that is run is written into ``folder``.

    Voltages stay within ``DRIVE_SHARE`` of the file's limits; the commanded range is a share of what they reach. The
    sample time is the plan's own. Raises InputError if the stage does not move, or diverges.
    """
    base = Plan(run_s=run_s, seed=seed)
    config = replace(_able_to_drift(_from_zero(load_stage(path))), dt_s=base.dt_s, seed=seed)
    high = DRIVE_SHARE * config.u_max_V
    # A stage of one polarity keeps it; a bipolar stage is driven both ways.
    low = DRIVE_SHARE * config.u_min_V if config.u_min_V < -0.5 * config.u_max_V else 0.0
    ours = folder / "stage.toml"
    save_stage(config, ours)
    plan = replace(
        base, stage_file=str(ours.resolve()), drive_low_V=low, drive_high_V=high, payload_ratio=_payload(config)
    )
    stage = Stage(plan.stage(changing=False))
    y_um, _ = stage.run(stage.initial_state(), plan.identification_voltage())
    settled = y_um[round(0.5 / plan.dt_s) :]
    bottom, span = float(settled.min()), float(np.ptp(settled))
    if not np.isfinite(span) or not 1e-6 < span < 1e9:
        raise InputError(
            f"--stage: got {path}, whose reading spans {span:g} µm for {low:g} to {high:g} V, expected a stage that "
            "moves: look at its actuator and its limits u_min_V, u_max_V"
        )
    slowness = float(np.clip(_rise_s(stage, low, high) / QUICK_S, 1.0, 20.0))
    return replace(plan, low_um=bottom + LOW_SHARE * span, high_um=bottom + HIGH_SHARE * span, slowness=slowness)


def _rise_s(stage: Stage, low_V: float, high_V: float) -> float:
    """Time to 63 % of the response to a small step, s."""
    dt_s, middle = stage.config.dt_s, 0.5 * (low_V + high_V)
    n = round(0.5 / dt_s)
    drive = np.concatenate([np.full(n, middle), np.full(n, middle + 0.1 * (high_V - low_V))])
    y_um, _ = stage.run(stage.initial_state(), drive)
    rise = (y_um[n:] - y_um[n - 10 : n].mean()) / (y_um[-10:].mean() - y_um[n - 10 : n].mean())
    there = np.flatnonzero(rise > 0.63)
    return float(there[0]) * dt_s if there.size else 0.5


def _from_zero(config: StageConfig) -> StageConfig:
    """The stage without the sensor offset that a diagnosis found, so that it reads zero at rest.

    With the offset a change of the gain would shift the rest position by a meaningless amount.
    """
    if OFFSET not in config.effects:
        return config
    return replace(config, effects=config.effects.replace({f"{OFFSET}.offset_um": 0.0}))


def _able_to_drift(config: StageConfig) -> StageConfig:
    """The stage with a gain that can change half way; if the file has none, a constant one is added."""
    if any(e.label == "gain_drift" for e in config.effects):
        return config
    still = effect("gain_drift", ramp_per_min=0.0)
    return replace(config, effects=config.effects + still)


def _payload(config: StageConfig) -> float:
    """Mass to add over mass moved; zero if no effect of the file depends on it."""
    return 1.0 if any(e.name in ("resonance", "mechanics") for e in config.effects) else 0.0
