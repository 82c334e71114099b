"""The serving process: `Service` runs an `AxisServer` for each axis, whose `AxisLoop` is the life of an `Axis`.

`load_axis` makes an axis from its model file. The names are loaded on first use, because
replay and rehearsals need an `Axis` without the process.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.server.axis import Axis as Axis
    from dehyst.service.server.axis import EventLog as EventLog
    from dehyst.service.server.axis_loading import load_axis as load_axis
    from dehyst.service.server.axis_loop import AxisLoop as AxisLoop
    from dehyst.service.server.axis_server import AxisServer as AxisServer
    from dehyst.service.server.process import Service as Service

__getattr__ = lazy_names(__name__)
