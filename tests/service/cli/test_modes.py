"""``dehyst modes`` from recordings of two amplitudes to its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dehyst.lab.cli import main

DT_S = 1e-3


def write(path: Path, rms_V: float, seed: int, slope: float) -> None:
    """Two drives, two outputs, three realisations of two periods; the second mode falls with the drive."""
    rng = np.random.default_rng(seed)
    lines, samples = np.arange(1, 116), 256
    spectrum = np.zeros((samples // 2 + 1, 2, 4), dtype=complex)
    for block in range(2):
        phases = np.exp(2j * np.pi * rng.random((lines.size, 2)))
        spectrum[lines, :, 2 * block] = phases
        spectrum[lines, :, 2 * block + 1] = phases * [1.0, -1.0]
    u = np.fft.irfft(spectrum, n=samples, axis=0)
    factor = rms_V / np.sqrt(np.mean(u**2))
    s = 2j * np.pi * np.arange(samples // 2 + 1) / (samples * DT_S)
    g = np.zeros((samples // 2 + 1, 2, 2), dtype=complex)
    for f, zeta, shape in (
        (90.0, 0.03, [[1.0, 0.5], [0.2, 0.1]]),
        (230.0 * (1.0 - slope * rms_V), 0.02, [[0.3, -1.0], [-0.6, 2.0]]),
    ):
        omega = 2.0 * np.pi * f
        g += (omega**2 / (s**2 + 2.0 * zeta * omega * s + omega**2))[:, None, None] * np.array(shape)
    y = np.fft.irfft(g @ (factor * spectrum), n=samples, axis=0)
    noisy = y[..., None] + 1e-3 * rng.normal(size=(*y.shape, 2))
    np.savez(path, u_V=np.repeat(factor * u[..., None], 2, axis=3), y_um=noisy, dt_s=DT_S)


@pytest.fixture
def recordings(tmp_path: Path) -> list[str]:
    for name, rms_V, seed in (("low", 0.1, 1), ("high", 0.3, 2), ("test", 0.3, 3)):
        write(tmp_path / f"{name}.npz", rms_V, seed, 0.05)
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


def test_modes_prints_json_and_no_pictures(
    recordings: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    args = ["modes", recordings[0], "--out", str(out), "--start-modes", "4", "--quiet", "--json", "--no-pictures"]
    assert main(args) == 0
    data = json.loads(capsys.readouterr().out)
    assert [round(mode["frequency_hz"][0]) for mode in data["modes"]] == [90, 229]
    assert not (out / "response.png").exists()


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
