"""Several hosts: a router, two service hosts that stand by for each other, a lab host; one is lost in the middle."""

from __future__ import annotations

import itertools
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest

from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.query import Point
from tests.e2e.scale_drill import drill
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, Stage, eventually

pytestmark = pytest.mark.e2e
#: Longest time without an answer while the standby takes over from a host that vanished: its lease is 1 s.
_TAKEN_OVER_S = 6.0
#: Signs of life come every quarter of a lease of 1 s: a machine that stands still for so long makes services look dead.
_STALL_S = 0.7


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the openssl command is not installed")
@pytest.mark.timeout(300)
def test_a_host_is_lost_and_its_axes_go_on_elsewhere(tmp_path: Path) -> None:
    seen = drill(tmp_path / "access")
    planned = {"one/left": "primary", "two/right": "primary", "two/left": "standby", "one/right": "standby"}
    if seen["roles"] != planned and seen["stalled_s"] > _STALL_S:
        pytest.skip(
            f"the machine stood still for {seen['stalled_s']:.1f} s: a standby rightly took over before the loss"
        )
    assert seen["roles"] == planned, (seen["epochs"], seen["stalled_s"])
    client = seen["client"]
    before, after = (
        {f"{status['stage']}/{status['axis']}": status for status in client[when]} for when in ("before", "after")
    )
    assert set(before) == set(after) == {"left/x", "left/y", "right/x", "right/y"}
    for name, rows in client["asked"].items():
        answered = [(at, u_V) for at, _, u_V, _ in rows if u_V is not None]
        # The same question has the same answer throughout, whoever gives it.
        assert {round(u_V, 9) for _, u_V in answered} == {round(39 / 11, 9)}
        gaps = [b[0] - a[0] for a, b in itertools.pairwise(answered)]
        moved = before[name]["instance"] != after[name]["instance"]
        assert moved == name.startswith("left")
        assert max(gaps) < _TAKEN_OVER_S, name
        assert answered[-1][0] > seen["lost_at_s"] + 2.0
        # Samples of the stage go on reaching whoever serves.
        assert after[name]["seq"] > before[name]["seq"]
        if not moved:
            # Asked in turn with the axes of the lost host, so it waits with them; but none of its own queries fails.
            assert not [failure for *_, failure in rows if failure]
            assert after[name]["received"] > before[name]["received"]
    assert client["operated"]["instance"] == after["left/x"]["instance"]
    for name in after:
        assert before[name]["synced"]
        assert after[name]["synced"]
        # It goes on learning, and counts on from where the other was.
        assert after[name]["learnt"] > before[name]["learnt"]


def test_a_service_that_loses_its_router_moves_to_the_next(tmp_path: Path) -> None:
    """Two routers and a service as processes; the one that the service is connected to is killed."""
    ports = unused_port(), unused_port()
    first, second = (f"tcp/127.0.0.1:{port}" for port in ports)
    with ExitStack() as running:

        def start(*arguments: str) -> Process:
            process = Process(*arguments)
            running.callback(process.kill)
            return process

        routers = {
            ports[0]: start("router", "--listen", first),
            ports[1]: start("router", "--listen", second, "--connect", first),
        }
        config = write_config(tmp_path, 1)
        text = config.read_text(encoding="utf-8").replace('listen = ["tcp/127.0.0.1:1"]', "listen = []")
        assert "listen = []\n" in text
        config.write_text(f'connect = ["{first}", "{second}"]\n{text}', encoding="utf-8")
        service = start("serve", "--config", str(config))
        assert service.ready["listen"] == []
        lost = next(port for port in ports if port in _linked(service))
        other = next(port for port in ports if port != lost)
        # Stage and client are at the other router all along: what changes is where the service is.
        endpoint = f"tcp/127.0.0.1:{other}"
        with Stage([endpoint]), Client.connect(endpoint, wait_s=20.0, timeout_s=1.0, retry_s=0.0) as client:
            assert client.status()["instance"] == service.ready["instance"]
            before = eventually(lambda: _learns(client, 100))
            learnt = client.point(40.0)
            routers[lost].kill()
            after = eventually(lambda: _learns(client, before["samples"]["learnt"] + 100))
            # The very service, with what it had learnt; it heard the stage again, and it answers.
            assert after["instance"] == service.ready["instance"]
            assert after["snapshot_seq"] > before["snapshot_seq"]
            assert after["synced"]
            answered = eventually(lambda: _answered(client))
            assert answered.model == learnt.model
            assert not answered.fallback
            assert client.point(40.0, model="linear").u_V == pytest.approx(39 / 11)
            assert other in _linked(service)
            assert lost not in _linked(service)
        assert service.process.poll() is None


def _linked(process: Process) -> set[int]:
    """The ports at the other ends of its connections."""
    return {link.raddr.port for link in psutil.Process(process.process.pid).net_connections("tcp") if link.raddr}


def _learns(client: Client, samples: int) -> dict[str, Any] | None:
    """The status, once so many samples have been learnt from."""
    try:
        status = client.status()
    except ServiceError:
        return None
    return status if status["samples"]["learnt"] > samples else None


def _answered(client: Client) -> Point | None:
    try:
        return client.point(40.0)
    except ServiceError:
        return None
