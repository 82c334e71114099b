"""What a service needs before it starts: models identified on a simulated stage, and a configuration file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from adaptive.errors import InputError, NumericsError
from adaptive.types import InverseModel
from service.identification.identifying import identify_one
from service.storage.model_file import BundleMeta, write_bundle
from sim.signals.voltages import training_input
from sim.stage.config import StageConfig
from sim.stage.stage import Stage

#: Length of the identification signal, s, and size of the window of the models with one.
IDENTIFY_S: Final = 10.0
WINDOW: Final = 500


@dataclass(frozen=True, slots=True)
class IdentifiedStage:
    """Models by name, and the displacements, µm, that the identification signal reached."""

    models: dict[str, InverseModel]
    low_um: float
    high_um: float


def identify_stage(
    config: StageConfig, file: Path, stage: str, axis: str, names: Sequence[str], required: str
) -> IdentifiedStage:
    """Drive the stage with the chapter's training signal (2.37) and write the models ``names`` to ``file``.

    Other models than ``required`` are left out if they do not fit the stage. Raises InputError if ``required`` does
    not fit.
    """
    u_V = training_input(config.dt_s, IDENTIFY_S)[1].clip(config.u_min_V, config.u_max_V)
    simulated = Stage(config)
    y_um, _ = simulated.run(simulated.initial_state(), u_V)
    models: dict[str, InverseModel] = {}
    for name in names:
        try:
            models[name] = identify_one(name, u_V, y_um, config.dt_s, WINDOW)
        except (InputError, NumericsError) as error:
            if name == required:
                raise InputError(f"stage {config.name!r}: cannot be identified: {error}") from error
    found = IdentifiedStage(models, float(y_um.min()), float(y_um.max()))
    meta = BundleMeta(stage, axis, config.dt_s, config.name, y_min_um=found.low_um, y_max_um=found.high_um)
    write_bundle(file, models, meta)
    return found


def write_service_config(
    path: Path, stage: str, axis: Mapping[str, Any], *, listen: Sequence[str] = (), connect: Sequence[str] = ()
) -> None:
    """Write the configuration of a service with one axis. A value of ``axis`` that is a mapping becomes a table."""
    lines = [f"stage = {_toml(stage)}", f"listen = {_toml(listen)}"]
    if connect:
        lines.append(f"connect = {_toml(connect)}")
    lines += ["", "[[axis]]", *(f"{k} = {_toml(v)}" for k, v in axis.items() if not isinstance(v, Mapping))]
    for name, values in axis.items():
        if isinstance(values, Mapping):
            lines += [f"[axis.{name}]", *(f"{k} = {_toml(v)}" for k, v in values.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, Path):
        return json.dumps(str(value.resolve()))
    return json.dumps(list(value) if isinstance(value, tuple) else value)
