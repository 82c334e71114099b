"""Diagnosis in the background: when the error of a model grows, a process finds out what changed in the stage.

`Watcher` keeps the recent samples of an axis, raises an alarm and starts the process, as `WatchConfig` says. The names
are loaded on first use: the configuration needs `WatchConfig` only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.background.diagnosing.alarm import Alarm as Alarm
    from service.background.diagnosing.buffer import SampleBuffer as SampleBuffer
    from service.background.diagnosing.settings import WatchConfig as WatchConfig
    from service.background.diagnosing.watcher import Watcher as Watcher

__getattr__ = lazy_names(__name__)
