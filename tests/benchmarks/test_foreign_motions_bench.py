"""The benchmark of users' motions: which stages it takes, its table over made-up runs, and one run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import foreign
from benchmarks.foreign_motions import HEAD, run_motion


def run(name: str, seed: int, **given: Any) -> dict[str, Any]:
    record = {
        "seed": seed, "recording": "full", "motion": name, "frequency_Hz": 10.0, "adaptive_pct": 0.1,
        "frozen_pct": 0.5, "two_seconds": 0.9, "troubles": [],
        "verdicts_after": {"learnt": 45, "passed": 45, "settling": 10}, "outside": 0.5, "stand_in": 0.25,
        "stage": {"hysteresis": "plays", "dt_s": 1e-3}, "cpu_s": 1.0,
    }  # fmt: skip
    return record | given


def cells(text: str) -> list[list[str]]:
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    return [row for row in rows if row != list(HEAD)]


def test_runs_are_added_to_the_file_and_tabulated_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "motions.jsonl"
    file.write_text(json.dumps(run("hold", 1)) + "\n")
    ask = ["--motions", "raster:5", "--runs", "1", "--first-seed", "300000000", "--after", "4", "--poor"]
    assert foreign.main([*ask, "--json", str(file)]) == 0
    assert [row[0] for row in cells(capsys.readouterr().out)] == ["hold", "raster:5"]
    records = foreign.read([file])
    assert len(records) == 2
    assert records[1]["recording"] == "poor"
    assert records[1]["frequency_Hz"] == 5.0
    assert records[1]["simulated_s"] == pytest.approx(10.0, abs=0.01)
    assert sum(records[1]["verdicts"].values()) == pytest.approx(10_000, abs=10)
    assert foreign.main(["--table", str(file)]) == 0
    assert len(cells(capsys.readouterr().out)) == 2


def test_a_run_that_raises_says_why_and_an_unknown_motion_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "KeyError" in run_motion("circle", 1)["failed"]
    with pytest.raises(SystemExit):
        foreign.main(["--motions", "raster:5,circle"])
    assert "got 'circle'" in capsys.readouterr().err
