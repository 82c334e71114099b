"""Simulated stages: configuration, presets, stage files, stepping, and control of a stage."""

from dehyst.sim.stage.config import ParameterChange, StageConfig
from dehyst.sim.stage.file import load_stage, save_stage
from dehyst.sim.stage.presets import PRESETS, preset
from dehyst.sim.stage.stage import Stage, StageState, Trace

__all__ = [
    "PRESETS",
    "ParameterChange",
    "Stage",
    "StageConfig",
    "StageState",
    "Trace",
    "load_stage",
    "preset",
    "save_stage",
]
