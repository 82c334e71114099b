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


#: The command in a process that says what it compiles.
_WATCHED = """
import sys
from numba.core import event
from dehyst.lab.cli import main

class Compiled(event.Listener):
    def on_start(self, event):
        print("compiled:", event.data["dispatcher"].py_func.__qualname__, file=sys.stderr)
    def on_end(self, event):
        pass

event.register("numba:compile", Compiled())
sys.exit(main(sys.argv[1:]))
"""


def arguments(out: Path, *options: str) -> list[str]:
    return ["soak", "--out", str(out), "--seed", "4", "--json", *options]


def command(out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "dehyst.lab.cli", *arguments(out, *options)]


def lies_and_nothing_compiled(out: Path, *options: str) -> None:
    """In one process, which the faults of the samples must not make compile anything.

    Ten seconds of compiling in the thread that learns are what the first jump of a new installation led to.
    """
    done = subprocess.run(
        [sys.executable, "-c", _WATCHED, *arguments(out, "--fast", *options)],
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    assert [line for line in done.stderr.splitlines() if line.startswith("compiled:")] == []


def read(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "soak.json").read_text(encoding="utf-8")))


@pytest.mark.e2e
@pytest.mark.slow
def test_a_killed_primary_and_poisoned_samples_in_real_processes(tmp_path: Path) -> None:
    done = subprocess.run(
        command(tmp_path, "--duration", "26s", "--faults", "kill_primary,nan"),
        capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    found = read(tmp_path)
    assert found == json.loads(done.stdout)
    assert set(found) == {"verdict", "not_judged", "duration_s", "faults", "invariants", "latency", "samples"}
    assert {name for name in SAFE if not found["invariants"][name]["held"]} == set(), done.stderr
    assert found["faults"]["kill_primary"]["count"] == found["faults"]["nan"]["count"] == 1
    assert found["faults"]["nan"]["told_by"] == ["samples.gates.not_finite"]
    assert found["faults"]["kill_primary"]["told_by"], "another instance answers"
    assert found["latency"]["p50_us"] > 0.0
    assert found["samples"]["seen"] > 15_000
    assert found["samples"]["in_no_recording_and_no_fault_on"] == 0
    assert "memory" in found["not_judged"], "too short a run"
    line = f"{found['verdict']}; not judged: "
    assert line in done.stderr
    assert "memory (too short a run)" in done.stderr
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith(f"# Soak: {line}")
    assert (tmp_path / "soak.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "soak.png" in report
    assert [f["kind"] for f in json.loads((tmp_path / "plan.json").read_text())["faults"]] == ["kill_primary", "nan"]


#: What a soak does to processes and to the machine, but for what the test above does.
PROCESSES = ("stop_primary", "kill_standby", "kill_viewer", "slow_viewer", "restart_stage", "restart_router",
             "clock_back", "disk_full", "cpu_stolen", "bad_queries")  # fmt: skip


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.timeout(420)
def test_every_fault_of_processes_and_machine_happens_and_is_told(tmp_path: Path) -> None:
    """Each once, one after the other: what must hold however busy the machine is, holds. Times are not judged here."""
    done = subprocess.run(
        command(tmp_path, "--duration", "116s", "--seed", "237", "--faults", ",".join(PROCESSES)),
        capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    found = read(tmp_path)
    assert [kind for kind in PROCESSES if kind not in found["faults"]] == [], done.stderr
    assert {kind for kind, fault in found["faults"].items() if not fault["told_by"]} == set()
    assert found["faults"]["bad_queries"]["told_by"] == ["queries.errors+samples.malformed"]
    must = {"answers_safe", "voltages_finite", "voltages_within_limits", "voltages_within_slew", "faults_told",
            "samples_accounted", "processes_alive"}  # fmt: skip
    assert {name: found["invariants"][name] for name in must if not found["invariants"][name]["held"]} == {}


@pytest.mark.e2e
def test_after_every_lie_of_the_sensor_the_error_is_soon_what_it_was(tmp_path: Path) -> None:
    """One after the other, in one process and so the same on any machine: nothing of a lie may stay.

    This plan once ended with an error of 7 % for good: a sensor at its end was taken for a jump by half the range.
    """
    lies = "nan,stage_clock,freeze,saturate,gap"
    lies_and_nothing_compiled(tmp_path, "--duration", "64s", "--faults", lies)
    found = read(tmp_path)
    assert sum(fault["count"] for fault in found["faults"].values()) >= 6
    assert found["invariants"]["tracking"]["worst"] < 0.05
    events = [event["event"] for event in json.loads((tmp_path / "plan.json").read_text())["events"]]
    assert "learner_failed" not in events
    assert events.count("learner_went_back") == events.count("recovered") > 2


@pytest.mark.e2e
def test_every_sensor_that_lies_plausibly_is_named_and_costs_little(tmp_path: Path) -> None:
    """A stuck one with noise, one with another gain or sign, one of another stage; numbers, losses, order, payload."""
    lies = ("stuck_noisy", "sensor_gain", "sign", "other_stage", "seq_jump", "losses", "reorder", "payload")
    lies_and_nothing_compiled(tmp_path, "--duration", "66s", "--faults", ",".join(lies))
    faults = read(tmp_path)["faults"]
    assert set(faults) == set(lies)
    for kind in lies[:4]:
        assert faults[kind]["worst_error_pct"] < 1.0
        assert faults[kind]["worst_named_s"] < 0.6
        assert faults[kind]["told_by"][0].startswith("trouble sensor_")


@pytest.mark.e2e
def test_ctrl_c_leaves_a_report_of_what_ran(tmp_path: Path) -> None:
    process = subprocess.Popen(
        command(tmp_path, "--duration", "2h", "--fast", "--faults", "gap"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        for line in process.stderr:
            if line.startswith("  [") and " 0 of 7200" not in line:
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
