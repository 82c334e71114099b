"""A limit of open files that is too low is named at the start, and by every command that meets it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dehyst.service.client.client import Client
from dehyst.service.runtime.session import open_client
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, eventually

resource = pytest.importorskip("resource")


def limited_to(number: int, *command: str) -> subprocess.CompletedProcess[str]:
    script = f'ulimit -n {number} && exec "$@"'
    return subprocess.run(
        ["sh", "-c", script, "sh", sys.executable, "-m", "dehyst.lab.cli", *command],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.e2e
def test_a_service_with_too_low_a_limit_says_what_it_needs(tmp_path: Path) -> None:
    config = write_config(tmp_path, unused_port(), axes=("x", "y"))
    done = limited_to(24, "serve", "--config", str(config))
    assert done.returncode == 2
    said = "dehyst serve: file descriptors: got a limit of 24, expected at least 96 for 2 axes and their clients; "
    assert done.stderr.startswith(said + "'ulimit -n 96' before the start")
    assert done.stderr.count("\n") == 1
    done = limited_to(9, "status", "--once", "--wait", "0", "--endpoint", f"tcp/127.0.0.1:{unused_port()}")
    assert done.returncode == 2
    assert done.stderr.startswith("dehyst status: too few file descriptors are left in this process, the limit is 9")
    assert done.stderr.count("\n") == 1


@pytest.mark.e2e
@pytest.mark.skipif(sys.platform != "linux", reason="prlimit")
def test_a_service_without_a_descriptor_left_still_tells_its_status(tmp_path: Path) -> None:
    service = Process("serve", "--config", str(write_config(tmp_path, port := unused_port())))
    endpoint = f"tcp/127.0.0.1:{port}"
    try:
        with Client.connect(endpoint, wait_s=20.0) as client:
            assert client.status()["memory"]["resident_bytes"] > 0
            most = max(int(name) for name in os.listdir(f"/proc/{service.process.pid}/fd")) + 1
            resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (most, most))
            # Clients that fill what is left of the table.
            others = [
                open_client(endpoint, 0.0) for _ in range(most - len(os.listdir(f"/proc/{service.process.pid}/fd")))
            ]
            eventually(lambda: client.status()["memory"]["resident_bytes"] is None)
            assert client.point(40.0).u_V > 0.0
            for session in others:
                session.close()  # type: ignore[no-untyped-call]
    finally:
        service.kill()
