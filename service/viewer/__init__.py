"""The viewer stream: what a running service does, drawn in the Rerun viewer or written to an ``.rrd`` file.

`Consumer` subscribes to a stage and its service and forms batches of records (`service.viewer.records`). `Output`
passes them through a bounded queue to a process of its own, where a scene turns them into curves and `rerun_sink`, the
only module that knows Rerun, draws them. `write_recording` draws a run that was computed. The names are loaded on first
use: the records alone load neither zenoh nor Rerun.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.viewer.consumer import Consumer, ConsumerConfig
    from service.viewer.output import Output, OutputConfig
    from service.viewer.records import Diagnostics, Event, Health, Record, SceneConfig, Status, Tracking
    from service.viewer.rerun_sink import write_recording

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
    "Diagnostics": "records",
    "Event": "records",
    "Health": "records",
    "Record": "records",
    "SceneConfig": "records",
    "Status": "records",
    "Tracking": "records",
    "Consumer": "consumer",
    "ConsumerConfig": "consumer",
    "Output": "output",
    "OutputConfig": "output",
    "write_recording": "rerun_sink",
}

__getattr__ = lazy_names(__name__, _MODULES)
