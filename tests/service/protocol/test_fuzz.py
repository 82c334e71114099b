"""Payloads that nobody honest would send: every decoder, and a live service under them."""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.fuzz_targets import EXPECTED, TARGETS, WORDS, seeds
from benchmarks.mutations import mutated
from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.errors import error_from_json
from dehyst.service.protocol.model import decode_model
from dehyst.service.runtime.session import open_client
from tests.service.conftest import ServeProcess

DECODE = {name: make() for name, make in TARGETS.items()}


@pytest.mark.parametrize("name", list(TARGETS))
def test_honest_payloads_are_taken(name: str) -> None:
    assert seeds(name)
    for payload in seeds(name):
        DECODE[name](payload)


@pytest.mark.parametrize("name", list(TARGETS))
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_no_payload_does_more_than_be_refused(name: str, data: st.DataObject) -> None:
    """Random, cut, lengthened, mutated, spliced: the targets let nothing pass but what is documented."""
    honest = data.draw(st.sampled_from(seeds(name)))
    payload = bytearray(data.draw(st.one_of(st.binary(max_size=300), st.just(honest))))
    for _ in range(data.draw(st.integers(0, 6))):
        at = data.draw(st.integers(0, max(0, len(payload) - 1)))
        change = data.draw(st.sampled_from(["byte", "word", "number", "cut", "double"]))
        if change == "byte" and payload:
            payload[at] = data.draw(st.integers(0, 255))
        elif change == "word":
            payload[at:at] = data.draw(st.sampled_from(WORDS)).encode()
        elif change == "number":
            payload[at : at + 8] = struct.pack("<q", data.draw(st.integers(-(2**63), 2**63 - 1)))
        elif change == "cut":
            payload = payload[:at]
        else:
            payload += bytes(payload)
    DECODE[name](bytes(payload))


def test_deeply_nested_json_is_refused_not_followed() -> None:
    deep = b"[" * 100_000
    assert error_from_json(deep).kind == "unknown"  # type: ignore[attr-defined]
    DECODE["operate"](deep[:16_000])
    text = b'{"arrays":' + deep
    with pytest.raises(EXPECTED):
        decode_model(struct.pack("<BBHIqII", wire.VERSION, wire.MODEL, 0, 1, 5, len(text), 0) + text)


def test_decoding_bad_payloads_keeps_no_memory() -> None:
    process = psutil.Process()
    rng = np.random.default_rng(3)
    payloads = {name: [mutated(seed, rng) for seed in seeds(name) for _ in range(100)] for name in TARGETS}

    def rounds(n: int) -> int:
        for _ in range(n):
            for name, bad in payloads.items():
                for payload in bad:
                    DECODE[name](payload)
        rss: int = process.memory_info().rss
        return rss

    settled = rounds(2)
    assert rounds(3) - settled < 2 * 2**20


@pytest.mark.e2e
def test_a_live_service_answers_every_bad_query_with_an_error_and_holds_its_memory(
    serve: Callable[..., ServeProcess], tmp_path: Path
) -> None:
    process = serve(extra=f'recorder = "{tmp_path / "rec"}"')
    rng = np.random.default_rng(7)
    service = psutil.Process(process.process.pid)
    keys_of = {"query": "feedforward", "operate": "operate"}
    with Client.connect(process.endpoint, timeout_s=5.0) as client, open_client(process.endpoint) as session:
        honest_u_V = client.point(40.0, model="linear").u_V
        oversized = {
            "feedforward": wire.HEADER.pack(1, 4, 0, 2**32 - 1) + os.urandom(8 * 2**20),
            "operate": b'{"verb":"' + b"x" * 2**20 + b'"}',
            "model": os.urandom(2**20),
            "status": os.urandom(2**20),
        }

        def fire(n: int) -> tuple[int, int]:
            answered = refused = 0
            for name, what in keys_of.items():
                for seed in seeds(name):
                    for _ in range(n):
                        replies = list(
                            session.get(f"{client.keys.base}/{what}", payload=mutated(seed, rng), timeout=5.0)
                        )
                        assert len(replies) == 1
                        answered += replies[0].ok is not None
                        if replies[0].err is not None:
                            error = json.loads(replies[0].err.payload.to_bytes())
                            # Refused for what it is, not because something within broke.
                            assert error["error"] in ("InputError", "ServiceError"), error
                            refused += 1
            for _ in range(n):
                session.put(client.keys.sample, mutated(seeds("samples")[0], rng))
            return answered, refused

        fire(20)
        for what, payload in oversized.items():
            (reply,) = list(session.get(f"{client.keys.base}/{what}", payload=payload, timeout=20.0))
            assert (reply.ok is not None) == (what in ("model", "status"))
        time.sleep(0.5)
        settled = service.memory_info().rss
        events_before = client.status()["queries"]["errors"]
        _, refused = fire(60)
        assert refused > 200
        assert client.status()["queries"]["errors"] > events_before
        assert service.memory_info().rss - settled < 16 * 2**20
        assert client.status()["samples"]["malformed"] > 10
        assert client.point(40.0, model="linear").u_V == honest_u_V
    code, _, err = process.stop()
    assert code == 0
    # Events are logged; nothing else, such as a traceback, may be there.
    assert all("dehyst.axis." in line for line in err.splitlines()), err
