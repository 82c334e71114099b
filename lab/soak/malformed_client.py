"""A client that sends malformed messages to every key of an axis that is open to clients.

It has the key, as a faulty program of the laboratory has: its samples are signed, and refused for what they are.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import zenoh

from service.operating.verbs import MAX_BYTES
from service.protocol.query import encode_query
from service.protocol.samples import encode_reference, encode_samples
from service.runtime.session import SURELY, open_client
from service.runtime.stopping import StopSignal
from service.security.authenticator import own_authenticator

#: Messages per second: many, but other clients must still get through.
RATE_HZ: Final = 200.0
#: Keys in turn. Samples are published, the others are queries. The status takes no payload and answers anyway.
TARGETS: Final = (
    "feedforward", "sample", "model", "feedforward", "operate", "feedforward", "sample", "status",
)  # fmt: skip


def send_malformed(endpoint: str, base_key: str, seed: int) -> int:
    """Send until stopped. Prints how many queries got an error, an answer or nothing, and how many were published."""
    stop = StopSignal()
    rng = np.random.default_rng(seed)
    counts = {"error": 0, "answer": 0, "nothing": 0, "published": 0}
    with open_client(endpoint, 20.0) as session:
        by_key = own_authenticator()
        print("ready", flush=True)
        due = time.monotonic()
        count = 0
        while not stop.reason:
            target = TARGETS[count % len(TARGETS)]
            count += 1
            payload = PAYLOADS[target](rng)
            if target == "sample":
                key = f"{base_key}/sample"
                attached = by_key.published(key, payload)
                session.put(key, payload, attachment=attached, congestion_control=SURELY)
                counts["published"] += 1
            else:
                counts[_result_of_query(session, f"{base_key}/{target}{_parameters(target, rng)}", payload)] += 1
            # A slow answer delays all later messages; the rate stays bounded.
            due = max(due + 1.0 / RATE_HZ, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    print(json.dumps(counts), flush=True)
    return 0


def _result_of_query(session: zenoh.Session, selector: str, payload: bytes) -> str:
    result = "nothing"
    for reply in session.get(selector, payload=payload, timeout=1.0):
        result = "error" if reply.err is not None else "answer"
    return result


def _parameters(target: str, rng: np.random.Generator) -> str:
    """For a model query: the name of a model that does not exist."""
    return f"?name={rng.bytes(int(rng.integers(1, 60))).hex()}" if target == "model" else ""


def bad_query(rng: np.random.Generator) -> bytes:
    """A query that is malformed, truncated or oversized, or asks for a point or a model that does not exist."""
    good = encode_query([40.0], [0.0], [0.0])
    choice = int(rng.integers(6))
    if choice < 3:
        return _spoilt(good, choice, rng)
    if choice == 3:
        return encode_query([1e9], [0.0], [0.0])
    if choice == 4:
        return encode_query([40.0], [0.0], [0.0], memory=np.zeros(int(rng.integers(100, 4000))))
    return encode_query([40.0], [0.0], [0.0], model="nobody")


def bad_samples(rng: np.random.Generator) -> bytes:
    """A message that cannot be decoded as samples. Samples that can be decoded would be learnt, as those of a stage."""
    good = encode_samples([1, 2, 3], [0.0, 1e-3, 2e-3], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    choice = int(rng.integers(6))
    if choice < 3:
        return _spoilt(good, choice, rng)
    if choice == 3:
        # Another version of the protocol.
        return bytes([int(rng.integers(2, 256))]) + good[1:]
    if choice == 4:
        # More samples than bytes.
        return good[:4] + int(rng.integers(4, 2**32)).to_bytes(4, "little") + good[8:]
    return encode_reference(1, [1.0, 2.0])


def bad_request(rng: np.random.Generator) -> bytes:
    """A message that cannot be decoded as an operator's request, so that the service changes and records nothing."""
    choice = int(rng.integers(5))
    if choice == 0:
        return _noise(rng)
    if choice == 1:
        return b'{"verb": "freeze", "who": "rubb'
    if choice == 2:
        return json.dumps({"verb": "freeze", "who": "rubbish", "arguments": []}).encode()
    if choice == 3:
        return json.dumps({"verb": "freeze", "who": "rubbish", "as": "admin"}).encode()
    return b"[" * (MAX_BYTES + int(rng.integers(1, 100_000)))


def _spoilt(good: bytes, how: int, rng: np.random.Generator) -> bytes:
    """Noise (0), ``good`` truncated (1), or ``good`` with bytes appended (2)."""
    if how == 0:
        return _noise(rng)
    if how == 1:
        return good[: int(rng.integers(len(good)))]
    return good + rng.bytes(int(rng.integers(1, 200_000)))


def _noise(rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(0, 400)))


#: What each key gets.
PAYLOADS: Final[dict[str, Callable[[np.random.Generator], bytes]]] = {
    "feedforward": bad_query,
    "model": _noise,
    "status": _noise,
    "operate": bad_request,
    "sample": bad_samples,
}
