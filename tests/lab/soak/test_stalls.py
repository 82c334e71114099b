"""What is written of the threads in a silence, and whom it blames."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from lab.soak.stalls import StallWatch, ThreadTimes, cause, since, threads_of
from lab.testbed import free_port

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the kernel's counts are Linux's")


def test_threads_are_told_with_what_they_do() -> None:
    stop = threading.Event()
    busy = threading.Thread(target=lambda: [None for _ in iter(stop.is_set, True)])
    busy.start()
    try:
        before = threads_of(os.getpid())
        time.sleep(0.2)
        rows = since(before, threads_of(os.getpid()))
    finally:
        stop.set()
        busy.join()
    ran = next(row for row in rows if row["id"] == busy.native_id)
    assert ran["ran_ms"] + ran["ready_ms"] > 50.0
    assert threads_of(2**22 + 1) == {}


def test_a_thread_that_was_ready_and_got_no_processor_blames_the_machine() -> None:
    def row(ready_s: float, ran_s: float = 0.01) -> list[dict[str, object]]:
        now = {7: ThreadTimes("learn", "R", "", 1.0 + ran_s, 2.0 + ready_s)}
        return since({7: ThreadTimes("learn", "S", "futex", 1.0, 2.0)}, now)

    assert cause(0.3, 0.4, row(0.2)) == "machine"
    assert cause(0.3, 1.0, row(0.2)) == "service", "a fifth of a second is usual for a busy thread"
    assert cause(0.3, 0.4, row(0.02)) == "service"
    assert cause(0.3, 0.4, row(0.02, ran_s=0.25)) == "service"
    assert cause(0.3, 0.4, []) == "service"


def test_a_silence_is_written_with_the_stacks_of_the_service(tmp_path: Path) -> None:
    clock = tmp_path / "clock.bin"
    clock.write_bytes(bytes(8))
    program = ["-m", "lab.testbed.shifted_clock", str(clock), "router", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    child = subprocess.Popen([sys.executable, *program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    stacks = tmp_path / f"stacks-{child.pid}.txt"
    silences = iter([0.0, 0.2])
    try:
        until = time.monotonic() + 60.0
        while not (stacks.exists() and stacks.stat().st_size) and time.monotonic() < until:
            time.sleep(0.02)
        with StallWatch(tmp_path, lambda: next(silences, 0.0), lambda: {"a": child.pid}, lambda: 5.0) as watch:
            while "---" not in stacks.read_text() and time.monotonic() < until:
                time.sleep(0.02)
    finally:
        child.kill()
        child.communicate()
    (line,) = [json.loads(text) for text in (tmp_path / "stalls.jsonl").read_text().splitlines()]
    assert (line["t_s"], line["silent_s"]) == (5.0, 0.2)
    assert line["cause"] in ("machine", "service")
    assert "a" in line["processes"]
    assert "in 1 silences" in watch.note()
    assert "MainThread:" in stacks.read_text()


def test_a_process_that_is_not_ready_to_write_its_stacks_is_left_alone(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(30)"])
    silences = iter([0.2])
    try:
        with StallWatch(tmp_path, lambda: next(silences, 0.0), lambda: {"a": child.pid}, lambda: 5.0):
            until = time.monotonic() + 10.0
            while not (tmp_path / "stalls.jsonl").exists() and time.monotonic() < until:
                time.sleep(0.02)
        time.sleep(0.1)
        assert child.poll() is None
    finally:
        child.kill()
        child.communicate()
