"""The processes beside a latency benchmark: a bare zenoh echo, and a stage that sends samples at a steady rate.

``python -m benchmarks.latency_processes echo ENDPOINT`` and ``... feed ENDPOINT FILE.npz RATE_HZ BATCH``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import zenoh

from service import wire
from service.keys import Keys
from service.server import tune_process
from service.session import open_client, open_service
from service.stopping import StopSignal

#: Where the echo answers: the number of bytes of its reply stands in the key.
ECHO_KEY = "echo"
STAGE, AXIS = "bench", "x"


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


def feed(endpoint: str, path: Path, rate_hz: float, batch: int) -> int:
    """Publish the samples in ``path`` (arrays u_V and y_um) at ``rate_hz``, over and over, ``batch`` a message."""
    stop = StopSignal()
    with np.load(path) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    n = u_V.size // batch
    with open_client(endpoint, 10.0) as session:
        block = zenoh.CongestionControl.BLOCK
        publisher = session.declare_publisher(Keys(STAGE, AXIS).sample, congestion_control=block, express=True)
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
            seq = np.arange(k * batch, (k + 1) * batch)
            at = slice(k % n * batch, (k % n + 1) * batch)
            publisher.put(wire.encode_samples(seq, seq / rate_hz, u_V[at], y_um[at]))
            k += 1
        taken_s = time.perf_counter() - start
        publisher.undeclare()  # type: ignore[no-untyped-call]
    told = {"sent": k * batch, "rate_hz": k * batch / taken_s, "late": late, "worst_late_ms": 1e3 * worst_s}
    print(json.dumps(told), flush=True)
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        sys.exit(echo(sys.argv[2]))
    sys.exit(feed(sys.argv[2], Path(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5])))
