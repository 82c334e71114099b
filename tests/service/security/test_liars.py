"""A liar beside the service, on loopback, in the same network: it answers, publishes and samples as well as it can.

Each test is an attack that once succeeded. The service runs in this process; service, clients and stage find the key by
themselves, the liar has none.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.config.settings import read_config
from dehyst.service.operating.remote import operate
from dehyst.service.protocol.errors import NoReplyError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.model import encode_model
from dehyst.service.protocol.query import Answer, encode_query, encode_reply
from dehyst.service.protocol.samples import encode_samples
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.security.authenticator import EVERYBODY, own_authenticator
from dehyst.service.server.process import Service
from tests.service.conftest import make_models, unused_port, write_config
from tests.service.living import declared, eventually

pytestmark = pytest.mark.e2e
KEYS = Keys("demo", "x")
LEARNING = "lssvm_adaptive"
#: Limits of the axis: u_min_V, u_max_V.
LOW_V, HIGH_V = 0.0, 10.0


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """Of a service that runs in this process."""
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    with Service(read_config(config)):
        yield f"tcp/127.0.0.1:{port}"


@pytest.fixture
def liar(endpoint: str) -> Iterator[zenoh.Session]:
    with open_client(endpoint, 20.0) as session:
        yield session


def answers(liar: zenoh.Session, client: Client, key: str, payload: bytes, stack: ExitStack) -> None:
    """Let the liar answer on ``key``; it says that it is the whole truth, and copies what a reply carries."""

    def lie(query: zenoh.Query) -> None:
        with query:
            query.reply(key, payload, attachment=query.attachment)

    stack.callback(liar.declare_queryable(key, lie, complete=True).undeclare)
    declared(liar, client._session)


def test_no_voltage_of_a_liar_is_handed_to_a_caller(endpoint: str, liar: zenoh.Session) -> None:
    with Client.connect(endpoint, wait_s=20.0) as client:
        honest_V = client.point(40.0).u_V
        lie = Answer(np.array([1e6]), np.array([0.0]), np.zeros(1, dtype=np.uint8), np.zeros(9), 7, LEARNING)
        small = lie._replace(u_V=np.array([honest_V + 1.0]))
        for forged in (encode_reply(lie), encode_reply(small)):
            with ExitStack() as lying:
                answers(liar, client, KEYS.feedforward, forged, lying)
                before, told = client.refused, set()
                # The right reply often comes first, and then the liar's is not even looked at.
                for k in range(5000):
                    told.add(client.point(40.0).u_V)
                    if k >= 50 and client.refused > before:
                        break
                assert told == {honest_V}
                assert client.refused > before


def test_a_new_client_believes_no_limits_of_a_liar(endpoint: str, liar: zenoh.Session) -> None:
    with Client.connect(endpoint, wait_s=20.0) as first, ExitStack() as stack:
        status = first.status()
        status["limits"]["u_max_V"] = 1000.0
        answers(liar, first, KEYS.status, json.dumps(status).encode(), stack)
        for _ in range(20):
            with Client.connect(endpoint, wait_s=20.0) as client:
                assert client.limits.u_max_V == HIGH_V


@pytest.mark.parametrize("deltas", [True, False])
def test_a_follower_takes_no_model_of_a_liar(endpoint: str, liar: zenoh.Session, deltas: bool) -> None:
    with Client.connect(endpoint, wait_s=20.0) as client:
        follower = client.follow(LEARNING, deltas=deltas)
        honest_V = follower.point(40.0)
        model = make_models()[LEARNING]
        steep = replace(model, beta=2.0 * model.beta)  # type: ignore[type-var, attr-defined]
        slow = make_models(1000.0)[LEARNING]  # a sample time for which the slew limit allows any step
        for forged in (steep, slow):
            whole = encode_model(LEARNING, forged, 10**6, np.zeros(forged.memory_size))
            for _ in range(100):
                liar.put(
                    KEYS.model_delta if deltas else KEYS.model, whole, attachment=bytes(32), congestion_control=SURELY
                )
                # Its own slow states move the voltage by less.
                assert follower.point(40.0) == pytest.approx(honest_V, abs=0.01)
                time.sleep(1e-3)
        assert follower.point(80.0) - follower.point(40.0) <= 2000.0 * 1e-3 + 1e-9
        eventually(lambda: follower.refused == 200)
        assert follower.received <= 3  # the one it fetched; the first that the service publishes, and that once more


def test_samples_of_a_liar_are_not_learnt_where_the_stage_signs(endpoint: str, liar: zenoh.Session) -> None:
    with Client.connect(endpoint, wait_s=20.0) as client:
        for seq in range(0, 1000, 5):
            k = np.arange(seq, seq + 5)
            y_um = 45.0 + 30.0 * np.sin(2.0 * math.pi * 3e-3 * k)
            u_V = (y_um - 1.0) / 11.0
            if seq == 5:  # the first ones tell the service that this stage signs
                eventually(lambda: client.status()["samples"]["received"] == 5)
            if seq >= 5:
                liar.put(KEYS.sample, encode_samples(k, k * 1e-3, u_V, 1.03 * y_um), congestion_control=SURELY)
                time.sleep(2e-3)
            client.samples(k, k * 1e-3, u_V, y_um)
            time.sleep(3e-3)
        status = eventually(lambda: (s := client.status()) and s["seq"] >= 999 and s)
        gates = status["samples"]["gates"]
        assert not gates.get("duplicate")
        assert not gates.get("out_of_order")
        assert status["samples"]["received"] == 1000
        eventually(lambda: client.status()["peers"]["samples_refused"] == 199)


def test_a_liar_commands_nothing(endpoint: str, liar: zenoh.Session) -> None:
    """Neither by a request of its own, nor by one of an operator that it recorded and repeats."""
    heard: list[tuple[bytes, bytes]] = []
    events: list[dict[str, Any]] = []

    def listen(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            assert query.attachment is not None
            heard.append((query.payload.to_bytes(), query.attachment.to_bytes()))

    with Client.connect(endpoint, wait_s=20.0) as client, open_client(endpoint, 20.0) as operator, ExitStack() as stack:
        stack.callback(liar.declare_queryable(KEYS.operate, listen).undeclare)
        subscriber = operator.declare_subscriber(KEYS.event, lambda s: events.append(json.loads(s.payload.to_bytes())))
        stack.callback(subscriber.undeclare)
        declared(liar, operator)
        for verb in ("freeze", "thaw"):
            assert operate(operator, KEYS, verb, "alice")["ok"]
        freeze = heard[0]
        for payload, attachment in (freeze, (freeze[0], heard[1][1]), (freeze[0], bytes(32))):
            errors = [reply.err for reply in liar.get(KEYS.operate, payload=payload, attachment=attachment)]
            assert any(error is not None and b"authenticator" in error.payload.to_bytes() for error in errors)
        status = client.status()
        assert not status["frozen"]
        assert (status["operations"]["done"], status["operations"]["unsigned"]) == (2, 3)

        def refused() -> list[str]:
            return [event["detail"] for event in events if event["event"] == "operation_refused"]

        eventually(refused)
        assert len(refused()) == 1
        assert "authenticator" in refused()[0]


def test_what_a_liar_recorded_answers_no_other_query(endpoint: str, liar: zenoh.Session) -> None:
    """It keeps every signed reply, and answers with them from then on."""
    kept: list[tuple[bytes, bytes]] = []

    def record(query: zenoh.Query) -> None:
        with query:
            if lying:
                for payload, attached in kept:
                    query.reply(KEYS.feedforward, payload, attachment=attached)
                return
            # It hears each query, and asks the service with the same stamp for another point.
            attached = query.attachment
            assert attached is not None
            asked.append(attached.to_bytes())

    asked: list[bytes] = []
    lying = False
    with Client.connect(endpoint, wait_s=20.0) as client, ExitStack() as stack:
        honest_V = client.point(40.0).u_V
        stack.callback(liar.declare_queryable(KEYS.feedforward, record, complete=True).undeclare)
        declared(liar, client._session)
        client.point(40.0)
        eventually(lambda: asked)
        with open_client(endpoint) as other:
            stack.callback(lambda: None)
            for stamp, y_um in ((asked[0], 60.0), (bytes(16), 40.0)):
                query = encode_query(y_um, 0.0, 0.0)
                for reply in other.get(KEYS.feedforward, payload=query, attachment=stamp, timeout=2.0, **EVERYBODY):
                    if reply.ok is not None and reply.ok.attachment is not None:
                        kept.append((reply.ok.payload.to_bytes(), reply.ok.attachment.to_bytes()))
        assert len(kept) == 2
        lying = True
        assert {client.point(40.0).u_V for _ in range(50)} == {honest_V}


def test_what_a_liar_recorded_of_a_model_is_not_taken_again(endpoint: str, liar: zenoh.Session) -> None:
    kept: list[tuple[bytes, bytes]] = []

    def record(sample: zenoh.Sample) -> None:
        if sample.attachment is not None and len(kept) < 10:
            kept.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))

    subscriber = liar.declare_subscriber(KEYS.model, record)
    with Client.connect(endpoint, wait_s=20.0) as client:
        follower = client.follow(LEARNING, deltas=False)
        teach(client, 0)
        eventually(lambda: follower.received > 5 and len(kept) == 10)
        eventually(lambda: (s := client.status())["seq"] == 499 and follower.snapshot_seq == s["snapshot_seq"])
        subscriber.undeclare()
        received, seq = follower.received, follower.snapshot_seq
        for payload, attached in kept:
            liar.put(KEYS.model, payload, attachment=attached, congestion_control=SURELY)
        time.sleep(0.2)
        assert (follower.received, follower.snapshot_seq, follower.refused) == (received, seq, 0)
        # One that another sender signed once, before the present service began.
        earlier = own_authenticator().published(KEYS.model, kept[0][0])
        liar.put(KEYS.model, kept[0][0], attachment=earlier, congestion_control=SURELY)
        time.sleep(0.3)
        assert follower.snapshot_seq == seq


def test_samples_that_a_liar_repeats_are_not_learnt_twice(endpoint: str, liar: zenoh.Session) -> None:
    kept: list[tuple[bytes, bytes]] = []

    def record(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        kept.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))

    subscriber = liar.declare_subscriber(KEYS.sample, record)
    with Client.connect(endpoint, wait_s=20.0) as client:
        teach(client, 0)
        eventually(lambda: len(kept) == 100)
        subscriber.undeclare()
        for payload, attached in kept:
            liar.put(KEYS.sample, payload, attachment=attached, congestion_control=SURELY)
        # What is refused is counted as it comes, what is received once it is handled.
        eventually(lambda: client.status()["peers"]["samples_refused"] == 100)
        status = eventually(lambda: (s := client.status()) and s["samples"]["received"] >= 500 and s)
        assert status["samples"]["received"] == 500


def teach(client: Client, first: int) -> None:
    """Half a second of samples."""
    for seq in range(first, first + 500, 5):
        k = np.arange(seq, seq + 5)
        y_um = 45.0 + 30.0 * np.sin(2.0 * math.pi * 3e-3 * k)
        client.samples(k, k * 1e-3, (y_um - 1.0) / 11.0, y_um)
        time.sleep(5e-3)


def test_an_open_service_is_believed_by_who_is_told_so_and_says_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    endpoint = f"tcp/127.0.0.1:{port}"
    with Service(replace(read_config(config), open=True)) as service, open_client(endpoint, 20.0) as liar:
        assert service.ready()["key_file"] is None
        with pytest.raises(NoReplyError, match="--key -"):
            Client.connect(endpoint, wait_s=2.0)
        monkeypatch.setenv("DEHYST_KEY", "-")
        with Client.connect(endpoint, wait_s=20.0) as client, ExitStack() as lying:
            assert "everybody on the wire is believed" in client.status()["warnings"][-1]
            honest_V = client.point(40.0).u_V
            lie = Answer(np.array([1e6]), np.array([0.0]), np.zeros(1, dtype=np.uint8), np.zeros(9), 7, LEARNING)
            answers(liar, client, KEYS.feedforward, encode_reply(lie), lying)
            # Nothing is signed, but the limits are known.
            assert {client.point(40.0).u_V for _ in range(50)} == {honest_V}


def test_a_service_that_has_other_limits_since_its_restart_is_still_believed(tmp_path: Path) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    endpoint, text = f"tcp/127.0.0.1:{port}", config.read_text()
    config.write_text(text.replace("u_max_V = 10.0", "u_max_V = 3.0"))
    service = Service(read_config(config))
    service.start()
    with Client.connect(endpoint, wait_s=20.0, retry_s=20.0) as client:
        assert client.point(80.0).u_V == 3.0
        service.close()
        config.write_text(text)
        with Service(read_config(config)):
            assert client.point(80.0).u_V > 5.0
            assert client.limits.u_max_V == HIGH_V


@pytest.mark.parametrize("deltas", [True, False])
def test_a_follower_goes_on_with_the_service_that_replaces_the_first(tmp_path: Path, deltas: bool) -> None:
    """By the same key, and by another one, which it does not believe."""
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    endpoint = f"tcp/127.0.0.1:{port}"
    (tmp_path / "other").write_bytes(b"0123456789abcdef")
    (tmp_path / "other").chmod(0o600)
    service = Service(read_config(config))
    service.start()
    with Client.connect(endpoint, wait_s=20.0, retry_s=20.0) as client:
        follower = client.follow(LEARNING, deltas=deltas)
        teach(client, 0)
        eventually(lambda: follower.received > 5)
        service.close()
        with Service(replace(read_config(config), key=tmp_path / "other")), open_client(endpoint, 20.0) as session:
            before = follower.received
            eventually(lambda: any(reply.ok for reply in session.get(KEYS.status, timeout=1.0)))
            with Client.connect(endpoint, wait_s=20.0, key=tmp_path / "other") as stranger:
                teach(stranger, 1000)
            assert follower.received == before
        with Service(read_config(config)):
            client.status()
            firsts = iter(range(2000, 60_000, 500))
            while follower.received <= before + 5:  # once a second it asks who publishes
                teach(client, next(firsts))
            assert follower.snapshot_seq >= 2000
