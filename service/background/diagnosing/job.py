"""One diagnosis in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from adaptive.types import FloatArray
from service.background.job import BackgroundJob


class Job(BackgroundJob):
    """Runs ``service.background.diagnosing.worker`` on (4, n) samples ``reference`` and ``recent``, once it is started.

    ``order`` and result: see ``service.background.diagnosing.worker.diagnose``.
    """

    def __init__(
        self,
        order: dict[str, Any],
        reference: FloatArray,
        recent: FloatArray,
        timeout_s: float,
        done: Callable[[dict[str, Any]], None],
    ) -> None:
        arrays = {"reference": reference, "recent": recent}
        super().__init__("service.background.diagnosing.worker", order, arrays, timeout_s, done)
