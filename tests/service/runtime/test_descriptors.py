"""A limit of open files that is too low is named at the start, and by every command that meets it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dehyst.service.cli.main import Command, main
from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import FieldError
from dehyst.service.runtime.descriptors import need_descriptors, too_few
from dehyst.service.runtime.memory import in_use
from dehyst.service.runtime.session import open_client
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, eventually

resource = pytest.importorskip("resource")
Limited = Callable[[int], None]


@pytest.fixture
def limited() -> Any:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield lambda soft: resource.setrlimit(resource.RLIMIT_NOFILE, (soft, before[1]))
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_low_soft_limit_is_raised(limited: Limited) -> None:
    limited(40)
    need_descriptors(4)
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= 128


def test_where_nothing_more_can_be_opened_it_is_said(limited: Limited, capsys: pytest.CaptureFixture[str]) -> None:
    assert too_few() == ""
    commands = {"open": Command(__name__, "other", "open a file")}
    assert main(["open"], commands) == 0  # all that it imports
    highest = max(map(int, os.listdir("/proc/self/fd"))) if Path("/proc/self/fd").is_dir() else 64
    opened = [os.open(os.devnull, os.O_RDONLY) for _ in range(highest)]
    try:
        limited(min(opened))
        assert f"too few file descriptors are left in this process, the limit is {min(opened)}: raise it" in too_few()
        assert in_use()["resident_bytes"] is None or sys.platform != "linux"
        assert main(["open"], commands) == 1
        assert capsys.readouterr().err.startswith("dehyst open: too few file descriptors are left in this process")
    finally:
        for one in opened:
            os.close(one)


def add_arguments(_: Any) -> None:
    """Of the command ``open``."""


def run(_: Any) -> int:
    """The command ``open``."""
    os.close(os.open(os.devnull, os.O_RDONLY))
    return 0


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


def test_a_need_beyond_the_hard_limit_is_refused(limited: Limited) -> None:
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if hard == resource.RLIM_INFINITY:
        pytest.skip("no hard limit here")
    with pytest.raises(FieldError, match=rf"file descriptors: got a limit of {hard}, expected at least"):
        need_descriptors(hard)
