"""The state of an axis on its way: whole or not at all, and nobody waits for it."""

from __future__ import annotations

import itertools
import os
import signal
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterable, Iterator

import pytest
import zenoh

from service.failover.state_transfer import MAX_PAUSE_S, PAUSE_S, fetch_state, joined, send_state
from service.runtime.session import open_client, open_router
from tests.service.conftest import unused_port

KEY, SAMPLES, ECHO = "handover/state", "handover/sample", "handover/echo"
STATE = os.urandom(4_700_000)

_ASKER = """
import sys
from service.failover.state_transfer import fetch_state
from service.runtime.session import open_client
with open_client(sys.argv[1], 10.0) as session:
    print("ready", flush=True)
    whole = 0
    while True:
        whole += fetch_state(session, sys.argv[2], 5.0) is not None
        print(whole, flush=True)
"""


@pytest.fixture
def endpoint() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    with open_router([endpoint]):
        yield endpoint


def placed(*places: tuple[int, int]) -> list[bytes]:
    return [struct.pack("<II", *place) + b"x" for place in places]


def join_parts(parts: Iterable[bytes]) -> bytes | None:
    """The whole that one sender's parts make."""
    return next(joined(("a", part) for part in parts), None)


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [b""],
        [b"\0" * 7],
        [b"\0" * 9],
        placed((0, 0)),
        placed((0, 2)),
        placed((1, 2)),
        placed((0, 2), (0, 2)),
        placed((0, 2), (1, 3), (2, 3)),
        placed((1, 1)),
        [struct.pack("<II", 0, 1) + b"x" * 60_000],
    ],
)
def test_parts_that_make_no_whole_are_refused(parts: list[bytes]) -> None:
    assert join_parts(placed((0, 3), (1, 3), (2, 3))) == b"xxx"
    assert join_parts(parts) is None


def test_what_is_whole_is_not_waited_with() -> None:
    def parts() -> Iterator[bytes]:
        yield from placed((0, 2), (1, 2))
        raise AssertionError("the end may be lost")

    assert join_parts(parts()) == b"xx"


def test_nobody_fills_the_memory_of_the_one_that_asks() -> None:
    def without_end() -> Iterator[bytes]:
        for i in itertools.count():
            yield struct.pack("<II", i, 2**32 - 1) + bytes(50_000)

    tracemalloc.start()
    assert join_parts(without_end()) is None
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def test_what_a_stranger_sends_between_spoils_nothing_for_the_one_that_serves() -> None:
    honest = [("a", part) for part in placed((0, 3), (1, 3), (2, 3))]
    other = [("b", part) for part in placed((0, 2), (1, 2))]
    rubbish = [("c", b"x"), ("d", struct.pack("<II", 0, 2**32 - 1) + b"x")]
    mixed = [*rubbish, other[0], honest[0], honest[1], other[1], honest[2]]
    assert list(joined(mixed)) == [b"xx", b"xxx"]
    crowd = [(str(k), placed((0, 2))[0]) for k in range(50)]
    assert list(joined([honest[0], *crowd, *honest[1:]])) == [b"xxx"]


def test_senders_of_nothing_but_rubbish_are_not_heard_for_ever() -> None:
    def without_end() -> Iterator[tuple[str, bytes]]:
        while True:
            yield "c", b"x"

    begin = time.monotonic()
    assert list(joined(without_end())) == []
    assert time.monotonic() - begin < 5.0


def in_a_thread(query: zenoh.Query) -> None:
    def reply() -> None:
        with query:
            send_state(query, KEY, [STATE[:1000], STATE[1000:]])

    threading.Thread(target=reply).start()


def asked(session: zenoh.Session, pause_s: float) -> bytes | None:
    """What arrives when asked for as a standby does: a part may be lost, and more slowly the next time it comes."""
    for _ in range(6):
        data = fetch_state(session, KEY, 5.0, pause_s)
        if data is not None:
            return data
        pause_s = max(PAUSE_S, min(2.0 * pause_s, MAX_PAUSE_S))
    return None


def test_it_arrives_whole_at_any_pace(endpoint: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        assert fetch_state(asking, KEY, 1.0) is None
        serving.declare_queryable(KEY, in_a_thread)
        time.sleep(0.2)
        assert asked(asking, PAUSE_S) == STATE
        assert asked(asking, 0.0) == STATE
        begin = time.monotonic()
        assert asked(asking, 0.008) == STATE
        assert time.monotonic() - begin > 0.6


@pytest.mark.parametrize("pause", ["", "nan", "-1", "1e9", "soon"])
def test_any_pace_can_be_asked_for_and_is_kept_within_reason(endpoint: str, pause: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        serving.declare_queryable(KEY, in_a_thread)
        time.sleep(0.2)
        replies = asking.get(f"{KEY}?pause_s={pause}", timeout=5.0, consolidation=zenoh.ConsolidationMode.NONE)
        parts = [reply.ok.payload.to_bytes()[8:] for reply in replies if reply.ok is not None]
        assert b"".join(parts) == STATE


@pytest.mark.parametrize("lost", [0, 3, 81, None])
@pytest.mark.parametrize("ended", [True, False])
def test_a_part_that_is_missing_is_noticed(endpoint: str, lost: int | None, ended: bool) -> None:
    """Or one that says nothing of its place: who answers is of another release. At once, though the end is lost too."""
    kept: list[zenoh.Query] = []

    class Lossy:
        def __init__(self, query: zenoh.Query) -> None:
            self.query, self.sent = query, 0

        def reply(self, key: str, part: bytes, attachment: bytes | None) -> None:
            if self.sent != lost:
                self.query.reply(key, part[8:] if lost is None else part, attachment=attachment)
            self.sent += 1

        def __getattr__(self, name: str) -> object:
            return getattr(self.query, name)

    def answer(query: zenoh.Query) -> None:
        send_state(Lossy(query), KEY, [STATE])  # type: ignore[arg-type]
        if ended:
            query.drop()
        else:
            kept.append(query)

    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        serving.declare_queryable(KEY, answer)
        time.sleep(0.2)
        begin = time.monotonic()
        assert fetch_state(asking, KEY, 20.0) is None
        assert time.monotonic() - begin < 10.0
        for query in kept:
            query.drop()


@pytest.mark.alone
def test_who_reads_slowly_makes_nobody_wait(endpoint: str) -> None:
    """Samples and answers pass while a standby stands still, again and again, with the state half read."""
    stop = threading.Event()
    came: list[float] = []
    asked: list[float] = []

    def send(session: zenoh.Session) -> None:
        publisher = session.declare_publisher(SAMPLES, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        while not stop.wait(0.002):
            publisher.put(bytes(200))

    def ask(session: zenoh.Session) -> None:
        querier = session.declare_querier(ECHO, timeout=5.0, express=True)
        while not stop.wait(0.002):
            begin = time.monotonic()
            assert [reply.ok is not None for reply in querier.get()] == [True]
            asked.append(time.monotonic() - begin)

    asker = subprocess.Popen([sys.executable, "-c", _ASKER, endpoint, KEY], stdout=subprocess.PIPE, text=True)
    assert asker.stdout is not None
    try:
        with open_client(endpoint) as serving, open_client(endpoint) as stage, open_client(endpoint) as client:
            serving.declare_queryable(KEY, in_a_thread)
            serving.declare_queryable(ECHO, lambda query: (query.reply(ECHO, bytes(100)), query.drop()))
            heard = client.declare_subscriber(SAMPLES, lambda _: came.append(time.monotonic()))
            assert asker.stdout.readline() == "ready\n"
            time.sleep(0.3)
            threads = [threading.Thread(target=send, args=(stage,)), threading.Thread(target=ask, args=(client,))]
            for thread in threads:
                thread.start()
            # Shorter than what a router lets go of a receiver for.
            for _ in range(12):
                time.sleep(0.13)
                os.kill(asker.pid, signal.SIGSTOP)
                time.sleep(0.22)
                os.kill(asker.pid, signal.SIGCONT)
            time.sleep(1.0)
            stop.set()
            for thread in threads:
                thread.join()
            heard.undeclare()  # type: ignore[no-untyped-call]
    finally:
        asker.kill()
        told = asker.communicate(timeout=20)[0].split()
    gaps = [after - before for before, after in itertools.pairwise(came)]
    print(max(gaps), max(asked), sorted(asked)[len(asked) // 2], told[-1], len(came))
    assert max(gaps) < 0.15
    assert max(asked) < 0.15
    assert int(told[-1]) >= 3, "and it does arrive"
