"""A short soak as a user runs it: real processes, real faults, and the files that are promised."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

#: What holds on any machine, however busy; the others depend on how soon it lets a process run.
SAFE = {"voltages_finite", "voltages_within_limits", "voltages_within_slew", "answers_safe", "samples_accounted",
        "processes_alive", "no_record_lost"}  # fmt: skip


def command(out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "dehyst.lab.cli", "soak", "--out", str(out), "--seed", "4", "--json", *options]


def read(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "soak.json").read_text(encoding="utf-8")))


@pytest.mark.e2e
@pytest.mark.slow
def test_faults_of_processes_samples_and_machine_are_told_and_nothing_unsafe_is_sent(tmp_path: Path) -> None:
    """One after the other. What depends on how soon a busy machine lets a process run is not judged here."""
    kinds = ["kill_primary", "nan", "restart_stage", "disk_full", "slow_viewer"]
    done = subprocess.run(
        command(tmp_path, "--duration", "64s", "--faults", ",".join(kinds)),
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    found = read(tmp_path)
    assert found == json.loads(done.stdout)
    assert set(found) == {"verdict", "not_judged", "duration_s", "faults", "invariants", "latency", "samples"}
    must = {*SAFE, "faults_told"}
    assert {name: found["invariants"][name] for name in must if not found["invariants"][name]["held"]} == {}
    assert {kind: fault["count"] for kind, fault in found["faults"].items()} == dict.fromkeys(kinds, 1)
    assert found["faults"]["nan"]["told_by"] == ["samples.gates.not_finite"]
    assert found["latency"]["p50_us"] > 0.0
    assert found["samples"]["seen"] > 40_000
    assert found["samples"]["in_no_recording_and_no_fault_on"] == 0
    assert "memory" in found["not_judged"], "too short a run"
    line = f"{found['verdict']}; not judged: "
    assert line in done.stderr
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith(f"# Soak: {line}")
    assert "soak.png" in report
    assert (tmp_path / "soak.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert {f["kind"] for f in json.loads((tmp_path / "plan.json").read_text())["faults"]} == set(kinds)


@pytest.mark.e2e
def test_ctrl_c_leaves_a_report_of_what_ran(tmp_path: Path) -> None:
    process = subprocess.Popen(
        command(tmp_path, "--duration", "2h", "--faults", "gap"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        for line in process.stderr:
            if line.startswith("  [") and "   0 of 7200" not in line:
                break
        process.send_signal(signal.SIGINT)
        begin = time.monotonic()
        process.communicate(timeout=60)
        assert time.monotonic() - begin < 60.0
    finally:
        process.kill()
    assert process.returncode == 130
    found = read(tmp_path)
    assert 0.0 < found["duration_s"] < 7200.0
    assert found["invariants"]["voltages_within_slew"]["held"]
    assert "Interrupted" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_what_cannot_be_asked_for_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dehyst.lab.cli import main

    for options, named in (
        (["--duration", "1s"], "--duration: got '1s'"),
        (["--faults", "fire"], "--faults: got 'fire'"),
        (["--seed", "-1"], "--seed: got -1"),
        (["--fast"], "replaced by `dehyst rehearse`"),
    ):
        assert main(["soak", "--out", str(tmp_path), *options]) == 2
        assert named in capsys.readouterr().err
    for options, named in ((["--rate", "1"], "--rate: got 1"), (["--batch", "0"], "--batch: got 0")):
        assert main(["bench", "--latency", *options]) == 2
        assert named in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["soak", "--help"])
    assert "90s, 30m, 2h, 3d" in capsys.readouterr().out
    assert main(["soak", "--list"]) == 0
    assert "kill_primary" in capsys.readouterr().out
