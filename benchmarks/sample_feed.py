"""The stage of a latency benchmark as a process: it publishes recorded samples over and over at a steady rate.

``python -m benchmarks.sample_feed ENDPOINT FILE.npz RATE_HZ BATCH``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.client.client import Client
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.runtime.session import wait_followed
from dehyst.service.runtime.stopping import StopSignal

STAGE, AXIS = "bench", "x"


def sent(u_V: FloatArray, y_um: FloatArray, rate_hz: float, batch: int, message: int) -> SampleBatch:
    """The samples of message number ``message``, ``batch`` of them, from (n,) voltages, V, and readings, µm."""
    seq = np.arange(message * batch, (message + 1) * batch)
    at = message % (u_V.size // batch) * batch
    return SampleBatch(seq, seq / rate_hz, u_V[at : at + batch], y_um[at : at + batch])


def feed(endpoint: str, path: Path, rate_hz: float, batch: int) -> None:
    """Publish the samples in ``path`` (arrays u_V and y_um) at ``rate_hz``, over and over, ``batch`` a message.

    Begins when there is a subscriber, so that the first sample counted is the first that arrives.
    """
    stop = StopSignal()
    with np.load(path) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    with Client.connect(endpoint, STAGE, AXIS, wait_s=10.0) as client:
        publisher = client._session.declare_publisher(client.keys.sample)
        if not wait_followed(publisher, 20.0):
            sys.exit("no subscriber to the samples")
        print("ready", flush=True)
        start, k = time.perf_counter(), 0
        while not stop.reason:
            time.sleep(max(0.0, start + (k + 1) * batch / rate_hz - time.perf_counter()))
            made = sent(u_V, y_um, rate_hz, batch, k)
            client.samples(made.seq, made.t_s, made.u_V, made.y_um)
            k += 1
        time.sleep(0.3)  # until the last message has left the process
    print(json.dumps({"sent": k * batch}), flush=True)


if __name__ == "__main__":
    feed(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
