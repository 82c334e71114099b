"""Processes that disturb a soak: a slow subscriber, a busy core, and a client that sends malformed messages.

``python -m dehyst.lab.soak.disturbers slow|busy|malformed ENDPOINT BASE_KEY [SEED]`` prints ``ready`` and runs until it
is stopped; BASE_KEY is that of the axis. The malformed client has the key, as a faulty program of the laboratory has:
its samples are signed, and refused for what they are.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import zenoh

from dehyst.service.operating.verbs import MAX_BYTES
from dehyst.service.protocol.query import encode_query
from dehyst.service.protocol.samples import encode_reference, encode_samples
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.security.authenticator import own_authenticator

#: Messages per second: many, but other clients must still get through.
RATE_HZ: Final = 200.0
#: Keys in turn. Samples are published, the others are queries. The status takes no payload and answers anyway.
TARGETS: Final = (
    "feedforward", "sample", "model", "feedforward", "operate", "feedforward", "sample", "status",
)  # fmt: skip


def slow(endpoint: str, base_key: str) -> None:
    """Subscribe to all keys of the axis and take 50 ms for each message."""
    stop = StopSignal()
    with open_client(endpoint, 20.0) as session:
        subscriber = session.declare_subscriber(f"{base_key}/**", lambda _: time.sleep(0.05))
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


def send_malformed(endpoint: str, base_key: str, seed: int) -> None:
    """Send until stopped. Prints how many queries got an error, an answer or nothing, and how many were published."""
    stop, by_key, rng = StopSignal(), own_authenticator(), np.random.default_rng(seed)
    counts = {"error": 0, "answer": 0, "nothing": 0, "published": 0}
    with open_client(endpoint, 20.0) as session:
        print("ready", flush=True)
        due, count = time.monotonic(), 0
        while not stop.reason:
            target = TARGETS[count % len(TARGETS)]
            count += 1
            payload, key = PAYLOADS[target](rng), f"{base_key}/{target}"
            if target == "sample":
                session.put(key, payload, attachment=by_key.published(key, payload), congestion_control=SURELY)
                counts["published"] += 1
            else:
                # A model that does not exist.
                counts[_result(session, f"{key}?name={rng.bytes(9).hex()}" if target == "model" else key, payload)] += 1
            # A slow answer delays all later messages; the rate stays bounded.
            due = max(due + 1.0 / RATE_HZ, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    print(json.dumps(counts), flush=True)


def _result(session: zenoh.Session, selector: str, payload: bytes) -> str:
    result = "nothing"
    for reply in session.get(selector, payload=payload, timeout=1.0):
        result = "error" if reply.err is not None else "answer"
    return result


def bad_query(rng: np.random.Generator) -> bytes:
    """A query that is malformed, truncated or oversized, or asks for a point or a model that does not exist."""
    good = encode_query([40.0], [0.0], [0.0])
    memory = encode_query([40.0], [0.0], [0.0], memory=np.zeros(int(rng.integers(100, 4000))))
    nobody = encode_query([40.0], [0.0], [0.0], model="nobody")
    return _one_of(rng, *_spoilt(good, rng), encode_query([1e9], [0.0], [0.0]), memory, nobody)


def bad_samples(rng: np.random.Generator) -> bytes:
    """A message that cannot be decoded as samples. Samples that can be decoded would be learnt, as those of a stage."""
    good = encode_samples([1, 2, 3], [0.0, 1e-3, 2e-3], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    version = bytes([int(rng.integers(2, 256))]) + good[1:]
    too_many = good[:4] + int(rng.integers(4, 2**32)).to_bytes(4, "little") + good[8:]
    return _one_of(rng, *_spoilt(good, rng), version, too_many, encode_reference(1, [1.0, 2.0]))


def bad_request(rng: np.random.Generator) -> bytes:
    """A message that cannot be decoded as an operator's request, so that the service changes and records nothing."""
    begin, too_long = b'{"verb": "freeze", "who": "rubbish"', b"[" * (MAX_BYTES + int(rng.integers(1, 100_000)))
    return _one_of(rng, _noise(rng), begin, begin + b', "arguments": []}', begin + b', "as": "admin"}', too_long)


def _spoilt(good: bytes, rng: np.random.Generator) -> tuple[bytes, bytes, bytes]:
    """Noise, ``good`` truncated, and ``good`` with bytes appended."""
    return _noise(rng), good[: int(rng.integers(len(good)))], good + bytes(int(rng.integers(1, 200_000)))


def _noise(rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(0, 400)))


def _one_of(rng: np.random.Generator, *messages: bytes) -> bytes:
    return messages[int(rng.integers(len(messages)))]


#: What each key gets.
PAYLOADS: Final[dict[str, Callable[[np.random.Generator], bytes]]] = {
    "feedforward": bad_query,
    "model": _noise,
    "status": _noise,
    "operate": bad_request,
    "sample": bad_samples,
}


if __name__ == "__main__":
    what, where, base, *rest = sys.argv[1:]
    if what == "busy":
        busy()
    elif what == "slow":
        slow(where, base)
    else:
        send_malformed(where, base, int(rest[0]))
