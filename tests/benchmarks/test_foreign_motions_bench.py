"""The benchmark of users' motions: which stages it takes, its table over made-up runs, and one run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import foreign
from benchmarks.foreign_motions import HEAD, fits, planned, repetition_table, run_motion, table
from benchmarks.records import read_lines
from tests.foreign.plants import random_plant, with_traits


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


def test_each_motion_is_a_row_with_what_its_runs_came_to_beside_its_goal() -> None:
    trouble = {"name": "sensor_gain", "at_s": 3.0, "until_s": None}
    raster = [
        run("raster:10", 1),
        run("raster:10", 2, adaptive_pct=0.4, two_seconds=1.05),
        run(
            "raster:10", 3, adaptive_pct=0.14, frozen_pct=0.7, verdicts_after={"learnt": 30, "glitch": 70}, outside=0.2
        ),
    ]
    rows = cells(table([run("tone:100", 4, troubles=[trouble, trouble], two_seconds=1.2), *raster]))
    assert all(len(row) == len(HEAD) for row in rows)
    assert rows[0] == [
        "raster:10", "3", "0", "0.140 / 0.374 / 0.400", "0.500", "0.80 (seed 2)", "1.05 (seed 2)", "0", "40 % (70 %)",
        "40 % / 25 %", "median ≤ 0.15 %, worst ≤ 0.5 %, over frozen ≤ 1.05, two seconds ≤ 1.1", "yes",
    ]  # fmt: skip
    assert rows[1][0] == "tone:100"
    assert rows[1][7:] == ["1, sensor_gain 2", "45 % (90 %)", "50 % / 25 %", "median ≤ 1.5 %, two seconds ≤ 1.1", "no"]


def test_fast_motions_go_to_stages_that_can_make_them() -> None:
    def stage(rate_Hz: float, *modes: float) -> Any:
        return with_traits(random_plant(1), dt_s=1.0 / rate_Hz, modes=tuple((f, 0.1, 1.0) for f in modes)).traits

    assert fits("raster:10", 1, stage(500.0, 120.0))
    assert not fits("raster:20", 1, stage(500.0, 120.0))
    assert fits("raster:20", 1, stage(1000.0, 120.0))
    assert not fits("tone:50", 1, stage(1000.0, 299.0, 900.0))
    assert fits("tone:50", 1, stage(1000.0, 301.0))
    assert fits("tone:100", 1, stage(5000.0))
    plan = planned(["raster:5", "tone:50"], 300_000_000, 3)
    assert [name for name, _ in plan] == ["raster:5", "tone:50"] * 3
    assert [seed for name, seed in plan if name == "raster:5"] == [300_000_000, 300_000_001, 300_000_002]
    assert all(fits(name, seed, random_plant(seed).traits) for name, seed in plan)


def test_runs_are_added_to_the_file_and_tabulated_with_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "motions.jsonl"
    file.write_text(json.dumps(run("hold", 1)) + "\n")
    ask = ["--motions", "raster:5", "--runs", "1", "--first-seed", "300000000", "--after", "4", "--poor"]
    assert foreign.main([*ask, "--json", str(file)]) == 0
    assert [row[0] for row in cells(capsys.readouterr().out)] == ["hold", "raster:5"]
    records = read_lines([file])
    assert len(records) == 2
    assert records[1]["recording"] == "poor"
    assert records[1]["frequency_Hz"] == 5.0
    assert records[1]["simulated_s"] == pytest.approx(10.0, abs=0.01)
    assert sum(records[1]["verdicts"].values()) == pytest.approx(10_000, abs=10)
    assert foreign.main(["--table", str(file)]) == 0
    assert len(cells(capsys.readouterr().out)) == 2


def test_motions_that_are_followed_with_the_repetition_have_a_table() -> None:
    followed = {"followed_pct": 1.0, "repeated_pct": 0.25}
    told = repetition_table([run("raster:5", 1) | followed, run("hold", 1)])
    (row,) = cells(told)[-1:]
    assert (row[0], row[1], row[4]) == ("raster:5", "1", "0.250 / 0.250")
    assert row[5] == "0.25 / 0.25"
    assert not repetition_table([run("hold", 1)])


def test_a_run_that_raises_says_why_and_an_unknown_motion_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "KeyError" in run_motion("circle", 1)["failed"]
    with pytest.raises(SystemExit):
        foreign.main(["--motions", "raster:5,circle"])
    assert "got 'circle'" in capsys.readouterr().err
