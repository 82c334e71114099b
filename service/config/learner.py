"""Settings of the learner from a file: a service's configuration (one axis of it), or a file of the settings alone.

Apart from the other settings, because the learner's configuration needs numba, and a thin client has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dehyst.adaptive.online.config import LearnerConfig
from dehyst.service.answers.guard import Limits
from dehyst.service.config.schema import build_settings, parse_toml, read_text
from dehyst.service.config.settings import AxisConfig, parse_config
from dehyst.service.protocol.errors import FieldError


@dataclass(frozen=True, slots=True)
class LearnerSettings:
    """``settings`` as in an ``[axis.learner]`` table; ``axis`` where a service's configuration has them."""

    settings: dict[str, Any]
    axis: AxisConfig | None = None


def learner_config(settings: dict[str, Any], limits: Limits, where: str) -> LearnerConfig:
    """The learner's configuration by the table ``where``. Raises InputError on an unknown setting.

    The learner treats a voltage at a limit as saturated: the limits of the axis, unless the settings give others.
    """
    gates = settings.get("admission", {})
    if isinstance(gates, dict):
        gates = {"u_min_V": limits.u_min_V, "u_max_V": limits.u_max_V, **gates}
    return build_settings(LearnerConfig, {**settings, "admission": gates}, where)


def read_learner_settings(path: Path, axis: str | None = None) -> LearnerSettings:
    """Read and check a TOML file.

    A file with ``[[axis]]`` tables is a service's configuration: the settings are those of the axis with that name, or
    of the only axis. Any other file has the settings themselves, at the top or in a table ``[learner]``. Raises
    InputError naming what is wrong.
    """
    text = read_text(path)
    data = parse_toml(text, str(path))
    if "axis" in data:
        axes = parse_config(text, str(path), path.parent).axes
        named = [entry for entry in axes if axis in (None, entry.name)]
        if len(named) != 1:
            got = repr(axis) if axis is not None else f"{len(axes)} axes and no choice"
            raise FieldError("--axis", got, f"one of {', '.join(entry.name for entry in axes)}")
        found = LearnerSettings(dict(named[0].learner), named[0])
    elif axis is not None:
        raise FieldError("--axis", repr(axis), f"nothing, as {path} has no [[axis]] tables")
    else:
        found = LearnerSettings(data.get("learner", {}) if set(data) == {"learner"} else data)
    build_settings(LearnerConfig, found.settings, f"{path}:")
    return found
