"""Processes that disturb a soak: a slow subscriber, a busy core, and a client that sends malformed messages.

``python -m lab.soak.disturbers slow|busy|malformed ENDPOINT BASE_KEY [SEED]`` prints ``ready`` and runs until it is
stopped; BASE_KEY is that of the axis. A fault begins with ``ready``, perhaps on cores that have no time left: this
module imports numpy only for the process that needs it.
"""

from __future__ import annotations

import sys
import time

from service.runtime.session import open_client
from service.runtime.stopping import StopSignal


def slow(endpoint: str, base_key: str) -> int:
    """Subscribe to all keys of the axis and take 50 ms for each message."""
    stop = StopSignal()
    with open_client(endpoint, 20.0) as session:
        subscriber = session.declare_subscriber(f"{base_key}/**", lambda _: time.sleep(0.05))
        print("ready", flush=True)
        stop.wait()
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return 0


def busy() -> int:
    """Keep one core busy."""
    stop = StopSignal()
    print("ready", flush=True)
    value = 1.0
    while not stop.reason:
        for _ in range(100_000):
            value = value * 1.0000001 % 2.0
    return 0


def main(argv: list[str]) -> int:
    """Entry of the process. Returns its exit status."""
    what, endpoint, base_key = argv[:3]
    if what == "slow":
        return slow(endpoint, base_key)
    if what == "busy":
        return busy()
    from lab.soak.malformed_client import send_malformed

    return send_malformed(endpoint, base_key, int(argv[3]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
