"""A client that sends what nobody can use, to every key of an axis that is open to clients."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import zenoh

from lab.soak.processes.control import AXIS, STAGE
from service.operating.request import MAX_BYTES
from service.protocol.keys import Keys
from service.protocol.query import encode_query
from service.protocol.samples import encode_reference, encode_samples
from service.runtime.delivery import SURELY
from service.runtime.session import open_client
from service.runtime.stopping import StopSignal

#: Messages a second. Nobody is to be kept from asking: a burst is many, not all there is room for.
RATE_HZ: Final = 200.0
#: Whom it is sent to, in turns: samples are published, the others are queries. The status takes none, and answers.
AIMS: Final = (
    "feedforward", "sample", "model", "feedforward", "operate", "feedforward", "sample", "status",
)  # fmt: skip


def rubbish(endpoint: str, seed: int) -> int:
    """Send until stopped; prints how many queries got an error, an answer, nothing, and how many were published."""
    stop = StopSignal()
    rng = np.random.default_rng(seed)
    keys = Keys(STAGE, AXIS)
    got = {"error": 0, "answer": 0, "nothing": 0, "published": 0}
    with open_client(endpoint, 20.0) as session:
        print("ready", flush=True)
        due = time.monotonic()
        count = 0
        while not stop.reason:
            what = AIMS[count % len(AIMS)]
            count += 1
            payload = PAYLOADS[what](rng)
            if what == "sample":
                session.put(keys.sample, payload, congestion_control=SURELY)
                got["published"] += 1
            else:
                got[_asked(session, f"{keys.base}/{what}{_parameters(what, rng)}", payload)] += 1
            # What an answer took longer is not made up for.
            due = max(due + 1.0 / RATE_HZ, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    print(json.dumps(got), flush=True)
    return 0


def _asked(session: zenoh.Session, selector: str, payload: bytes) -> str:
    said = "nothing"
    for reply in session.get(selector, payload=payload, timeout=1.0):
        said = "error" if reply.err is not None else "answer"
    return said


def _parameters(what: str, rng: np.random.Generator) -> str:
    """Of a query for a model: the name of one that there is not."""
    return f"?name={rng.bytes(int(rng.integers(1, 60))).hex()}" if what == "model" else ""


def bad_query(rng: np.random.Generator) -> bytes:
    """Malformed, truncated, oversized, foreign, or of a point or a model that there is not."""
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
    """No samples, whatever else: what could be read would be believed, as it would be of any stage."""
    good = encode_samples([1, 2, 3], [0.0, 1e-3, 2e-3], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    choice = int(rng.integers(6))
    if choice < 3:
        return _spoilt(good, choice, rng)
    if choice == 3:
        # Of another version of the wire.
        return bytes([int(rng.integers(2, 256))]) + good[1:]
    if choice == 4:
        # More samples than bytes.
        return good[:4] + int(rng.integers(4, 2**32)).to_bytes(4, "little") + good[8:]
    return encode_reference(1, [1.0, 2.0])


def bad_request(rng: np.random.Generator) -> bytes:
    """No request of an operator: nothing that could be read, so that nothing is done and nothing is written down."""
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
    """Something else altogether (0), ``good`` truncated (1), or with more behind it (2)."""
    if how == 0:
        return _noise(rng)
    if how == 1:
        return good[: int(rng.integers(len(good)))]
    return good + rng.bytes(int(rng.integers(1, 200_000)))


def _noise(rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(0, 400)))


#: What is sent to each of them.
PAYLOADS: Final[dict[str, Callable[[np.random.Generator], bytes]]] = {
    "feedforward": bad_query,
    "model": _noise,
    "status": _noise,
    "operate": bad_request,
    "sample": bad_samples,
}
