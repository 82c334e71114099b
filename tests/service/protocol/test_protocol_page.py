"""A client written from docs/protocol.md alone (`page_client`), over zenoh, beside a real service.

Only the harness that starts the service is ours.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import zenoh

from tests.service.protocol.page_client import answer as answer_by_the_page
from tests.service.protocol.page_client import decode_model as model
from tests.service.protocol.page_client import decode_query
from tests.service.protocol.page_client import decode_reply as reply

pytestmark = pytest.mark.e2e
BASE = "dehyst/v1/demo/x"


@contextmanager
def connected(endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    with zenoh.open(config) as opened:
        yield opened


@pytest.fixture
def session(shared_service: Any) -> Iterator[zenoh.Session]:
    with connected(shared_service.endpoint) as opened:
        yield opened


def get(session: zenoh.Session, selector: str, payload: bytes | None = None) -> bytes:
    until = time.monotonic() + 20.0
    while not (replies := list(session.get(selector, payload=payload, timeout=5.0))):
        assert time.monotonic() < until, "nobody answers"
        time.sleep(0.05)
    (answer,) = replies
    assert answer.ok is not None, answer.err.payload.to_bytes()
    return bytes(answer.ok.payload.to_bytes())


def query(
    y: list[float],
    v: list[float],
    a: list[float],
    memory: list[float] | None,
    model: bytes = b"",
    as_of: int = -1,
    pending: tuple[int, list[float], list[float]] | None = None,
) -> bytes:
    n, m = len(y), len(memory or [])
    head = struct.pack("<BBHI", 1, 4, 1 | (2 if memory is not None else 0) | (4 if pending else 0), n)
    head += struct.pack("<qdII", as_of, math.nan, m, len(model))
    body = head + struct.pack(f"<{m + 3 * n}d", *(memory or []), *y, *v, *a) + model
    if pending is None:
        return body
    first, y_um, u_V = pending
    return body + struct.pack(f"<qI{2 * len(y_um)}d", first, len(y_um), *y_um, *u_V)


def samples(first: int, n: int) -> bytes:
    k = list(range(first, first + n))
    y = [45.0 + 30.0 * math.sin(2 * math.pi * 3e-3 * i) for i in k]
    u = [(value - 1.0) / 10.5 for value in y]
    return struct.pack("<BBHI", 1, 1, 0, n) + struct.pack(f"<{n}q{3 * n}d", *k, *(i * 1e-3 for i in k), *u, *y)


def test_a_stranger_asks_continues_teaches_and_is_corrected(session: zenoh.Session) -> None:
    status = json.loads(get(session, f"{BASE}/status"))
    assert (status["schema"], status["wire"], status["served"]) == (1, 1, "auto")
    size = status["models"]["auto"]["memory_size"]

    # Five points of a ramp at once, and cut in two with the memory brought back: the same voltages.
    dt = status["dt_s"]
    y = [40.0 + 1000.0 * dt * i for i in range(5)]
    v, a = [1000.0] * 5, [0.0] * 5
    whole = reply(get(session, f"{BASE}/feedforward", query(y, v, a, None)))
    assert whole["options"] == 2  # the service's own memory
    assert len(whole["memory"]) == size
    assert whole["flags"] == [0] * 5
    first = reply(get(session, f"{BASE}/feedforward", query(y[:3], v[:3], a[:3], None)))
    second = reply(get(session, f"{BASE}/feedforward", query(y[3:], v[3:], a[3:], first["memory"])))
    assert second["options"] == 0
    assert first["u_V"] + second["u_V"] == whole["u_V"]
    assert second["memory"] == whole["memory"]

    # Another model by name; the line is one that this page lets us evaluate ourselves.
    line = reply(get(session, f"{BASE}/feedforward", query(y, v, a, None, b"linear")))
    assert line["model"] == "linear"
    values = model(get(session, f"{BASE}/model?name=linear"))["values"]
    assert line["u_V"] == pytest.approx([(p - values["offset_um"]) / values["gain_um_per_V"] for p in y])

    # A point that asks for too much at once, from a given voltage on, is limited and says so.
    jump = query([80.0], [0.0], [0.0], None)
    jump = jump[:16] + struct.pack("<d", 1.0) + jump[24:]
    limited = reply(get(session, f"{BASE}/feedforward", jump))
    assert limited["flags"] == [2]
    assert limited["u_V"][0] == pytest.approx(1.0 + status["limits"]["slew_V_per_s"] * dt)

    # Samples teach; the snapshots' numbers follow.
    for k in range(0, 1000, 50):  # the first samples that this service ever gets
        session.put(f"{BASE}/sample", samples(k, 50), congestion_control=zenoh.CongestionControl.BLOCK)
    until = time.monotonic() + 30.0
    while json.loads(get(session, f"{BASE}/status"))["seq"] < 999 and time.monotonic() < until:
        time.sleep(0.02)
    taught = reply(get(session, f"{BASE}/feedforward", query(y, v, a, whole["memory"])))
    assert taught["snapshot_seq"] == 980
    assert taught["u_V"] != whole["u_V"]

    # Errors speak in fields.
    for payload, field in (
        (query([float("nan")], [0.0], [0.0], None), "y_um[0]"),
        (query([1000.0], [0.0], [0.0], None), "y_um[0]"),
        (query(y, v, a, None)[:-1], "payload"),
        (b"\x02" + query(y, v, a, None)[1:], "version"),
    ):
        (answer,) = list(session.get(f"{BASE}/feedforward", payload=payload, timeout=5.0))
        error = json.loads(answer.err.payload.to_bytes())
        assert (error["error"], error["field"]) == ("InputError", field)
        assert set(error) == {"error", "message", "field", "got", "expected"}
    assert list(session.get("dehyst/v1/demo/nobody/feedforward", payload=b"", timeout=5.0)) == []


def test_a_stranger_follows_the_model_as_it_is_published(session: zenoh.Session) -> None:
    arrived: list[dict[str, Any]] = []
    second = threading.Event()

    def on_model(sample: zenoh.Sample) -> None:
        arrived.append(model(sample.payload.to_bytes()))
        if len(arrived) >= 2:
            second.set()

    session.declare_subscriber(f"{BASE}/model", on_model)
    k, until = 1000, time.monotonic() + 20.0
    while not second.is_set() and time.monotonic() < until:
        session.put(f"{BASE}/sample", samples(k, 20))
        k += 20
        time.sleep(0.02)
    assert second.is_set()
    assert arrived[0]["name"] == "lssvm_adaptive"
    assert arrived[1]["snapshot_seq"] > arrived[0]["snapshot_seq"]
    assert len(arrived[0]["data"]["/memory"]) > 0


def stage_samples(first: int, n: int, gain: float) -> bytes:
    """Samples of a stage of ``gain`` times 11 µm/V, moved by one and the same sequence of voltages."""
    k = np.arange(first, first + n)
    u = 4.0 + 2.5 * np.sin(2 * np.pi * 4e-3 * k) + 0.8 * np.sin(2 * np.pi * 11e-3 * k)
    y = gain * (11.0 * u + 1.0)
    return struct.pack("<BBHI", 1, 1, 0, n) + struct.pack(f"<{n}q{3 * n}d", *k, *(k * 1e-3), *u, *y)


def taught(session: zenoh.Session, first: int, last: int, gain: float) -> None:
    """Send the samples from ``first`` to ``last`` and wait until they are handled."""
    for k in range(first, last + 1, 50):
        session.put(f"{BASE}/sample", stage_samples(k, 50, gain), congestion_control=zenoh.CongestionControl.BLOCK)
    until = time.monotonic() + 30.0
    while json.loads(get(session, f"{BASE}/status"))["seq"] < last and time.monotonic() < until:
        time.sleep(0.02)


def test_a_stranger_stays_exact_through_a_jump_of_the_gain(serve: Any) -> None:
    y, v, a = [30.0, 33.0, 37.0, 36.0, 35.5], [3e3, 4e3, 0.0, -1e3, -5e2], [0.0, 1e4, -5e4, 0.0, 2e3]
    with connected(serve().endpoint) as session:
        taught(session, 0, 1999, 1.0)
        before = model(get(session, f"{BASE}/model?name=lssvm_adaptive"))
        taught(session, 2000, 3999, 0.94)
        after = {name: model(get(session, f"{BASE}/model?name={name}")) for name in ("lssvm_adaptive", "auto")}
        frames = [m["values"]["features.gain"] for m in (before, after["lssvm_adaptive"])]
        assert frames[0] == pytest.approx(1.0, abs=0.01)
        assert frames[1] == pytest.approx(0.94, abs=0.01)
        way = 3995, [32.0, 31.0, 30.5, 30.0, 29.5, 29.0, 29.5], [2.9, 2.8, 2.75, 2.7, 2.65, 2.6, 2.65]
        for name, message in after.items():
            for pending in (None, way):
                payload = query(y, v, a, None, name.encode(), message["snapshot_seq"], pending)
                asked = reply(get(session, f"{BASE}/feedforward", payload))
                mine = answer_by_the_page(message, decode_query(payload), (0.0, 10.0, 2000.0))
                assert asked["snapshot_seq"] == message["snapshot_seq"]
                assert asked["flags"] == mine["flags"]
                for field in ("u_V", "std_V", "memory"):
                    np.testing.assert_allclose(mine[field], asked[field], rtol=1e-12, atol=1e-12, err_msg=field)
