"""Several hosts: a router, two service hosts that stand by for each other, a lab host; one is lost in the middle."""

from __future__ import annotations

import itertools
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from service.keys import Keys
from service.session import open_client, open_router, open_service
from tests.e2e.scale_hosts import ENTER, namespaces_missing
from tests.service.conftest import unused_port

pytestmark = pytest.mark.e2e
#: Longest time without an answer while the standby takes over from a host that vanished: its lease is 1 s.
_TAKEN_OVER_S = 6.0
#: Signs of life come every quarter of a lease of 1 s: a machine that stands still for so long makes services look dead.
_STALL_S = 0.7


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the openssl command is not installed")
@pytest.mark.timeout(170)
def test_a_host_is_lost_and_its_axes_go_on_elsewhere(tmp_path: Path, record_property: Any) -> None:
    missing = namespaces_missing()
    record_property("hosts", f"processes: {missing}" if missing else "network namespaces")
    if missing:
        print(f"no network namespaces here ({missing}): plain processes on loopback instead")
    enter, options = ((), ("--processes",)) if missing else (ENTER, ())
    done = subprocess.run(
        [*enter, sys.executable, "-m", "tests.e2e.scale_drill", str(tmp_path / "access"), *options],
        capture_output=True, text=True, timeout=160, check=False, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    seen = json.loads(done.stdout.splitlines()[-1])
    planned = {"one/left": "primary", "two/right": "primary", "two/left": "standby", "one/right": "standby"}
    if seen["roles"] != planned and seen["stalled_s"] > _STALL_S:
        pytest.skip(
            f"the machine stood still for {seen['stalled_s']:.1f} s: a standby rightly took over before the loss"
        )
    assert seen["roles"] == planned, (seen["epochs"], seen["stalled_s"], done.stderr[-3000:])
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


def test_a_service_that_loses_its_router_moves_to_the_next() -> None:
    first, second = (f"tcp/127.0.0.1:{unused_port()}" for _ in range(2))
    key = Keys("demo", "x").status
    one = open_router([first])
    two = open_router([second], [first])
    with two, open_service([], [first, second]) as service, open_client(second, 5.0) as client:
        queryable = service.declare_queryable(key, lambda query: (query.reply(key, b"here"), query.drop()))

        def asked() -> bool:
            return any(reply.ok is not None for reply in client.get(key, timeout=0.5))

        until = time.monotonic() + 10.0
        while not asked():
            assert time.monotonic() < until
        one.close()
        until = time.monotonic() + 10.0
        while not asked():
            assert time.monotonic() < until, "the service did not come back by the other router"
        queryable.undeclare()
