"""Axes for tests: the loop of one without a wire."""

from __future__ import annotations

from typing import Any

from dehyst.service.intake.sample_queue import SampleQueue
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loop import AxisLoop


def loop_of(axis: Axis, sink: Any = None, **more: Any) -> AxisLoop:
    """The loop of ``axis`` with its own queue; not started, and nobody is woken."""
    return AxisLoop(axis, SampleQueue(axis.config.name, axis.config.queue_samples), lambda: None, sink, **more)
