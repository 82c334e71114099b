"""The axis that a replay runs: the configuration's own, or one around settings of the learner alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from service.config import AxisConfig
from service.errors import FieldError
from service.guard import Limits
from service.learner_settings import LearnerSettings
from service.modelfile import Bundle

DEFAULT_LEARN: Final = "lssvm_adaptive"
#: Nothing is commanded in a replay; limits so far out that they refuse nothing, unless the settings set their own.
_FAR: Final = 1e3


def axis_config(found: LearnerSettings, path: Path, bundle: Bundle, learn: str | None) -> AxisConfig:
    """Configuration of the axis for a model file. Raises InputError where the model to learn is not in it."""
    if found.axis is not None:
        config = replace(found.axis, model=path, learn=learn or found.axis.learn)
    else:
        volts = [abs(u) for u in (bundle.meta.u_min_V, bundle.meta.u_max_V) if u is not None]
        far = _FAR * max([1.0, *volts])
        name = learn or DEFAULT_LEARN
        config = AxisConfig(
            "replay", path, Limits(-far, far, float("inf")), served=name, learn=name, learner=found.settings
        )
    if config.learn not in bundle.models:
        raise FieldError("--learn", repr(config.learn), f"one of the models in {path}: {', '.join(bundle.models)}")
    if config.served not in bundle.models:
        config = replace(config, served=config.learn)
    return config
