"""A subscriber that cannot keep up is let go by the router, and nobody else waits for it."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time

import pytest
import zenoh

from dehyst.lab.soak.controller import AXIS, STAGE
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import LEASE_S, open_client
from tests.service.conftest import unused_port

RATE_HZ, BYTES = 500.0, 2000


def started(*module: str) -> subprocess.Popen[str]:
    """A module as a process that has said that it is ready."""
    process = subprocess.Popen([sys.executable, "-m", *module], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready")
    return process


@pytest.mark.e2e
@pytest.mark.alone
def test_a_slow_subscriber_holds_nobody_up() -> None:
    endpoint = f"tcp/127.0.0.1:{unused_port()}"
    children = [started("dehyst.lab.cli", "router", "--listen", endpoint)]
    stop = threading.Event()
    came: list[float] = []

    def send(session: zenoh.Session) -> None:
        block = zenoh.CongestionControl.BLOCK
        publisher = session.declare_publisher(Keys(STAGE, AXIS).sample, congestion_control=block, express=True)
        start, sent = time.monotonic(), 0
        while not stop.is_set():
            publisher.put(bytes(BYTES))
            sent += 1
            time.sleep(max(0.0, start + sent / RATE_HZ - time.monotonic()))
        publisher.undeclare()  # type: ignore[no-untyped-call]

    try:
        with open_client(endpoint, 10.0) as one, open_client(endpoint, 10.0) as other:
            subscriber = one.declare_subscriber(Keys(STAGE, AXIS).sample, lambda _: came.append(time.monotonic()))
            sender = threading.Thread(target=send, args=(other,))
            sender.start()
            try:
                children.append(started("dehyst.lab.soak.disturbers", "slow", endpoint))
                time.sleep(4.0)
                # Others come and go meanwhile, which is when everybody would have to wait.
                for _ in range(4):
                    with open_client(endpoint, 10.0) as third:
                        third.declare_subscriber("somewhere/else", lambda _: None)
                children[1].terminate()
                time.sleep(1.0)
            finally:
                stop.set()
                sender.join()
                subscriber.undeclare()  # type: ignore[no-untyped-call]
    finally:
        for child in reversed(children):
            child.kill()
            child.communicate(timeout=20)
    gaps = [after - before for before, after in itertools.pairwise(came)]
    assert len(came) > 0.9 * RATE_HZ * 4.0
    assert max(gaps) < LEASE_S
