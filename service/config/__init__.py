"""Configuration of the service: schema, example, reference page, and the learner's settings from a file.

`read_config` reads a file of ``dehyst serve`` into a `ServeConfig`. Names are imported on first use, because the
configuration imports zenoh and its parser (`service.config.schema`) does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.config.learner import LearnerSettings, read_learner_settings
    from service.config.schema import Setting, build_settings
    from service.config.settings import AxisConfig, ServeConfig, parse_config, read_config

_MODULES = {
    "AxisConfig": "settings",
    "LearnerSettings": "learner",
    "ServeConfig": "settings",
    "Setting": "schema",
    "build_settings": "schema",
    "parse_config": "settings",
    "read_config": "settings",
    "read_learner_settings": "learner",
}
__all__ = [
    "AxisConfig",
    "LearnerSettings",
    "ServeConfig",
    "Setting",
    "build_settings",
    "parse_config",
    "read_config",
    "read_learner_settings",
]

__getattr__ = lazy_names(__name__, _MODULES)
