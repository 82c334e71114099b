"""Claims and states from strangers: they depose nobody, are taken by nobody, and get nothing."""

from __future__ import annotations

import contextlib
import logging
import os
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from adaptive.errors import InputError
from service.client.client import Client
from service.config.settings import ServeConfig
from service.failover.role_control import MAX_EPOCH, Claim, Claims, claim_parts, parse_claim
from service.failover.state_transfer import (
    check_asker,
    fetch_state,
    gives_sign_of_life,
    send_sign_of_life,
    send_state,
    tell_standbys,
    told_switch,
)
from service.protocol.errors import ServiceError
from service.protocol.keys import Keys
from service.runtime.session import open_client, open_router
from service.security.peers import OWN_SECRET, Nonces, PeerSecret, read_secret
from service.server.process import secret_of, warn_without_secret
from tests.service.conftest import unused_port
from tests.service.failover.test_standby import pair_config
from tests.service.living import Process, Stage, eventually

KEYS = Keys("demo", "x")
OURS, THEIRS = PeerSecret(b"0123456789abcdef"), PeerSecret(b"a stranger's own one")
STATE = os.urandom(200_000)


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


def test_only_who_knows_the_secret_can_sign() -> None:
    signature = OURS.sign("claim", 3, "i-a")
    assert OURS.proves(signature, "claim", 3, "i-a")
    for parts in (("claim", 4, "i-a"), ("claim", 3, "i-b"), ("claim", "3i-a"), ("claim", "3i", "-a"), ()):
        assert not OURS.proves(signature, *parts)
    assert not OURS.proves(THEIRS.sign("claim", 3, "i-a"), "claim", 3, "i-a")
    assert not OURS.proves("", "claim", 3, "i-a")
    assert not OURS.proves("é²", "claim", 3, "i-a")
    assert PeerSecret().proves("", "anything")
    assert not PeerSecret()


def test_the_secret_is_read_strictly_and_made_where_none_is_named(tmp_path: Path) -> None:
    own = tmp_path / OWN_SECRET
    made = read_secret(own)
    assert made
    assert own.stat().st_mode & 0o777 == 0o600
    assert read_secret(own).sign("a") == made.sign("a")
    assert [path.name for path in tmp_path.iterdir()] == [OWN_SECRET]
    assert not read_secret(None)
    assert not read_secret(tmp_path / "missing" / OWN_SECRET)
    path = tmp_path / "secret"
    with pytest.raises(InputError, match=r"peer_secret: got .*No such file"):
        read_secret(path)
    for content, mode, words in (
        (b"short", 0o600, "5 bytes"),
        (b"x" * 65, 0o600, "65 bytes"),
        (b"x" * 32, 0o644, "044"),
    ):
        path.write_bytes(content)
        path.chmod(mode)
        with pytest.raises(InputError, match=words):
            read_secret(path)


def test_a_claim_without_proof_or_with_an_absurd_epoch_is_none() -> None:
    claims = Claims(KEYS, "i-me", OURS)
    for key in (
        KEYS.claim(9, "i-rogue"),
        KEYS.claim(9, "i-rogue", "00"),
        KEYS.claim(9, "i-rogue", THEIRS.sign(*claim_parts(KEYS, 9, "i-rogue"))),
        KEYS.claim(9, "i-rogue", OURS.sign(*claim_parts(KEYS, 8, "i-rogue"))),
        KEYS.claim(9, "i-rogue", OURS.sign(*claim_parts(Keys("demo", "y"), 9, "i-rogue"))),
    ):
        claims.update(key, True)
        assert claims.highest() is None
    assert claims.unproven == 5
    assert claims.next_epoch() == 1
    claims.update(KEYS.claim(3, "i-peer", OURS.sign(*claim_parts(KEYS, 3, "i-peer"))), True)
    assert claims.highest() == Claim(3, "i-peer")
    claims.ignore(Claim(3, "i-peer"))
    assert claims.highest() is None
    for epoch in ("²", "١", "-1", str(MAX_EPOCH + 1), "9" * 400, "1.5", ""):
        assert parse_claim(f"{KEYS.base}/claim/{epoch}/i-a") is None


def test_without_a_place_for_a_secret_nobody_is_believed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    nowhere = tmp_path / "missing" / OWN_SECRET
    alone = ServeConfig("demo", (), peer_secret=nowhere)
    with caplog.at_level(logging.WARNING, "dehyst.service"):
        secret = secret_of(alone, standby=False)
    assert "no standby can follow" in caplog.text
    assert secret
    assert not secret.proves("", "claim", 9, "i-rogue")
    assert secret_of(alone, standby=False).sign("a") != secret.sign("a")
    for config, standby in ((alone, True), (replace(alone, standby_listen=("tcp/127.0.0.1:7449",)), False)):
        with pytest.raises(InputError, match=r"peer_secret: got nothing, .*cannot be written"):
            secret_of(config, standby)
    assert secret_of(replace(alone, peer_secret=tmp_path / OWN_SECRET), standby=True)


@pytest.mark.parametrize(
    ("listen", "secret", "warned"),
    [
        ("tls/192.0.2.10:7447", PeerSecret(), True),
        ("tls/192.0.2.10:7447", OURS, False),
        ("tcp/127.0.0.1:7447", PeerSecret(), False),
    ],
)
def test_who_believes_anybody_beyond_this_machine_says_so(
    listen: str, secret: PeerSecret, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "dehyst.service"):
        warn_without_secret(ServeConfig("demo", (), listen=(listen,)), secret)
    assert ["192.0.2.10" in record.getMessage() for record in caplog.records] == [True] * warned


def test_a_state_goes_to_peers_only_and_comes_from_peers_only(endpoint: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        secret = [OURS]
        refused: list[str] = []
        asked: list[str] = []
        taken = Nonces()

        def answer(query: zenoh.Query) -> None:
            def send() -> None:
                with query:
                    if send_sign_of_life(query, KEYS.state, "i-peer", secret[0]):
                        return
                    asked.append(str(query.parameters))
                    try:
                        check_asker(query, KEYS.state, secret[0], taken)
                        send_state(query, KEYS.state, [STATE], secret[0])
                    except ServiceError as error:
                        refused.append(str(error))
                        query.reply_err(b"no")

            threading.Thread(target=send).start()

        queryable = serving.declare_queryable(KEYS.state, answer)
        time.sleep(0.2)
        assert fetch_state(asking, KEYS.state, 5.0, secret=OURS) == STATE
        # The proof was seen on the wire, and is repeated.
        assert "proof=" in asked[0]
        replies = asking.get(f"{KEYS.state}?{asked[0]}", timeout=5.0, consolidation=zenoh.ConsolidationMode.NONE)
        assert [reply.ok for reply in replies] == [None]
        assert "used before" in refused.pop()
        assert gives_sign_of_life(asking, KEYS.state, "i-peer", 2.0, OURS)
        assert not gives_sign_of_life(asking, KEYS.state, "i-other", 0.5, OURS)
        assert fetch_state(asking, KEYS.state, 5.0) is None
        assert fetch_state(asking, KEYS.state, 5.0, secret=THEIRS) is None
        assert len(refused) == 2
        secret[0] = PeerSecret()  # a stranger that answers anybody
        with pytest.raises(ServiceError, match="does not know the secret"):
            fetch_state(asking, KEYS.state, 5.0, secret=OURS)
        assert not gives_sign_of_life(asking, KEYS.state, "i-peer", 0.5, OURS)
        assert fetch_state(asking, KEYS.state, 5.0) == STATE
        queryable.undeclare()  # type: ignore[no-untyped-call]


def test_strangers_that_answer_for_the_state_keep_it_from_nobody(endpoint: str) -> None:
    """They begin to send one and stop, in as many sessions as they like, before the one that serves has begun."""
    crowd = [open_client(endpoint) for _ in range(6)]
    held: list[zenoh.Query] = []

    def begin(query: zenoh.Query) -> None:
        held.append(query)
        query.reply(KEYS.state, bytes(50_000), attachment=struct.pack("<II", 0, 4) + b"0" * 32)

    def answer(query: zenoh.Query) -> None:
        def send() -> None:
            time.sleep(0.1)
            with query:
                check_asker(query, KEYS.state, OURS, taken)
                send_state(query, KEYS.state, [STATE], OURS)

        threading.Thread(target=send).start()

    taken = Nonces()
    with open_client(endpoint) as serving, open_client(endpoint) as asking, contextlib.ExitStack() as stack:
        for session in crowd:
            stack.enter_context(session)
            stack.callback(session.declare_queryable(KEYS.state, begin).undeclare)
        stack.callback(held.clear)
        stack.callback(serving.declare_queryable(KEYS.state, answer).undeclare)
        time.sleep(0.2)
        assert fetch_state(asking, KEYS.state, 5.0, secret=OURS) == STATE
        assert len(held) == len(crowd)


def test_a_freeze_that_a_stranger_tells_again_is_none(endpoint: str) -> None:
    told: list[bytes | None] = []
    seen: list[tuple[str, bytes]] = []
    taken = Nonces()

    def on_switch(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            seen.append((str(query.parameters), query.payload.to_bytes()))
            told.append(told_switch(query, KEYS.switch, OURS, taken))

    with open_client(endpoint) as serving, open_client(endpoint) as standby:
        queryable = standby.declare_queryable(KEYS.switch, on_switch)
        time.sleep(0.2)
        tell_standbys(serving, KEYS.switch, b"freeze", 1.0, OURS)
        for payload in (b"freeze", b"thaw"):
            list(serving.get(f"{KEYS.switch}?{seen[0][0]}", payload=payload, timeout=1.0))
        queryable.undeclare()  # type: ignore[no-untyped-call]
    assert told == [b"freeze", None, None]


def test_proofs_are_remembered_and_memory_is_bounded() -> None:
    taken = Nonces(remembered=3)
    assert [taken.is_new(nonce) for nonce in "aabcda"] == [True, False, True, True, True, True]
    assert not taken.is_new("x" * 65)


def test_who_stands_still_while_it_asks_takes_nobody_for_dead(endpoint: str) -> None:
    """The time is over when it goes on; the other one answers the next query."""
    answers = [False]

    def answer(query: zenoh.Query) -> None:
        with query:
            if answers[0]:
                send_sign_of_life(query, KEYS.state, "i-peer", OURS)
            else:
                time.sleep(0.7)
                answers[0] = True

    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        queryable = serving.declare_queryable(KEYS.state, answer)
        time.sleep(0.2)
        assert gives_sign_of_life(asking, KEYS.state, "i-peer", 0.6, OURS)
        answers[0] = False
        begin = time.monotonic()
        assert not gives_sign_of_life(asking, KEYS.state, "i-peer", 5.0, OURS, lambda: False)
        assert time.monotonic() - begin < 1.0
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
            KEYS.claim_any, lambda sample: heard.append(str(sample.key_expr)), history=True
        )
        stranger.declare_subscriber(KEYS.event, lambda sample: events.append(sample.payload.to_string()))
        eventually(lambda: client.status()["samples"]["learnt"] > 300)

        def impostor(query: zenoh.Query) -> None:
            with query:
                query.reply(KEYS.state, b"whatever", attachment=bytes((0, 0, 0, 0, 1, 0, 0, 0)))

        answering = stranger.declare_queryable(KEYS.state, impostor)
        rogue = stranger.liveliness().declare_token(KEYS.claim(1_000_000, "i9-rogue"))
        until = time.monotonic() + 4.0
        while time.monotonic() < until:
            status = client.status()
            assert (status["instance"], status["role"], status["epoch"]) == (first, "primary", 1)
            client.point(40.0)
            time.sleep(0.1)
        eventually(lambda: any("claim_ignored" in event for event in events), 5.0)
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
            eventually(lambda: client.status()["instance"] == second, 10.0)
        finally:
            gone.set()
            saying.join()
        for entity in (answering, rogue, repeated):
            entity.undeclare()  # type: ignore[no-untyped-call]
