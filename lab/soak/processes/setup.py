"""What a soak needs before it starts: an identified stage, and the services' configurations."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from adaptive.errors import InputError, NumericsError
from adaptive.types import InverseModel
from lab.soak.processes.control import AXIS, SERVED, STAGE, Control
from service.identification.identifying import identify_one
from service.storage.model_file import BundleMeta, write_bundle
from sim.signals.signals import training_input
from sim.stage.config import StageConfig
from sim.stage.file import load_stage, save_stage
from sim.stage.presets import preset
from sim.stage.stage import Stage

#: Models of the service: the default, what it falls back to, and the baseline that any stage has.
MODELS = ("linear", "mpi", SERVED)
IDENTIFY_S = 10.0
#: Margins of the reference to the ends of the identified range, as shares of it.
LOW_SHARE, HIGH_SHARE = 0.05, 0.10
#: Share of the voltage range that may be passed in a millisecond.
SLEW_SHARE_PER_MS = 1.0 / 3.0


def stage_of(file: Path | None, seed: int) -> StageConfig:
    """The stage to soak with: that of a file, or the one that stands in for hardware. Raises InputError."""
    config = preset("rich") if file is None else load_stage(file)
    return replace(config, seed=seed, changes=())


def identify(config: StageConfig, path: Path, seed: int) -> Control:
    """Drive the stage with the chapter's signal, write the models to ``path``, and say what can be commanded.

    Raises InputError where the stage cannot be identified.
    """
    u_V = training_input(config.dt_s, IDENTIFY_S)[1].clip(config.u_min_V, config.u_max_V)
    stage = Stage(config)
    y_um, _ = stage.run(stage.initial_state(), u_V)
    models: dict[str, InverseModel] = {}
    for name in MODELS:
        try:
            models[name] = identify_one(name, u_V, y_um, config.dt_s, 500)
        except (InputError, NumericsError) as error:
            # A baseline may not fit a stage from a file; the model that is served has to.
            if name == SERVED:
                raise InputError(f"stage {config.name!r}: cannot be identified: {error}") from error
    low, high = float(np.min(y_um)), float(np.max(y_um))
    span = high - low
    write_bundle(path, models, BundleMeta(STAGE, AXIS, config.dt_s, config.name, y_min_um=low, y_max_um=high))
    return Control(
        dt_s=config.dt_s,
        low_um=low + LOW_SHARE * span,
        high_um=high - HIGH_SHARE * span,
        seed=seed,
        u_min_V=config.u_min_V,
        u_max_V=config.u_max_V,
        slew_V_per_s=1000.0 * SLEW_SHARE_PER_MS * (config.u_max_V - config.u_min_V),
    )


def write_stage(config: StageConfig, path: Path) -> None:
    """The stage for its process."""
    save_stage(config, path)


def write_service(path: Path, control: Control, model: Path, router: str, folder: Path) -> None:
    """Configuration of one serving process behind a router, its recordings and checkpoints in ``folder``."""
    path.write_text(
        f'stage = "{STAGE}"\nlisten = []\nconnect = ["{router}"]\n\n'
        f'[[axis]]\nname = "{AXIS}"\nmodel = {json.dumps(str(model.resolve()))}\n'
        f"u_min_V = {control.u_min_V}\nu_max_V = {control.u_max_V}\nslew_V_per_s = {control.slew_V_per_s}\n"
        f"snapshot_every = {control.block}\n"
        f"recorder = {json.dumps(str((folder / 'recording').resolve()))}\n"
        f"checkpoints = {json.dumps(str((folder / 'checkpoints').resolve()))}\n",
        encoding="utf-8",
    )
