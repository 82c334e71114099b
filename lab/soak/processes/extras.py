"""Small processes beside a soak: echo, slow subscriber, busy core, and a client that sends rubbish.

``python -m lab.soak.processes.extras WHAT ENDPOINT [ARGUMENTS]``; each says ``ready`` and goes on until it is ended.
A fault
begins when it does, on cores that have no time: what takes long to import is imported by who needs it.
"""

from __future__ import annotations

import sys
import time

import zenoh

from lab.soak.processes.control import AXIS, STAGE
from service.protocol.keys import Keys
from service.runtime.session import open_client
from service.runtime.stopping import StopSignal

#: Where the echo answers: the number of bytes of its reply stands in the key.
ECHO_KEY = "soak_echo"


def echo(endpoint: str) -> int:
    """Answer queries on ``soak_echo/BYTES`` with as many bytes: what the wire alone takes."""
    from service.server.process import tune_process

    tune_process()
    stop = StopSignal()

    def answer(query: zenoh.Query) -> None:
        with query:
            if query.payload is not None:
                query.payload.to_bytes()
            key = str(query.key_expr)
            query.reply(key, bytes(int(key.rpartition("/")[2])))

    with open_client(endpoint, 20.0) as session:
        queryable = session.declare_queryable(f"{ECHO_KEY}/*", answer)
        print("ready", flush=True)
        stop.wait()
        queryable.undeclare()  # type: ignore[no-untyped-call]
    return 0


def slow(endpoint: str) -> int:
    """Subscribe to everything of the axis and take 50 ms for each message."""
    stop = StopSignal()
    with open_client(endpoint, 20.0) as session:
        subscriber = session.declare_subscriber(f"{Keys(STAGE, AXIS).base}/**", lambda _: time.sleep(0.05))
        print("ready", flush=True)
        stop.wait()
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return 0


def busy(_: str) -> int:
    """Use up one core."""
    stop = StopSignal()
    print("ready", flush=True)
    value = 1.0
    while not stop.reason:
        for _i in range(100_000):
            value = value * 1.0000001 % 2.0
    return 0


if __name__ == "__main__":
    what, where = sys.argv[1], sys.argv[2]
    if what == "rubbish":
        from lab.soak.faults.bad_client import rubbish

        sys.exit(rubbish(where, int(sys.argv[3])))
    sys.exit({"echo": echo, "slow": slow, "busy": busy}[what](where))
