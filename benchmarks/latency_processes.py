"""The processes beside a latency benchmark: a bare zenoh echo, and a stage that sends samples at a steady rate.

``python -m benchmarks.latency_processes echo ENDPOINT`` and ``... feed ENDPOINT FILE.npz RATE_HZ BATCH MESSAGE``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import zenoh

from adaptive.types import FloatArray
from service.protocol import samples as wire
from service.protocol.keys import Keys
from service.protocol.samples import SampleBatch
from service.runtime.delivery import SURELY, wait_followed
from service.runtime.session import open_client, open_service
from service.runtime.stopping import StopSignal
from service.server.process import tune_process

#: Where the echo answers: the number of bytes of its reply stands in the key.
ECHO_KEY = "echo"
STAGE, AXIS = "bench", "x"
#: How long the stage waits for somebody to listen before its first sample, and for its last one to be on its way, s.
_HEARD_S = 20.0
_FLUSH_S = 0.3


def echo(endpoint: str) -> int:
    """Answer every query on ``echo/BYTES`` with as many bytes, the payload read as the service reads it."""
    tune_process()
    stop = StopSignal()

    def answer(query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            if query.payload is not None:
                query.payload.to_bytes()
            query.reply(key, bytes(int(key.rpartition("/")[2])))

    with open_service([endpoint]) as session:
        queryable = session.declare_queryable(f"{ECHO_KEY}/*", answer)
        print("ready", flush=True)
        stop.wait()
        queryable.undeclare()
    return 0


def sent(u_V: FloatArray, y_um: FloatArray, rate_hz: float, batch: int, message: int) -> SampleBatch:
    """The samples of message number ``message``: (n,) voltages V and readings µm over and over, ``batch`` a message."""
    seq = np.arange(message * batch, (message + 1) * batch)
    at = message % (u_V.size // batch) * batch
    return SampleBatch(seq, seq / rate_hz, u_V[at : at + batch], y_um[at : at + batch])


def feed(endpoint: str, path: Path, rate_hz: float, batch: int, first: int) -> int:
    """Publish the samples in ``path`` (arrays u_V and y_um) at ``rate_hz``, over and over, ``batch`` a message, from
    message number ``first`` on.

    Begins when it is heard, so that the first sample that it counts is the first that arrives.
    """
    stop = StopSignal()
    with np.load(path) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    with open_client(endpoint, 10.0) as session:
        publisher = session.declare_publisher(Keys(STAGE, AXIS).sample, congestion_control=SURELY, express=True)
        if not wait_followed(publisher, _HEARD_S):
            print("nobody listens to the samples", file=sys.stderr)
            return 1
        print("ready", flush=True)
        start, k, late, worst_s = time.perf_counter(), 0, 0, 0.0
        while not stop.reason:
            due = start + (k + 1) * batch / rate_hz
            rest = due - time.perf_counter()
            if rest > 0.0:
                time.sleep(rest)
            elif -rest > batch / rate_hz:
                late += 1
            worst_s = max(worst_s, -rest)
            made = sent(u_V, y_um, rate_hz, batch, first + k)
            publisher.put(wire.encode_samples(made.seq, made.t_s, made.u_V, made.y_um))
            k += 1
        taken_s = time.perf_counter() - start
        time.sleep(_FLUSH_S)
        publisher.undeclare()  # type: ignore[no-untyped-call]
    told = {"sent": k * batch, "rate_hz": k * batch / taken_s, "late": late, "worst_late_ms": 1e3 * worst_s}
    print(json.dumps(told), flush=True)
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        sys.exit(echo(sys.argv[2]))
    sys.exit(feed(sys.argv[2], Path(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]), int(sys.argv[6])))
