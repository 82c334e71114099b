"""The viewer stream: what a running service does, drawn in the Rerun viewer or written to an ``.rrd`` file.

`Consumer` subscribes to a stage and its service and forms batches of records (`service.viewer.records`). `Output`
passes them through a bounded queue to a process of its own, where a scene turns them into curves and `rerun_sink`, the
only module that knows Rerun, draws them. `write_recording` draws a run that was computed. The names are loaded on first
use: the records alone load neither zenoh nor Rerun.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.viewer.computed_run import write_recording as write_recording
    from dehyst.service.viewer.records import Event as Event
    from dehyst.service.viewer.records import SceneConfig as SceneConfig
    from dehyst.service.viewer.records import Tracking as Tracking

__getattr__ = lazy_names(__name__)
