"""A measuring client of a soak as a process: it asks for one point after the other, and follows the model.

``python -m dehyst.lab.soak.prober TASK.json ENDPOINT`` prints a line of JSON every second: round trips in µs, the
longest time without an answer, answers that broke a promise, and the age of the followed model at each query.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.lab.soak.controller import AXIS, STAGE, ControlTask
from dehyst.lab.testbed.processes import run_client_process
from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.query import Point
from dehyst.service.runtime.stopping import StopSignal

#: Pause between two queries, s; time after which a query counts as not answered and the next one is sent, s.
PAUSE_S: Final = 0.01
TIMEOUT_S: Final = 0.1


class Prober:
    """Counts what happens in the present second. ``ask`` asks for a point that continues another one or None."""

    def __init__(self, control: ControlTask, ask: Callable[[Point | None], Point]) -> None:
        self._control, self._ask = control, ask
        self._last: Point | None = None
        self._answered_s = time.monotonic()
        self._clear()

    def _clear(self) -> None:
        self.counts: dict[str, Any] = {"trips_us": [], "ages_s": [], "failed": 0, "unsafe": 0, "silent_s": 0.0}

    def probe(self) -> None:
        """Ask for a point, and count what is wrong with the answer."""
        begin, counts = time.perf_counter(), self.counts
        try:
            point = self._ask(self._last)
        except (ServiceError, InputError) as error:
            # An answer that cannot be decoded is worse than none. The model may have changed: ask without a memory.
            counts["unsafe" if isinstance(error, InputError) else "failed"] += 1
            self._last = None
            return
        counts["trips_us"].append(round(1e6 * (time.perf_counter() - begin), 1))
        now = time.monotonic()
        counts["silent_s"] = max(counts["silent_s"], now - self._answered_s)
        self._answered_s = now
        before_V = math.nan if self._last is None else self._last.u_V
        counts["unsafe"] += not self._control.allows(np.array([point.u_V]), before_V)
        self._last = point

    def report(self) -> str:
        """The JSON line of the second; begins a new second."""
        # Includes a silence that has not ended.
        self.counts["silent_s"] = round(max(self.counts["silent_s"], time.monotonic() - self._answered_s), 4)
        line = json.dumps({"t_s": round(time.monotonic(), 3), **self.counts})
        self._clear()
        return line


def run(task: ControlTask, endpoint: str) -> int:
    """Query the service behind ``endpoint`` until stopped."""
    stop = StopSignal()
    y_um = 0.5 * (task.low_um + task.high_um)
    with Client.connect(endpoint, STAGE, AXIS, timeout_s=TIMEOUT_S, retry_s=0.0, wait_s=30.0) as client:
        client.status()
        prober = Prober(task, lambda before: client.point(y_um, after=before))
        follower = client.follow()
        print("ready", flush=True)
        next_s = time.monotonic() + 1.0
        while not stop.reason:
            prober.probe()
            time.sleep(PAUSE_S)
            prober.counts["ages_s"].append(round(follower.age_s, 4))
            if time.monotonic() >= next_s:
                next_s += 1.0
                print(prober.report(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_client_process(lambda: run(ControlTask.read(Path(sys.argv[1])), sys.argv[2])))
