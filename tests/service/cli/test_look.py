"""``dehyst look``: what is in a file, what is missing, and commands that run as printed."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.lab.cli import main

N, DT_S = 1500, 1e-3
T = np.arange(N) * DT_S
U = 4.0 - 4.0 * np.cos(2 * np.pi * 2.0 * T)
Y = 10.0 * U + 0.5 * np.sin(2 * np.pi * 2.0 * T)


def filled(command: str) -> list[str]:
    """The words of a printed command behind ``dehyst``, with the units filled in."""
    for quantity, unit in (("t", "s"), ("u", "V"), ("y", "um")):
        command = command.replace(f"{quantity}=UNIT", f"{quantity}={unit}")
    return shlex.split(command)[1:]


def write(path: Path, header: str) -> Path:
    np.savetxt(path, np.column_stack([T, U, Y]), delimiter=",", fmt="%.6f", header=header, comments="")
    return path


def look(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    status = main(["look", *words, "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_file_that_is_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.csv", "Time (s),Voltage (V),Position (um)")
    picture = tmp_path / "look.png"
    status, found = look(capsys, str(path), "--picture", str(picture))
    assert status == 0
    assert picture.stat().st_size > 10_000
    assert [column["name"] for column in found["columns"]] == ["Time (s)", "Voltage (V)", "Position (um)"]
    assert found["columns"][1]["max"] == pytest.approx(8.0)
    assert found["understood"]["rate_Hz"] == pytest.approx(1000)
    assert found["missing"] is None
    assert [command.split()[1] for command in found["commands"]] == ["identify", "diagnose", "replay"]
    out = tmp_path / "m.npz"
    words = shlex.split(found["commands"][0].replace("model.npz", str(out)))[1:]
    assert main([*words, "--models", "linear", "--no-pictures"]) == 0
    assert out.exists()


def test_the_command_for_what_is_missing_runs_as_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a b.csv", "Time,Drive out,Sensor")
    status, found = look(capsys, str(path), "--no-pictures")
    assert status == 1
    assert found["understood"] is None
    assert "3 things are missing" in found["missing"]
    (command,) = found["commands"]
    assert found["fill_in"].startswith(", and fill in UNIT of u (V, mV, uV, kV), UNIT of y (um, ")
    status, found = look(capsys, *filled(command)[1:], "--no-pictures")
    assert status == 0
    assert found["understood"]["u_V"] == pytest.approx([0.0, 8.0], abs=1e-3)
    assert "--column 'u=Drive out' --unit u=V" in found["commands"][0]


def test_another_command_prints_itself_with_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.csv", "Time,Drive,Sensor")
    assert main(["identify", str(path), "--out", str(tmp_path / "m.npz"), "--models", "linear", "--no-pictures"]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    words = filled(said[-1])
    assert words[0] == "identify"
    assert main(words) == 0


def test_text_names_what_is_wrong_with_the_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.csv", "t_s,u_V,y_um")
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:500] + lines[560:]))
    assert main(["look", str(path), "--no-pictures"]) == 0
    said = capsys.readouterr().out
    assert "1 gaps, 60 samples missing" in said
    assert "dehyst identify" in said
