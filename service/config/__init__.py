"""Configuration of the service: schema, example, reference page, and the learner's settings from a file.

`read_config` reads a file of ``dehyst serve`` into a `ServeConfig`. Names are imported on first use, because the
configuration imports zenoh and its parser (`service.config.schema`) does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.config.learner import LearnerSettings as LearnerSettings
    from dehyst.service.config.learner import read_learner_settings as read_learner_settings
    from dehyst.service.config.schema import Setting as Setting
    from dehyst.service.config.schema import build_settings as build_settings
    from dehyst.service.config.settings import AxisConfig as AxisConfig
    from dehyst.service.config.settings import ServeConfig as ServeConfig
    from dehyst.service.config.settings import parse_config as parse_config
    from dehyst.service.config.settings import read_config as read_config

__getattr__ = lazy_names(__name__)
