"""A disk that takes nothing more shows in the state of the axis, by one name everywhere, until there is room again."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Any

import pytest

from dehyst.service.cli.main import main
from dehyst.service.client.client import Client
from dehyst.service.operating.metrics import page
from dehyst.service.server.health import NOT_KEPT, NOT_RECORDED, DiskFailures
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, Stage, eventually


def counters(lost: int = 0, dropped: int = 0, error: str = "") -> dict[str, Any]:
    return {"lost": lost, "dropped": dropped, "degraded": bool(error), "error": error}


def test_what_fails_has_a_name_until_it_is_over() -> None:
    watch = DiskFailures()
    kept = {"degraded": False, "error": ""}
    assert not watch.look(counters(), kept)
    assert watch.look(counters(lost=7, error="No space left on device"), kept)
    assert watch.trouble == NOT_RECORDED
    assert watch.why.startswith("No space left on device; make room")
    assert not watch.look(counters(lost=7, error="No space left on device"), kept | {"degraded": True})
    # The recording goes on before the next checkpoint is due.
    assert watch.look(counters(lost=7), {"degraded": True, "error": "No space left on device"})
    assert watch.trouble == NOT_KEPT
    assert "a restart goes back to the newest" in watch.why
    assert watch.look(counters(lost=7), kept)
    assert watch.trouble == watch.why == ""
    # A disk that fails nothing and is too slow.
    assert watch.look(counters(lost=7, dropped=3), kept)
    assert watch.trouble == NOT_RECORDED
    assert "too slow" in watch.why
    assert watch.look(counters(lost=7, dropped=3), kept)
    assert not watch.look(None, None)


@pytest.mark.e2e
@pytest.mark.skipif(sys.platform != "linux", reason="prlimit")
def test_a_full_disk_is_the_state_in_status_metrics_log_and_health_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extra = 'recorder = "rec"\ncheckpoints = "kept"\ncheckpoint_s = 0.5\n'
    service = Process("serve", "--config", str(write_config(tmp_path, port := unused_port(), extra=extra)))
    endpoint = f"tcp/127.0.0.1:{port}"
    try:
        with Client.connect(endpoint, wait_s=20.0) as client, Stage([endpoint]):
            eventually(lambda: client.status()["recorder"]["written"] > 500)
            eventually(lambda: client.status()["trouble"] == "")
            resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            status = eventually(lambda: (s := client.status())["recorder"]["lost"] > 500 and s, 30.0)
            assert status["state"] == status["trouble"] == NOT_RECORDED
            assert "File too large" in status["trouble_why"]
            assert "samples since the start are in no recording" in status["state_reason"]
            shown = page([status]).decode()
            assert f'trouble="{NOT_RECORDED}"' in shown
            assert f'state="{NOT_RECORDED}"' in shown
            assert main(["status", "--check", "--endpoint", endpoint]) == 3
            assert f"demo/x: {NOT_RECORDED}: " in capsys.readouterr().out
            resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
            status = eventually(lambda: (s := client.status())["trouble"] == "" and s, 30.0)
            assert status["state"] not in (NOT_RECORDED, NOT_KEPT)
            lost = status["recorder"]["lost"]
            eventually(lambda: client.status()["recorder"]["written"] > status["recorder"]["written"] + 500)
            assert client.status()["recorder"]["lost"] == lost
    finally:
        service.process.terminate()
        log = service.process.communicate(timeout=60)[1]
    assert f"trouble: {NOT_RECORDED} (File too large; make room" in log
