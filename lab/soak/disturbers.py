"""Processes that disturb a soak: a slow subscriber, a busy core, and a stranger without the key.

``python -m dehyst.lab.soak.disturbers slow|busy|liar ENDPOINT`` prints ``ready`` and runs until it is stopped.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import zenoh

from dehyst.lab.soak.controller import AXIS, STAGE
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import Answer, decode_query, encode_reply
from dehyst.service.protocol.samples import decode_samples, encode_command, encode_samples
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


def liar(endpoint: str) -> None:
    """Answer each query with a lie; command, and publish samples and models, with a false or a recorded tag."""
    stop, keys = StopSignal(), Keys(STAGE, AXIS)
    with open_client(endpoint, 20.0) as session:

        def answer(query: zenoh.Query) -> None:
            with query:
                n = 1 if query.payload is None else decode_query(query.payload.to_bytes()).y_um.size
                lie = Answer(np.full(n, 1e6), np.zeros(n), np.zeros(n, np.uint8), np.zeros(0), 7, "linear")
                query.reply(query.key_expr, encode_reply(lie), attachment=query.attachment)

        def repeat(sample: zenoh.Sample) -> None:
            payload = sample.payload.to_bytes()
            if str(sample.key_expr) == keys.sample:
                sent = decode_samples(payload)
                stray = encode_command(int(sent.seq[-1]) + 50, np.full(20, 1e6))
                session.put(keys.command, stray, attachment=bytes(32))
                payload = encode_samples(sent.seq, sent.t_s, sent.u_V, 2.0 * sent.y_um)
            for attached in (bytes(32), sample.attachment):
                session.put(sample.key_expr, payload, attachment=attached)

        # Its own messages would come back to it.
        heard = {"allowed_origin": zenoh.Locality.REMOTE}
        entities: list[Any] = [
            session.declare_queryable(key, answer, complete=True) for key in (keys.feedforward, keys.status)
        ]
        entities += [session.declare_subscriber(key, repeat, **heard) for key in (keys.sample, keys.champion_delta)]
        print("ready", flush=True)
        stop.wait()


if __name__ == "__main__":
    busy() if sys.argv[1] == "busy" else {"slow": slow, "liar": liar}[sys.argv[1]](sys.argv[2])
