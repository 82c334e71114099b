"""The serving process: `Service` runs an `AxisServer` for each axis, whose `AxisLoop` is the life of an `Axis`.

`load_axis` makes an axis from its model file, `axis_status` its status. The names are loaded on first use, because
replay and rehearsals need an `Axis` without the process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.server.axis import Axis, EventLog
    from service.server.axis_loading import load_axis
    from service.server.axis_loop import AxisLoop
    from service.server.axis_server import AxisServer
    from service.server.process import Service
    from service.server.status import axis_status

_MODULES = {
    "Axis": "axis",
    "AxisLoop": "axis_loop",
    "AxisServer": "axis_server",
    "EventLog": "axis",
    "Service": "process",
    "axis_status": "status",
    "load_axis": "axis_loading",
}
__all__ = [
    "Axis",
    "AxisLoop",
    "AxisServer",
    "EventLog",
    "Service",
    "axis_status",
    "load_axis",
]

__getattr__ = lazy_names(__name__, _MODULES)
