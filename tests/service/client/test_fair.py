"""Long and short queries to a real service; what is refused, and that each query gets its one reply."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import BusyError, RefusedError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import encode_query
from dehyst.service.runtime.session import open_client, open_service
from tests.service.living import declared

pytestmark = pytest.mark.e2e
N = 40_000
Y = 45.0 + 30.0 * np.sin(3e-3 * np.arange(N))
V = np.gradient(Y, 1e-3)


@pytest.fixture
def client(shared_service: Any) -> Iterator[Client]:
    with Client.connect(shared_service.endpoint, timeout_s=10.0) as connected:
        yield connected


def test_a_long_query_is_answered_as_its_parts_are(client: Client) -> None:
    whole = client.trajectory(Y, V, np.zeros(N), model="lssvm_adaptive")
    parts, after = [], None
    for start in range(0, 2000, 100):
        part = slice(start, start + 100)
        after = client.trajectory(Y[part], V[part], np.zeros(100), model="lssvm_adaptive", after=after)
        parts.append(after.u_V)
    assert whole.u_V[:2000].tobytes() == np.concatenate(parts).tobytes()


def test_points_are_answered_while_others_ask_for_thousands(client: Client, shared_service: Any) -> None:
    with Client.connect(shared_service.endpoint, timeout_s=10.0) as other:
        answers: list[int] = []
        asking = threading.Thread(target=lambda: answers.append(other.trajectory(Y, V, np.zeros(N)).u_V.size))
        asking.start()
        points = 0
        while not answers:
            client.point(40.0)
            points += 1
        asking.join()
    # One after the other there would be one point at most.
    assert points > 5
    assert client.status()["queries"]["waiting_points"] == 0


@pytest.mark.parametrize("selector", ["model?nam=mpi", "status?name=mpi", "feedforward?name=mpi", "state?who=me"])
def test_parameters_that_nobody_knows_are_refused_once(client: Client, selector: str) -> None:
    replies = list(client._session.get(f"{client.keys.base}/{selector}", payload=encode_query(40.0, 0.0, 0.0)))
    assert len(replies) == 1
    assert replies[0].err is not None
    said = json.loads(replies[0].err.payload.to_bytes())
    assert said["field"] == "parameter"
    assert repr(selector.split("?")[1].split("=")[0]) == said["got"]


def test_more_points_than_configured_are_refused(serve: Any) -> None:
    process = serve(extra="query_points = 1000\n")
    with Client.connect(process.endpoint, timeout_s=10.0) as client:
        assert client.status()["queries"]["max_points"] == 1000
        assert client.trajectory(Y[:1000]).u_V.size == 1000
        for n in (1001, N):
            with pytest.raises(RefusedError, match=r"n: got \d+, expected 1 to 1000 points") as refused:
                client.trajectory(Y[:n])
            assert refused.value.field == "n"


@pytest.mark.parametrize("shares", [[0.0, 0.0], [-1.0, -1.0], [2.0, -1.0], [1.0, 1.0]])
def test_a_memory_without_shares_is_refused(client: Client, shares: list[float]) -> None:
    got = client.point(40.0, model="auto")
    memory = got.memory.copy()
    memory[: len(shares)] = shares
    with pytest.raises(RefusedError, match="memory: got the shares") as refused:
        client.point(40.0, model="auto", memory=memory)
    assert refused.value.field == "memory"


def test_a_client_waits_as_long_as_it_is_told(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    keys = Keys("demo", "x")
    came: list[float] = []
    with open_service([endpoint]) as session:

        def busy(query: Any) -> None:
            came.append(time.monotonic())
            with query:
                query.reply_err(json.dumps({"error": "busy", "message": "later", "retry_after_s": 0.5}).encode())

        session.declare_queryable(keys.feedforward, busy)
        with open_client(endpoint) as mine, Client(mine, keys, timeout_s=5.0, retry_s=2.0) as client:
            client._status = {"dt_s": 1e-3}
            declared(session, mine)
            with pytest.raises(BusyError) as refused:
                client.point(40.0)
    assert refused.value.retry_after_s == 0.5
    assert 2 <= len(came) <= 4, "fewer on a busy machine"
    assert min(np.diff(came)) >= 0.5
