"""Claims and states from strangers: they depose nobody, are taken by nobody, and get nothing."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.failover import state_transfer
from dehyst.service.failover.role_control import Claims
from dehyst.service.failover.state_transfer import fetch_state, status_of, tell_standbys
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import open_client, open_router
from dehyst.service.security.authenticator import EVERYBODY, NO_KEY, Authenticator
from dehyst.service.security.tokens import Claim
from tests.service.conftest import unused_port
from tests.service.failover.test_standby import pair_config
from tests.service.living import Process, Stage, declared, eventually

KEYS = Keys("demo", "x")
OURS, THEIRS = Authenticator(b"0123456789abcdef"), Authenticator(b"a stranger's own one")
STATE = os.urandom(200_000)
LIFE = b'{"instance": "i-peer"}'


def send_state(query: zenoh.Query, by: Authenticator) -> None:
    query.reply(KEYS.state, STATE, attachment=by.answered(query, KEYS.state, STATE))


@pytest.fixture
def processes() -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.kill()


@pytest.fixture
def endpoint() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    with open_router([endpoint]):
        yield endpoint


def test_a_claim_with_a_wrong_tag_or_an_absurd_epoch_is_none() -> None:
    claims = Claims(KEYS, "i-me", OURS)
    for key in (
        KEYS.token("claim", "9/i-rogue"),
        KEYS.token("claim", "9/i-rogue", "00"),
        Claim(9, "i-rogue").key(THEIRS, KEYS),
        Claim(8, "i-rogue").key(OURS, KEYS).replace("/8/", "/9/"),
        Claim(9, "i-rogue").key(OURS, Keys("demo", "y")).replace("/y/", "/x/"),
    ):
        claims.update(key, True)
        assert claims.highest() is None
    assert claims.refused == 5
    assert claims.next_epoch() == 1
    claims.update(Claim(3, "i-peer").key(OURS, KEYS), True)
    assert claims.highest() == Claim(3, "i-peer")
    claims.ignore(Claim(3, "i-peer"))
    assert claims.highest() is None
    assert Claim.read(NO_KEY, KEYS, KEYS.token("claim", "1000000000/i-a")) == Claim(10**9, "i-a")
    for epoch in ("²", "١", "-1", str(10**9 + 1), "9" * 400, "1.5", ""):
        assert Claim.read(NO_KEY, KEYS, f"{KEYS.base}/claim/{epoch}/i-a") is None


def test_a_state_goes_to_peers_only_and_comes_from_peers_only(endpoint: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        by = [OURS]
        asked: list[tuple[str, bytes]] = []
        refused: list[zenoh.Query] = []

        def answer(query: zenoh.Query) -> None:
            with query:
                attached = b"" if query.attachment is None else query.attachment.to_bytes()
                asked.append((str(query.parameters), attached))
                if by[0].is_asked_by_ours(query, KEYS.state):
                    send_state(query, by[0])
                else:
                    refused.append(query)
                    query.reply_err(b"no")

        queryable = serving.declare_queryable(KEYS.state, answer)
        declared(serving, asking)
        assert fetch_state(asking, KEYS.state, 5.0, authenticator=OURS) == STATE
        # The signature was seen on the wire, and is repeated.
        parameters, attached = asked[0]
        assert len(attached) == 32
        replies = asking.get(f"{KEYS.state}?{parameters}", attachment=attached, timeout=5.0, **EVERYBODY)
        assert [reply.ok for reply in replies] == [None]
        assert len(refused) == 1
        assert fetch_state(asking, KEYS.state, 5.0) is None
        assert fetch_state(asking, KEYS.state, 5.0, authenticator=THEIRS) is None
        assert len(refused) == 3
        by[0] = NO_KEY  # a stranger that answers anybody
        with pytest.raises(ServiceError, match="does not know the key"):
            fetch_state(asking, KEYS.state, 5.0, authenticator=OURS)
        assert fetch_state(asking, KEYS.state, 5.0) == STATE
        queryable.undeclare()  # type: ignore[no-untyped-call]


def test_only_the_signed_status_of_an_instance_is_a_sign_of_life(endpoint: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        by = [OURS]

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(KEYS.status, LIFE, attachment=by[0].answered(query, KEYS.status, LIFE))

        queryable = serving.declare_queryable(KEYS.status, answer)
        declared(serving, asking)
        assert status_of(asking, KEYS.status, "i-peer", 2.0, OURS) == {"instance": "i-peer"}
        assert status_of(asking, KEYS.status, "i-other", 0.5, OURS) is None
        for stranger in (THEIRS, NO_KEY):
            by[0] = stranger
            assert status_of(asking, KEYS.status, "i-peer", 0.5, OURS) is None
        queryable.undeclare()  # type: ignore[no-untyped-call]


def test_strangers_that_answer_for_the_state_keep_it_from_nobody(endpoint: str) -> None:
    """They send one of theirs, in as many sessions as they like, before the one that serves has begun."""
    crowd = [open_client(endpoint) for _ in range(6)]
    held: list[zenoh.Query] = []

    def begin(query: zenoh.Query) -> None:
        held.append(query)
        query.reply(KEYS.state, bytes(50_000), attachment=bytes(32))

    def answer(query: zenoh.Query) -> None:
        time.sleep(0.1)
        with query:
            assert OURS.is_asked_by_ours(query, KEYS.state)
            send_state(query, OURS)

    with open_client(endpoint) as serving, open_client(endpoint) as asking, contextlib.ExitStack() as stack:
        for session in crowd:
            stack.enter_context(session)
            stack.callback(session.declare_queryable(KEYS.state, begin).undeclare)
        stack.callback(held.clear)
        stack.callback(serving.declare_queryable(KEYS.state, answer).undeclare)
        for session in (*crowd, serving):
            declared(session, asking)
        assert fetch_state(asking, KEYS.state, 5.0, authenticator=OURS) == STATE
        assert len(held) == len(crowd)


def test_a_freeze_that_a_stranger_tells_again_is_none(endpoint: str) -> None:
    told: list[bool] = []
    seen: list[bytes] = []

    def on_switch(query: zenoh.Query) -> None:
        with query:
            assert query.attachment is not None
            seen.append(query.attachment.to_bytes())
            told.append(OURS.is_asked_by_ours(query, KEYS.switch))
            if told[-1]:
                query.reply(KEYS.switch, b"held", attachment=OURS.answered(query, KEYS.switch, b"held"))

    with open_client(endpoint) as serving, open_client(endpoint) as standby:
        queryable = standby.declare_queryable(KEYS.switch, on_switch)
        declared(standby, serving)
        assert tell_standbys(serving, KEYS.switch, 1.0, OURS) == 1
        assert tell_standbys(serving, KEYS.switch, 1.0, THEIRS) == 0
        for payload in (b"", b"thaw"):
            list(serving.get(KEYS.switch, payload=payload, attachment=seen[0], timeout=1.0))
        queryable.undeclare()  # type: ignore[no-untyped-call]
    assert told == [True, False, False, False]


def test_who_stands_still_while_it_asks_takes_nobody_for_dead(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is over when it goes on; the other one answers the next query."""
    monkeypatch.setattr(state_transfer, "_LIFE_S", 2.0)
    answers = [False]

    def answer(query: zenoh.Query) -> None:
        with query:
            if answers[0]:
                query.reply(KEYS.status, LIFE, attachment=OURS.answered(query, KEYS.status, LIFE))
            else:
                time.sleep(2.2)
                answers[0] = True

    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        queryable = serving.declare_queryable(KEYS.status, answer)
        declared(serving, asking)
        assert status_of(asking, KEYS.status, "i-peer", 2.05, OURS) is not None
        answers[0] = False
        begin = time.monotonic()
        assert status_of(asking, KEYS.status, "i-peer", 5.0, OURS, lambda: False) is None
        assert time.monotonic() - begin < 4.0
        queryable.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.e2e
def test_a_stranger_deposes_nobody_and_a_dead_ones_claim_holds_nobody_up(
    tmp_path: Path, processes: list[Process]
) -> None:
    config, endpoints = pair_config(tmp_path)
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    processes.append(Process(*serve, "--standby"))
    first, second = (process.ready["instance"] for process in processes)
    heard: list[str] = []
    events: list[str] = []
    with (
        open_client(endpoints, 20.0) as stranger,
        Client.connect(endpoints, timeout_s=0.5, wait_s=20.0, retry_s=10.0) as client,
        Stage(endpoints),
    ):
        stranger.liveliness().declare_subscriber(
            KEYS.tokens("claim"), lambda sample: heard.append(str(sample.key_expr)), history=True
        )
        stranger.declare_subscriber(KEYS.event, lambda sample: events.append(sample.payload.to_string()))
        eventually(lambda: client.status()["samples"]["learnt"] > 300)

        def impostor(query: zenoh.Query) -> None:
            with query:
                what = json.dumps({"instance": "i9-rogue", "dt_s": 1e-3, "limits": {}}).encode()
                query.reply(KEYS.status, what, attachment=query.attachment)

        answering = stranger.declare_queryable(KEYS.status, impostor, complete=True)
        rogue = stranger.liveliness().declare_token(KEYS.token("claim", "1000000/i9-rogue"))
        until = time.monotonic() + 4.0
        while time.monotonic() < until:
            status = client.status()
            assert (status["instance"], status["role"], status["epoch"]) == (first, "primary", 1)
            client.point(40.0)
            time.sleep(0.1)
        eventually(lambda: any("claim_ignored" in event for event in events))
        # The claim of the first one is told again by the stranger, and stays when the first one is gone.
        signed = next(key for key in heard if f"/claim/1/{first}/" in key)
        repeated = stranger.liveliness().declare_token(signed)
        time.sleep(0.3)
        # And it goes on saying that the first one serves.
        gone = threading.Event()

        def say() -> None:
            while not gone.wait(0.1):
                stranger.put(KEYS.status, f'{{"instance": "{first}"}}')

        saying = threading.Thread(target=say)
        saying.start()
        try:
            processes[0].kill()
            eventually(lambda: client.status()["instance"] == second)
        finally:
            gone.set()
            saying.join()
        for entity in (answering, rogue, repeated):
            entity.undeclare()  # type: ignore[no-untyped-call]
