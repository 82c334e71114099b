"""Settings of the learner from a file: that of a service, of which one axis is taken, or a small one of their own."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adaptive.online.config import LearnerConfig
from service.config.config import AxisConfig, parse_config
from service.config.tables import build_settings
from service.protocol.errors import FieldError


@dataclass(frozen=True, slots=True)
class LearnerSettings:
    """``settings`` as in an ``[axis.learner]`` table; ``axis`` where they came from a service's configuration."""

    settings: dict[str, Any]
    axis: AxisConfig | None = None


def read_learner_settings(path: Path, axis: str | None = None) -> LearnerSettings:
    """Read and check a TOML file.

    A file with ``[[axis]]`` tables is a service's configuration: the axis of that name, or its only one, is taken. Any
    other holds the settings themselves, at the top or in a table ``[learner]``. Raises InputError naming what is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
        data = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise FieldError(str(path), str(error), "a readable TOML file") from error
    except tomllib.TOMLDecodeError as error:
        raise FieldError(str(path), f"no TOML ({error})", "a TOML file", "mend the line named") from error
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
    build_settings(LearnerConfig, found.settings, str(path))
    return found
