"""``dehyst reproduce`` as a user runs it: files, numbers, pictures, errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.lab.cli import main
from dehyst.lab.reproduce.measured import data_folder, run_stack
from dehyst.service.reports.tables import json_form

FIGURES = {"2.15", "third", "2.17", "change"}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reproduce") / "made" / "here"
    arguments = ["reproduce", "--out", str(folder), "--quick", "--no-pso", "--preset", "bouc_wen", "--no-measured"]
    assert main(arguments) == 0
    return folder


@pytest.fixture(scope="module")
def numbers(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((out / "tables.json").read_text(encoding="utf-8"))
    return loaded


def test_figures_are_drawn_and_shown(out: Path, numbers: dict[str, Any]) -> None:
    pictures = numbers["pictures"]["bouc_wen"]
    assert set(pictures) == FIGURES
    report = (out / "report.md").read_text(encoding="utf-8")
    for path in pictures.values():
        assert (out / path).read_bytes().startswith(b"\x89PNG")
        assert f"]({path})" in report


def test_every_table_has_the_chapters_numbers_beside_ours(out: Path, numbers: dict[str, Any]) -> None:
    report = (out / "report.md").read_text(encoding="utf-8")
    for name in ("Table 2.1", "Table 2.2", "Table 2.3", "Table 2.4"):
        assert name in report
    for published in ("614.9", "759.9", "0.364", "99.9999"[:5], "31.104", "741.6"):
        assert published in report
    found = numbers["presets"]["bouc_wen"]
    assert found["table_2_4"]["bouc_wen"]["modelling"]["mae_pct"] < 0.01
    winner = min(found["table_2_4"], key=lambda key: found["table_2_4"][key]["modelling"]["rmse_pct"])
    assert winner == "bouc_wen"
    assert numbers["published"]["models"]["mpi"]["identification_s"] == 759.91
    loops = found["table_2_5"]["answer to (2.45)"]
    assert set(loops["lssvm_memory"]) >= {"FF", "FF+FB"}
    assert loops["none"]["FB"]["mae_pct"] > 0.0
    assert numbers["picma_stack"] is None
    assert "DEHYST_DATA" in report


def test_errors_are_said_and_numbers_are_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert main(["reproduce", "--out", str(file / "below")]) == 2
    assert "--out" in capsys.readouterr().err
    assert main(["reproduce", "--out", str(tmp_path / "a"), "--data", str(tmp_path / "none")]) == 2
    assert "--data" in capsys.readouterr().err
    assert json_form({"a": (np.float64(np.nan), np.int64(3), 1.23456789), "b": np.bool_(True)}) == {
        "a": [None, 3, 1.234568],
        "b": True,
    }


def test_measured_stack_reproduces_what_its_authors_published() -> None:
    folder = data_folder() / "picma_stack"
    if not folder.is_dir():
        pytest.skip("no picma_stack: set DEHYST_DATA to the folder of measured data")
    found = run_stack(folder)
    assert found is not None
    assert found.reproduced_um["linear drive"] == pytest.approx(1.68, abs=0.01)
    assert found.reproduced_um["inverse feedforward"] == pytest.approx(0.58, abs=0.01)
    windows = {result.name: found.windows_rmse_um(result) for result in found.results}
    for window in ("linear drive", "inverse feedforward"):
        linear = windows["linear"][window]
        assert all(errors[window] < linear for name, errors in windows.items() if name != "linear")
    assert windows["lssvm_adaptive_online"]["inverse feedforward"] < 0.58
    whole = {result.name: result.score.rmse_um for result in found.results if result.score is not None}
    assert whole["lssvm_adaptive_online"] < whole["lssvm_adaptive"]
