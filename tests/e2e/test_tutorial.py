"""The tutorial's programs, as they are on the page, from the simulated controller to the corrected move.

Shorter recordings and moves, and free ports, are the only changes.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from dehyst.service.client import Client
from tests.docs.test_pages import ROOT, saved
from tests.service.conftest import unused_port

# Alone: its programs keep the stage's time by themselves, and a sample that comes late is a sample that is missing.
pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.alone]
pytest.importorskip("pipython", reason="pipython is not installed (extra 'hardware')")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


@contextmanager
def running(folder: Path, *args: str) -> Iterator[subprocess.Popen[str]]:
    """A process of the tutorial, ready when entered."""
    process = subprocess.Popen([sys.executable, *args], cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready"), args
        yield process
    finally:
        process.kill()
        process.communicate(timeout=20)


def done(folder: Path, *args: str) -> str:
    finished = subprocess.run(
        [sys.executable, *args], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=120
    )
    assert finished.returncode == 0, f"{args}\n{finished.stdout}\n{finished.stderr}"
    return finished.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """(a folder in which the tutorial has come to step 6, the endpoint of its service)."""
    folder = tmp_path_factory.mktemp("tutorial")
    pi, service = unused_port(), unused_port()
    for name, text in {**saved(), "run_stage.py": (ROOT / "examples" / "run_stage.py").read_text()}.items():
        changed = {"50000": str(pi), "7447": str(service), "duration_s=30.0": "duration_s=8.0", "= 10, 0.5": "= 4, 0.5"}
        for printed, here in changed.items():
            text = text.replace(printed, here)
        (folder / name).write_text(text)
    with ExitStack() as stack:
        stack.enter_context(running(folder, "-m", "dehyst.service.adapters.simulated_pi", "--port", str(pi)))
        assert "came late" in done(folder, "record_stage.py")
        assert "models: stage.npz" in done(
            folder, "-m", "dehyst.lab.cli", "identify", "recording.csv", "--out", "stage.npz"
        )
        stack.enter_context(running(folder, "-m", "dehyst.lab.cli", "serve", "--config", "serve.toml"))
        yield folder, f"tcp/127.0.0.1:{service}"


def test_the_corrected_move_follows_and_the_service_learns_from_it(folder: tuple[Path, str]) -> None:
    where, endpoint = folder
    printed = done(where, "corrected_move.py")
    percent = {
        name: float(value) for name, value in re.findall(r"^(.+?): .*?, ([\d.]+) % of the motion", printed, re.M)
    }
    assert set(percent) == {"mean gain", "corrected"}
    # The hysteresis of this stage is 12 % of a full stroke. On a loaded machine voltages come late.
    assert percent["mean gain"] > 2.0
    assert percent["corrected"] < 0.5 * percent["mean gain"]
    with Client.connect(endpoint) as client:
        assert client.status()["samples"]["learnt"] > 100


def test_a_stage_for_another_process_applies_what_is_commanded(folder: tuple[Path, str]) -> None:
    where, endpoint = folder
    with Client.connect(endpoint) as client, running(where, "run_stage.py") as stage:
        first = int(client.status()["seq"]) + 1
        answer = client.trajectory([20.0] * 400, begin=first)
        client.command(first, answer.u_V)
        for _ in range(200):
            if client.status()["seq"] > first + 250:
                break
            time.sleep(0.05)
        assert client.status()["seq"] > first
        stage.send_signal(signal.SIGINT)
        assert stage.wait(20) == 0
