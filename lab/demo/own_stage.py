"""The demonstration on a stage of one's own: what of the plan depends on the stage, measured on the stage itself."""

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

#: Share of the voltage limits that identification uses, and what the reference commands of the range found by it.
DRIVE_SHARE, LOW_SHARE, HIGH_SHARE = 0.8, 0.045, 0.9
#: A stage that rises within this time, s, is asked for the usual reference; a slower one for a slower one.
QUICK_S = 4e-3


def plan_for(path: Path, folder: Path, run_s: float, seed: int) -> Plan:
    """The plan for the stage in the file ``path``; what is run is written into ``folder``.

    Voltages stay within ``DRIVE_SHARE`` of the file's limits; the commanded range is a share of what they reach. The
    sample time is the plan's own. Raises InputError where the stage does not move, or runs away.
    """
    base = Plan(run_s=run_s, seed=seed)
    config = replace(_able_to_drift(_from_zero(load_stage(path))), dt_s=base.dt_s, seed=seed)
    high = DRIVE_SHARE * config.u_max_V
    # A stage that is driven one way only stays so; one of both signs is driven both ways.
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
    """Time to 63 % of the response to a small step, s: a slow stage cannot follow what a quick one can."""
    dt_s, middle = stage.config.dt_s, 0.5 * (low_V + high_V)
    n = round(0.5 / dt_s)
    drive = np.concatenate([np.full(n, middle), np.full(n, middle + 0.1 * (high_V - low_V))])
    y_um, _ = stage.run(stage.initial_state(), drive)
    rise = (y_um[n:] - y_um[n - 10 : n].mean()) / (y_um[-10:].mean() - y_um[n - 10 : n].mean())
    there = np.flatnonzero(rise > 0.63)
    return float(there[0]) * dt_s if there.size else 0.5


def _from_zero(config: StageConfig) -> StageConfig:
    """The stage without the offset that a diagnosis found in its sensor: a rested stage reads zero.

    With it a change of the gain would move the rest position by its share of a number that means nothing.
    """
    if OFFSET not in config.effects:
        return config
    return replace(config, effects=config.effects.replace({f"{OFFSET}.offset_um": 0.0}))


def _able_to_drift(config: StageConfig) -> StageConfig:
    """The stage with a gain that can change half way; a file that has none is given one that stands still."""
    if any(e.label == "gain_drift" for e in config.effects):
        return config
    still = effect("gain_drift", ramp_per_min=0.0)
    return replace(config, effects=config.effects + still)


def _payload(config: StageConfig) -> float:
    """Mass to add over mass moved: none where no mode of the file could feel it."""
    return 1.0 if any(e.name in ("resonance", "mechanics") for e in config.effects) else 0.0
