"""The demonstration of a mirror, small: it learns, draws, and names the dead actuator."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dehyst.lab.cli import main


@pytest.mark.timeout(170)
def test_a_small_mirror_learns_and_names_its_dead_actuator(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demo", "--mirror", "--side", "4", "--duration", "2.1", "--out", str(tmp_path), "--quiet", "--json"]
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads((tmp_path / "mirror.json").read_text(encoding="utf-8"))
    before, after = said["surface_error"]["identified"], said["surface_error"]["fleet"]
    assert after["learnt_rms_nm"] < 0.25 * before["learnt_rms_nm"]
    assert list(said["troubles"]) == [str(said["dead_actuator"])]
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("mirror.png", "worst.png"))
