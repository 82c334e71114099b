"""Metrics for Prometheus from statuses, the page over HTTP, the health check, and the files of deploy/."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.cli.commands.status import _check
from dehyst.service.operating import metrics
from dehyst.service.operating.metrics import page, serve_page
from tests.service.living import eventually

DEPLOY = Path(__file__).parents[3] / "deploy"


def status(**more: Any) -> dict[str, Any]:
    samples = {"received": 1000, "learnt": 90, "lost": 1, "thinned": 2, "dropped": 3, "malformed": 4, "waiting": 5}
    return {
        "stage": "demo", "axis": "x", "role": "primary", "instance": "i1", "state": "ok", "state_reason": "",
        "trouble": "", "trust": 0.75, "answering": "last_good", "frozen": False, "stale": False, "thinning": 1,
        "rate_per_s": 999.5,
        "sample_age_s": None,
        "samples": {**samples, "gates": {"learnt": 90, "glitch": 7}},
        "quality": {"recent_rms_error_pct": 0.02, "fallback": 0.0},
        "queries": {"count": 10, "errors": 1, "p50_us": 100.0, "p99_us": 200.0},
        "recorder": None, "checkpoints": {"age_s": 3.0, "errors": 0}, "memory": {"resident_bytes": 5},
        **more,
    }  # fmt: skip


def values(text: str) -> dict[str, float]:
    lines = [line.rsplit(" ", 1) for line in text.splitlines() if line and not line.startswith("#")]
    return {name: float(value) for name, value in lines}


def test_the_page_has_every_axis_with_its_labels() -> None:
    other = status(axis="y", state="thinned 1/3", thinning=3, recorder={"written": 8, "lost": 1, "degraded": True})
    found = values(page([status(), other]).decode())
    x, y = (f'axis="{axis}",instance="i1",role="primary",stage="demo"' for axis in "xy")
    assert found["dehyst_up"] == 2
    assert found[f"dehyst_samples_received_total{{{x}}}"] == 1000
    assert found[f"dehyst_trust_ratio{{{x}}}"] == 0.75
    assert found[f'dehyst_answering{{answering="last_good",{x}}}'] == 1
    assert found[f"dehyst_healthy{{{x}}}"] == 1
    assert found[f"dehyst_healthy{{{y}}}"] == 0
    assert found[f'dehyst_samples_verdict_total{{{x},verdict="glitch"}}'] == 7
    assert found[f'dehyst_state{{{y},state="thinned"}}'.replace('stage="demo",state', 'stage="demo",state')] == 1
    assert found[f"dehyst_thinning_factor{{{y}}}"] == 3
    assert found[f"dehyst_recorder_degraded{{{y}}}"] == 1
    trouble = status(trouble="samples_lost", trouble_why="9 of 10 numbers are missing")
    (line,) = (name for name in values(page([trouble]).decode()) if name.startswith("dehyst_trouble{"))
    assert 'trouble="samples_lost",why="9 of 10 numbers are missing"' in line
    assert "dehyst_trouble{" not in page([status()]).decode()
    # What an axis does not have is missing, and no zero.
    assert f"dehyst_recorder_degraded{{{x}}}" not in found
    assert f"dehyst_sample_age_seconds{{{x}}}" not in found


def test_a_status_of_another_version_or_with_odd_values_does_not_end_the_page() -> None:
    odd = {"stage": "demo", "axis": 'x"\n', "instance": "i", "samples": {"received": "many", "gates": []}, "queries": 3}
    assert "dehyst_up 1.0" in page([odd]).decode()


def test_the_page_over_http_and_a_reading_that_fails() -> None:
    answers = iter([page([status()])])
    with serve_page("127.0.0.1", 0, lambda: next(answers)) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as reply:
            assert "dehyst_trust_ratio" in reply.read().decode()
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10)
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/other", timeout=10)
        with pytest.raises(InputError, match="cannot listen"), serve_page("127.0.0.1", port, lambda: b""):
            pass


def test_connections_that_send_slowly_end_and_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred of them used to leave a hundred threads that never ended."""
    monkeypatch.setattr(metrics, "REQUEST_S", 0.7, raising=False)
    before = threading.active_count()
    with contextlib.ExitStack() as opened, serve_page("127.0.0.1", 0, lambda: page([status()])) as port:
        slow = [opened.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10)) for _ in range(100)]
        begun, most = time.monotonic(), 0
        while time.monotonic() - begun < 1.5:
            for one in slow:
                with contextlib.suppress(OSError):  # those that were closed
                    one.send(b"G")
            most = max(most, threading.active_count() - before)
            time.sleep(0.1)
        assert most <= 1 + 16, "threads at a time"
        eventually(lambda: threading.active_count() == before + 1)  # no threads stay
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as reply:
            assert "dehyst_trust_ratio" in reply.read().decode()


@pytest.mark.parametrize(
    ("found", "code"),
    [
        ([], 4),
        ([status()], 0),
        ([status(), status(axis="y", state="frozen", state_reason="an operator")], 1),
        ([status(state="thinned 1/2")], 1),
        ([status(state="dropping")], 3),
        ([status(state="sensor_stuck", trouble="sensor_stuck"), status(state="frozen")], 3),
        ([status(state="stale", stale=True)], 3),
    ],
)
def test_the_health_check(found: list[dict[str, Any]], code: int) -> None:
    assert _check(found) == code


def test_the_dashboard_asks_only_for_metrics_that_there_are() -> None:
    recorder = {"written": 1, "lost": 0, "degraded": False}
    quality = {"recent_rms_error_pct": 1.0, "std_V": 1.0, "share_within_std": 0.7, "gain": 1.0, "fallback": 0.0}
    names = {
        name.split("{")[0]
        for name in values(page([status(recorder=recorder, quality=quality, sample_age_s=0.1)]).decode())
    }
    dashboard = json.loads((DEPLOY / "grafana-dashboard.json").read_text())
    asked = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"dehyst_\w+", target["expr"])
    }
    assert len(asked) > 10
    assert asked <= names
