"""``dehyst diagnose``: the command, the page, the pictures, the viewer's file, and the stage file that runs."""

from __future__ import annotations

import functools
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from dehyst.adaptive.types import FloatArray
from dehyst.lab.cli import main
from dehyst.service.reports.diagnosis import write_report
from dehyst.service.reports.diagnosis_page import Source, length
from dehyst.sim.diagnosis.diagnose import Options, diagnose
from dehyst.sim.diagnosis.result import NamedCause, picture
from dehyst.sim.effects import CAUSES, Chain, effect, simulate
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.pictures import MEASURED, WITH, WITHOUT
from dehyst.sim.stage.file import load_stage
from dehyst.sim.stage.stage import Stage

DT_S = 1e-3


def dehyst(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dehyst.lab.cli", *args], capture_output=True, text=True, timeout=170, check=False
    )


def drive(seed: int) -> FloatArray:
    """8 s: rest, a step, two sines."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(5.0 / DT_S)) * DT_S
    sines = 3.0 - 2.0 * np.cos(2.0 * np.pi * 0.8 * t) - np.cos(2.0 * np.pi * rng.uniform(5.0, 7.0) * t)
    return np.concatenate([np.zeros(1000), np.full(1000, 3.0), np.zeros(1000), sines])


def record(path: Path, seed: int) -> Path:
    """A linear stage with mains hum in its sensor, as a recorder of the service would leave it."""
    u_V = drive(seed)
    chain = Chain(
        (
            effect("linear_actuator", gain_um_per_V=10.0),
            effect("resonance", frequency_Hz=120.0, damping_ratio=0.3),
            effect("sensor_noise", rms_um=0.005),
            effect("mains_hum", amplitude_um=0.05, frequency_Hz=50.05),
        )
    )
    y_um = simulate(chain, u_V, DT_S, seed=seed)
    n = u_V.size
    columns = {"seq": np.arange(n), "t_s": np.arange(n) * DT_S, "u_V": u_V, "y_um": y_um, "reason": ["learnt"] * n}
    parquet.write_table(pa.table(columns), path)
    return path


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """The folder of a diagnosis of a recorder's segments, what was printed, and what was said on the way."""
    folder = tmp_path_factory.mktemp("diagnose")
    segments = folder / "recording"
    segments.mkdir()
    record(segments / "segment-000001.parquet", 1)
    test = record(folder / "test.parquet", 2)
    ended = dehyst(
        "diagnose", str(segments), "--nominal", "linear", "--test", str(test), "--out", str(folder / "out"), "--json"
    )
    assert ended.returncode == 0, ended.stderr
    return folder / "out", json.loads(ended.stdout), ended.stderr


def test_the_command_names_the_cause_and_shows_progress(report: tuple[Path, dict[str, Any], str]) -> None:
    out, data, said = report
    assert data == json.loads((out / "report.json").read_text())
    assert list(data) == [
        "schema", "verdict", "nominal", "extended", "noise_floor_um", "effects", "not_excited", "next_experiment",
        "explainable", "defects", "left", "tried_not_named",
    ]  # fmt: skip
    assert (data["schema"], data["verdict"]) == (2, "effects")
    assert data["effects"][0]["name"] == "mains_hum"
    assert set(data["effects"][0]) == {
        "name", "alternatives", "parameters", "intervals", "heldout_gain", "p_value", "witness", "instead",
    }  # fmt: skip
    assert data["effects"][0]["parameters"]["amplitude_um"] == pytest.approx(0.05, rel=0.1)
    assert data["extended"]["heldout_rmse_um"] < 0.8 * data["nominal"]["heldout_rmse_um"]
    shares = [int(found) for found in re.findall(r"^\[ *(\d+) %\]", said, re.MULTILINE)]
    assert shares == sorted(shares)
    assert shares[-1] == 100


def test_the_page_is_short_whole_and_shows_its_pictures(report: tuple[Path, dict[str, Any], str]) -> None:
    out, data, _ = report
    page = (out / "report.md").read_text()
    assert len(page.split()) < 700
    for name in re.findall(r"!\[.*\]\((.*)\)", page):
        content = (out / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) > 5000
    for part in ("mains hum", "test recording", "noise floor", "What this recording cannot say", "## Next"):
        assert part in page
    assert length(data["nominal"]["heldout_rmse_um"]) in page


def test_the_extended_stage_runs_and_makes_the_same_readings(
    report: tuple[Path, dict[str, Any], str], free_port: int
) -> None:
    out, data, _ = report
    config = load_stage(out / "stage.toml")
    assert "mains_hum" in [e.name for e in config.effects]
    stage = Stage(config)
    y_um = stage.run(stage.initial_state(), drive(1))[0]
    measured = parquet.read_table(out.parent / "recording" / "segment-000001.parquet")["y_um"].to_numpy()
    error = float(np.sqrt(np.mean(np.square((y_um - measured)[1000:]))))
    assert error < 3.0 * data["noise_floor_um"] + 0.5 * data["nominal"]["rmse_um"]
    endpoint = f"tcp/127.0.0.1:{free_port}"
    ended = dehyst(
        "stage", "--file", str(out / "stage.toml"), "--listen", endpoint, "--free-run", "--duration", "0.2", "--json"
    )
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1])["units"]["x"]["published"] == 200


def test_what_cannot_be_diagnosed_is_refused_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    n = 3000
    t_s = np.arange(n) * DT_S
    parquet.write_table(pa.table({"t_s": t_s, "u_V": np.zeros(n), "y_um": np.zeros(n)}), tmp_path / "zero.parquet")
    record(tmp_path / "good.parquet", 1)
    out = str(tmp_path / "out")
    cases: list[tuple[list[str], str]] = [
        ([str(tmp_path / "zero.parquet")], "u_V"),
        ([str(tmp_path / "good.parquet"), "--nominal", "cubic"], "cubic"),
        ([str(tmp_path / "good.parquet"), "--stage", str(tmp_path / "none.toml")], "none.toml"),
        ([str(tmp_path / "good.parquet"), "--test-range", "1:2"], "--test"),
    ]
    for arguments, word in cases:
        assert main(["diagnose", *arguments, "--out", out]) == 2
        assert word in capsys.readouterr().err
    assert not Path(out).exists()


def test_the_page_of_a_record_without_a_named_cause(tmp_path: Path) -> None:
    u_V = drive(5)[:5000]
    chain = Chain((effect("linear_actuator", gain_um_per_V=10.0), effect("sensor_noise", rms_um=0.005)))
    data = FitData(DT_S, u_V, simulate(chain, u_V, DT_S, seed=5))
    adequate = diagnose(data, None, Options(nominal="linear"))
    assert adequate.verdict == "adequate"
    write_report(tmp_path, adequate, Source("healthy", nominal="linear"))
    assert "explains this recording down to its noise" in (tmp_path / "report.md").read_text()
    strange = replace(adequate, verdict="unexplained", partial=("creep", "stick_slip"), left=("time: everywhere",))
    write_report(tmp_path, strange, Source("strange", nominal="linear"))
    page = (tmp_path / "report.md").read_text()
    assert "no cause of the catalogue explains" in page
    assert "Tried and not named, because together they explain too little here: creep, stick slip" in page
    assert "time: everywhere" in page


# ---- curves and words, without a diagnosis


@functools.cache
def settings() -> dict[str, FitData]:
    """A record with steps and holds, one of a sine alone, and one of a noisy drive."""
    rng = np.random.default_rng(3)
    steps, t = drive(1), np.arange(6000) * DT_S
    sine, noise = 2.0 - 2.0 * np.cos(2 * np.pi * t), rng.normal(size=6000)
    made = {}
    for name, u in (("steps", steps), ("sine", sine), ("noise", noise)):
        other = np.roll(u, 700)
        made[name] = FitData(
            DT_S, u, 10.0 * u + 0.01 * rng.normal(size=u.size), other_um=other, other_um_per_s=np.gradient(other)
        )
    return made


@pytest.mark.parametrize("name", CAUSES)
@pytest.mark.parametrize("kind", ["steps", "sine", "noise"])
def test_every_cause_has_a_picture_on_every_record(name: str, kind: str) -> None:
    data = settings()[kind]
    rng = np.random.default_rng(4)
    before = 0.05 * np.sin(2 * np.pi * 3.0 * data.t_s) + 0.01 * rng.normal(size=data.n)
    cause = NamedCause(name, (), {"f0_hz": 120.0}, {"f0_hz": (119.0, 121.0)}, 0.5, 0.001, before, 0.1 * before)
    shown = picture(cause, data)
    assert shown.curves
    for curve in shown.curves:
        assert curve.x.shape == curve.y.shape
        assert curve.x.size > 1
        assert np.isfinite(curve.x).all()
        assert np.isfinite(curve.y).all()
        assert not shown.log_x or (curve.x > 0.0).all()
    roles = {curve.role for curve in shown.curves}
    assert {WITHOUT, WITH} <= roles or roles == {MEASURED}
