"""The viewer stream: what a running service does, drawn in the Rerun viewer or written to an ``.rrd`` file.

`Consumer` subscribes to a stage and its service and forms batches of records (`service.viewer.records`). `Output`
passes them through a bounded queue to a process of its own, where a scene turns them into curves and `rerun_sink`, the
only module that knows Rerun, draws them. `write_recording` draws a run that was computed. The names are loaded on first
use: the records alone load neither zenoh nor Rerun.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from service.viewer.consumer import Consumer, ConsumerConfig
    from service.viewer.offline import write_recording
    from service.viewer.output import Output, OutputConfig
    from service.viewer.records import Diagnostics, Event, Health, Record, SceneConfig, Status, Tracking

__all__ = [
    "Consumer",
    "ConsumerConfig",
    "Diagnostics",
    "Event",
    "Health",
    "Output",
    "OutputConfig",
    "Record",
    "SceneConfig",
    "Status",
    "Tracking",
    "write_recording",
]

_MODULES: Final = {
    "Diagnostics": "service.viewer.records",
    "Event": "service.viewer.records",
    "Health": "service.viewer.records",
    "Record": "service.viewer.records",
    "SceneConfig": "service.viewer.records",
    "Status": "service.viewer.records",
    "Tracking": "service.viewer.records",
    "Consumer": "service.viewer.consumer",
    "ConsumerConfig": "service.viewer.consumer",
    "Output": "service.viewer.output",
    "OutputConfig": "service.viewer.output",
    "write_recording": "service.viewer.offline",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
