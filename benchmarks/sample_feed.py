"""The stage of a latency benchmark as a process: it publishes recorded samples over and over at a steady rate.

``python -m benchmarks.sample_feed ENDPOINT FILE.npz RATE_HZ BATCH MESSAGE``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.runtime.session import SURELY, open_client, wait_followed
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.security.authenticator import own_authenticator

STAGE, AXIS = "bench", "x"
#: How long the stage waits for a subscriber before its first sample, s.
_SUBSCRIBED_S = 20.0
#: How long the last message may take to leave the process, s.
_FLUSH_S = 0.3


def sent(u_V: FloatArray, y_um: FloatArray, rate_hz: float, batch: int, message: int) -> SampleBatch:
    """The samples of message number ``message``, ``batch`` of them, from (n,) voltages, V, and readings, µm."""
    seq = np.arange(message * batch, (message + 1) * batch)
    at = message % (u_V.size // batch) * batch
    return SampleBatch(seq, seq / rate_hz, u_V[at : at + batch], y_um[at : at + batch])


def feed(endpoint: str, path: Path, rate_hz: float, batch: int, first: int) -> int:
    """Publish the samples in ``path`` (arrays u_V and y_um) at ``rate_hz``, over and over, ``batch`` a message, from
    message number ``first`` on.

    Begins when there is a subscriber, so that the first sample counted is the first that arrives.
    """
    stop = StopSignal()
    with np.load(path) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    with open_client(endpoint, 10.0) as session:
        by, key = own_authenticator(), Keys(STAGE, AXIS).sample
        publisher = session.declare_publisher(key, congestion_control=SURELY, express=True)
        if not wait_followed(publisher, _SUBSCRIBED_S):
            print("no subscriber to the samples", file=sys.stderr)
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
            payload = wire.encode_samples(made.seq, made.t_s, made.u_V, made.y_um)
            publisher.put(payload, attachment=by.published(key, payload))
            k += 1
        taken_s = time.perf_counter() - start
        time.sleep(_FLUSH_S)
        publisher.undeclare()  # type: ignore[no-untyped-call]
    told = {"sent": k * batch, "rate_hz": k * batch / taken_s, "late": late, "worst_late_ms": 1e3 * worst_s}
    print(json.dumps(told), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(feed(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5])))
