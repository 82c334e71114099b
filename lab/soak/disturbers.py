"""Processes that disturb a soak: a slow subscriber, and a busy core.

``python -m dehyst.lab.soak.disturbers slow|busy ENDPOINT`` prints ``ready`` and runs until it is stopped.
"""

from __future__ import annotations

import sys
import time

from dehyst.lab.soak.controller import AXIS, STAGE
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client
from dehyst.service.runtime.stopping import StopSignal


def slow(endpoint: str) -> None:
    """Subscribe to all keys of the axis and take 50 ms for each message."""
    stop = StopSignal()
    with open_client(endpoint, 20.0) as session:
        subscriber = session.declare_subscriber(f"{Keys(STAGE, AXIS).base}/**", lambda _: time.sleep(0.05))
        print("ready", flush=True)
        stop.wait()
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def busy() -> None:
    """Keep one core busy."""
    stop = StopSignal()
    print("ready", flush=True)
    value = 1.0
    while not stop.reason:
        for _ in range(100_000):
            value = value * 1.0000001 % 2.0


if __name__ == "__main__":
    busy() if sys.argv[1] == "busy" else slow(sys.argv[2])
