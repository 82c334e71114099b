"""Small processes beside a soak: echo, slow subscriber, busy core, a client that sends rubbish.

``python -m service.soak.extras WHAT ENDPOINT [ARGUMENTS]``; each says ``ready`` and goes on until it is ended.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import zenoh

from service.keys import Keys
from service.server import tune_process
from service.session import open_client
from service.soak.setup import AXIS, STAGE
from service.stopping import StopSignal
from service.wire_query import encode_query

#: Where the echo answers: the number of bytes of its reply stands in the key.
ECHO_KEY = "soak_echo"


def echo(endpoint: str) -> int:
    """Answer queries on ``soak_echo/BYTES`` with as many bytes: what the wire alone takes."""
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


def rubbish(endpoint: str, seed: int) -> int:
    """Ask what cannot be answered, as quickly as the answers come; prints how many got an error, an answer, nothing."""
    stop = StopSignal()
    rng = np.random.default_rng(seed)
    keys = Keys(STAGE, AXIS)
    got = {"error": 0, "answer": 0, "nothing": 0}
    with open_client(endpoint, 20.0) as session:
        print("ready", flush=True)
        while not stop.reason:
            said = "nothing"
            for reply in session.get(keys.feedforward, payload=_bad_payload(rng), timeout=1.0):
                said = "error" if reply.err is not None else "answer"
            got[said] += 1
            # Nobody is to be kept from asking: a burst is many, not all there is room for.
            time.sleep(0.001)
    print(json.dumps(got), flush=True)
    return 0


def _bad_payload(rng: np.random.Generator) -> bytes:
    good = encode_query([40.0], [0.0], [0.0])
    choice = int(rng.integers(6))
    if choice == 0:
        return rng.bytes(int(rng.integers(0, 400)))
    if choice == 1:
        return good[: int(rng.integers(len(good)))]
    if choice == 2:
        return good + rng.bytes(int(rng.integers(1, 200_000)))
    if choice == 3:
        return encode_query([1e9], [0.0], [0.0])
    if choice == 4:
        return encode_query([40.0], [0.0], [0.0], memory=np.zeros(int(rng.integers(100, 4000))))
    return encode_query([40.0], [0.0], [0.0], model="nobody")


if __name__ == "__main__":
    what, where = sys.argv[1], sys.argv[2]
    if what == "rubbish":
        sys.exit(rubbish(where, int(sys.argv[3])))
    sys.exit({"echo": echo, "slow": slow, "busy": busy}[what](where))
