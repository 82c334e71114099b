"""The state of an axis on its way: whole or not at all, and nobody waits for it."""

from __future__ import annotations

import itertools
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh

from dehyst.service.failover.state_transfer import fetch_state
from dehyst.service.runtime.session import open_client, open_router
from tests.service.conftest import unused_port
from tests.service.living import declared

KEY, SAMPLES, ECHO = "handover/state", "handover/sample", "handover/echo"
STATE = os.urandom(4_700_000)

_ASKER = """
import sys
from dehyst.service.failover.state_transfer import fetch_state
from dehyst.service.runtime.session import open_client
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


def answer(query: zenoh.Query) -> None:
    """As an instance does."""
    with query:
        query.reply(KEY, STATE)


def test_it_arrives_whole(endpoint: str) -> None:
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        assert fetch_state(asking, KEY, 1.0) is None
        serving.declare_queryable(KEY, answer)
        declared(serving, asking)
        assert fetch_state(asking, KEY, 5.0) == STATE


def test_it_ends_when_the_state_is_no_longer_wanted(endpoint: str) -> None:
    """As when the one that serves has gone while it sends: the standby must take over."""
    held: list[zenoh.Query] = []
    with open_client(endpoint) as serving, open_client(endpoint) as asking:
        serving.declare_queryable(KEY, held.append)
        declared(serving, asking)
        begin = time.monotonic()
        assert fetch_state(asking, KEY, 20.0, wanted=lambda: time.monotonic() < begin + 0.3) is None
        assert time.monotonic() - begin < 10.0
        held.clear()


def test_who_reads_slowly_makes_nobody_wait(endpoint: str) -> None:
    """Samples and answers pass while a standby stands still, again and again, with the state half read."""
    stop = threading.Event()
    came: list[float] = []
    asked: list[tuple[float, float]] = []
    stops: list[float] = []

    def send(session: zenoh.Session) -> None:
        publisher = session.declare_publisher(SAMPLES, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
        while not stop.wait(0.002):
            publisher.put(bytes(200))

    def ask(session: zenoh.Session) -> None:
        querier = session.declare_querier(ECHO, timeout=5.0, express=True)
        while not stop.wait(0.002):
            begin = time.monotonic()
            assert [reply.ok is not None for reply in querier.get()] == [True]
            asked.append((begin, time.monotonic()))

    asker = subprocess.Popen([sys.executable, "-c", _ASKER, endpoint, KEY], stdout=subprocess.PIPE, text=True)
    assert asker.stdout is not None
    try:
        with open_client(endpoint) as serving, open_client(endpoint) as stage, open_client(endpoint) as client:
            serving.declare_queryable(KEY, answer)
            serving.declare_queryable(ECHO, lambda query: (query.reply(ECHO, bytes(100)), query.drop()))
            heard = client.declare_subscriber(SAMPLES, lambda _: came.append(time.monotonic()))
            assert asker.stdout.readline() == "ready\n"
            declared(serving, client)
            declared(client, stage)
            threads = [threading.Thread(target=send, args=(stage,)), threading.Thread(target=ask, args=(client,))]
            for thread in threads:
                thread.start()
            # Shorter than what a router lets go of a receiver for.
            for _ in range(12):
                time.sleep(0.13)
                stops.append(time.monotonic())
                os.kill(asker.pid, signal.SIGSTOP)
                time.sleep(0.22)
                os.kill(asker.pid, signal.SIGCONT)
            while int(asker.stdout.readline()) < 3:  # and it does arrive; each line comes within five seconds
                pass
            stop.set()
            for thread in threads:
                thread.join()
            heard.undeclare()  # type: ignore[no-untyped-call]
    finally:
        asker.kill()
        asker.communicate(timeout=20)
    # A machine that stalls makes a gap now and then; a standby that holds others up makes one at each of its stops.
    for waits in (list(itertools.pairwise(came)), asked):
        worst = [max((b - a for a, b in waits if b > stop and a < stop + 0.22), default=0.22) for stop in stops]
        assert statistics.median(worst) < 0.15
