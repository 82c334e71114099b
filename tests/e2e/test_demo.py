"""The demonstration as a user runs it: real processes, real wire, real files; and the fast run beside it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from dehyst.lab.cli import main

MODELS = {"linear", "bouc_wen", "mpi", "lssvm_frozen", "lssvm_adaptive"}
DURATION_S = 12.0


def demo(out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", "demo", "--out", str(out), "--duration", str(DURATION_S), *options],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def fast(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fast")
    done = demo(out, "--fast")
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("live")
    done = demo(out, "--real-time")
    assert done.returncode == 0, done.stderr
    return out, done.stdout


def summary(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "summary.json").read_text()))


def check_form(found: dict[str, Any]) -> None:
    assert set(found["models"]) == MODELS
    for phases in found["models"].values():
        assert set(phases) == {"before", "first_second", "catching_up", "settled"}
        for figures in phases.values():
            assert 0.0 < figures["mae_pct"] <= figures["rmse_pct"] <= figures["max_pct"] < 100.0
    assert found["range_um"] > 50.0
    assert set(found["queries"]) == {"count", "p50_us", "p99_us", "late"}
    # Blocks that are late are computed together.
    followed, count, blocks = found["followed"], found["queries"]["count"], round(DURATION_S / 0.005)
    assert count == blocks if not followed["extrapolated"] else 5 < count <= blocks
    if not followed["late_models"]:
        assert followed["age_p50_ms"] == 16.0, "lead of 5, margin of 10, and the last sample of the model's batch"
    worst = found["worst_half_second"]
    for name, phases in found["models"].items():
        assert worst[name]["mae_pct"] >= max(phases[part]["mae_pct"] for part in ("before", "settled"))
        assert 0.0 <= worst[name]["t_s"] <= DURATION_S - 0.5
    bounds = [found["seconds"][part] for part in ("before", "first_second", "catching_up", "settled")]
    assert bounds == [[3.0, 6.0], [6.0, 7.0], [7.0, 9.0], [9.0, 12.0]]


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_real_time_demo_leaves_everything_it_promises(live: tuple[Path, str]) -> None:
    out, told = live
    found = summary(out)
    check_form(found)
    assert found["samples"]["sent"] == found["samples"]["received"] == DURATION_S * 1000
    assert found["samples"]["learnt"] > 100
    assert "LSSVM with memory, adaptive" in told
    assert "rerun" in told
    assert "raster of 20 lines/s" in told
    for picture in ("tracking.png", "loops.png", "raster.png"):
        assert (out / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (out / "demo.rrd").stat().st_size > 100_000
    rows = pq.read_table(out / "recording").num_rows  # type: ignore[no-untyped-call]
    assert rows == DURATION_S * 1000


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_adaptive_is_caught_again_and_better_than_all_frozen_ones(fast: Path) -> None:
    models = summary(fast)["models"]
    adaptive = models["lssvm_adaptive"]
    for name in MODELS - {"lssvm_adaptive"}:
        assert adaptive["before"]["mae_pct"] < 0.5 * models[name]["before"]["mae_pct"], name
        assert adaptive["first_second"]["mae_pct"] < models[name]["first_second"]["mae_pct"], name
        assert adaptive["settled"]["mae_pct"] < 0.3 * models[name]["settled"]["mae_pct"], name
    assert adaptive["first_second"]["mae_pct"] <= 0.20
    # The short run leaves 3 s to settle; the full one has to reach 0.06 (see the README's table).
    assert adaptive["settled"]["mae_pct"] < 0.15


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_repetition_improves_the_lines_of_the_raster(fast: Path) -> None:
    raster = summary(fast)["raster"]
    alone, repeated = raster["mae_pct"]["learning model"], raster["mae_pct"]["with repetition"]
    assert raster["lines_per_s"] == 20.0
    assert len(alone) == len(repeated) == 20
    assert repeated[0] < 1.1 * alone[0]  # nothing is known yet
    assert max(repeated[9:]) < 0.85 * min(alone[9:])
    assert repeated[19] < 0.5 * repeated[0]


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_no_voltage_is_late_beside_busy_processes_and_the_end_says_what_that_took(tmp_path: Path) -> None:
    """Two others that never rest. Before lock step some thousand of 60,000 voltages were late, with spikes of 25 %."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        done = demo(tmp_path / "busy", "--real-time")
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path / "busy")
    assert found["ticks"]["late"] == found["followed"]["extrapolated"] == 0
    assert found["samples"]["sent"] == found["samples"]["received"] == DURATION_S * 1000
    models = found["models"]["lssvm_adaptive"]
    assert models["first_second"]["mae_pct"] <= 0.20
    assert max(models["before"]["max_pct"], models["settled"]["max_pct"]) < 2.0
    pace = found["pace"]
    assert pace["stage_s"] == DURATION_S
    assert pace["ran_s"] >= DURATION_S + pace["waited_s"] - 0.01
    assert f"({pace['ran_s'] / DURATION_S:.2f} times real time)" in done.stdout


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_strict_keeps_real_time_and_counts_what_is_late(tmp_path: Path) -> None:
    done = demo(tmp_path / "strict", "--strict")
    assert done.returncode == 0, done.stderr
    found = summary(tmp_path / "strict")
    assert found["pace"]["waited_s"] == 0.0
    assert found["pace"]["ran_s"] < 1.1 * DURATION_S
    # A stall of more than the reserve of 60 ms is told, and then the stage has held its voltage.
    assert found["ticks"]["late"] <= found["followed"]["extrapolated"]
    assert f"{found['followed']['extrapolated']} voltages from the reserve" in done.stdout


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.alone
def test_fast_gives_the_same_numbers_as_real_time(fast: Path, live: tuple[Path, str]) -> None:
    """To some percent of the error: the kernel part that is followed in real time is up to 0.2 s older."""
    quick, real = summary(fast), summary(live[0])
    followed = real["followed"]
    stalls = {name: followed[name] for name in ("extrapolated", "late_models", "lost")}
    assert real["ticks"]["late"] == stalls["extrapolated"] == 0
    if any(stalls.values()):
        pytest.skip(f"this machine stalled: {stalls} in real time, so the runs differ")
    for name in MODELS:
        for phase, figures in quick["models"][name].items():
            for key, value in figures.items():
                assert real["models"][name][phase][key] == pytest.approx(value, rel=0.1, abs=1e-3), (name, phase, key)
    a, b = (pq.read_table(out / "recording").to_pydict() for out in (fast, live[0]))  # type: ignore[no-untyped-call]
    assert np.abs(np.subtract(a["u_V"], b["u_V"])).max() < 0.005 * np.ptp(a["u_V"])


@pytest.mark.e2e
def test_ctrl_c_ends_the_demo_and_all_its_processes(tmp_path: Path) -> None:
    import psutil

    process = subprocess.Popen(
        [sys.executable, "-m", "dehyst.lab.cli", "demo", "--out", str(tmp_path / "out")],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    children: list[psutil.Process] = []
    until = time.monotonic() + 60.0
    while not children and time.monotonic() < until:
        children = psutil.Process(process.pid).children(recursive=True)
        time.sleep(0.2)
    assert children, "the demo starts a stage"
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in told
    _gone, alive = psutil.wait_procs(children, timeout=5.0)
    assert not alive


@pytest.mark.parametrize(
    ("options", "named"),
    [(["--duration", "2"], "--duration"), (["--seed", "-1"], "--seed"), (["--fast", "--view"], "--fast")],
)
def test_what_cannot_be_asked_for_is_refused_in_words(
    tmp_path: Path, options: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--out", str(tmp_path), *options]) == 2
    assert named in capsys.readouterr().err
