"""``dehyst modes`` from recordings of two amplitudes to its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.service.stage_node import example_files


@pytest.fixture
def recordings(tmp_path: Path) -> list[str]:
    """Two drives, two outputs, four realisations of two periods; the second mode falls with the drive."""
    for name, rms_V, seed in (("low", 0.1, 1), ("high", 0.3, 2), ("test", 0.3, 3)):
        u_V, y_um = example_files._steady(2, 256, 4, 2, rms_V, seed)
        np.savez(tmp_path / f"{name}.npz", u_V=u_V, y_um=y_um, dt_s=example_files.DT_S)
    return [str(tmp_path / f"{name}.npz") for name in ("low", "high", "test")]


def test_modes_writes_a_report(recordings: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    low, high, test = recordings
    out = tmp_path / "out"
    assert main(["modes", low, high, "--test", test, "--out", str(out), "--start-modes", "5", "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert "softens by" in printed
    data = json.loads((out / "report.json").read_text())
    assert data["schema"] == 1
    modes = {round(mode["frequency_hz"][0]): mode for mode in data["modes"]}
    falling = min(modes.values(), key=lambda mode: abs(mode["frequency_hz"][0] - 228.9))
    # From 230 (1 - 0.005) to 230 (1 - 0.015) Hz.
    assert falling["frequency_change"] == pytest.approx(-0.01005, abs=0.001)
    assert data["levels"][1]["test"] == "test.npz"
    assert data["levels"][0]["test_realisations"] == 1
    assert np.allclose(data["levels"][0]["noise_of_a_reading_um"], 1e-3, rtol=0.1)
    page = (out / "report.md").read_text()
    assert "| frequency / Hz |" in page
    assert "Held-out error over noise and distortion: " in page
    for name in ("response.png", "left.png"):
        assert f"({name})" in page
        assert (out / name).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--start-modes", "0"], "--start-modes"),
        (["--hold-out", "3"], "hold out: got 3 of 4 realisations, expected at most 2"),
        (["--degree", "1"], "degree: got 1 with 1 amplitudes"),
        (["--period", "100"], "period: got 100, expected 256"),
    ],
)
def test_modes_refuses_what_it_cannot_do(
    recordings: list[str], tmp_path: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["modes", recordings[0], "--out", str(tmp_path / "out"), "--quiet", *more]) == 2
    assert message in capsys.readouterr().err
