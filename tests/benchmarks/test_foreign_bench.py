"""The benchmark of foreign stages: its tables and its line over made-up runs, and the fixed runs of the line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import foreign
from benchmarks.foreign import LINE, goals, main
from benchmarks.records import read_lines
from dehyst.lab.rehearsal.disturbance import EVENT_KINDS, SENSOR, draw
from tests.foreign.plants import random_plant


def run(name: str, **given: Any) -> dict[str, Any]:
    """A run in which nothing went wrong, but for what is given."""
    figures = {"first_second_pct": 0.1, "settled_pct": 0.02, "ends_at_rail": False, "large_s": 0.0, "large_at_s": None}
    kind = draw(name, 1, 4.0).kind
    record = {
        "seed": 1, "class": name, "category": EVENT_KINDS[kind].category, "text": name,
        "event": {"kind": kind, "size": 0.06},
        "stage": {"hysteresis": "plays", "dt_s": 1e-3}, "adaptive": figures | {"first_second_pct": 0.1},
        "frozen": {"settled_pct": 0.5}, "worst_ratio": 0.5, "sensor_excess": None, "sensor_ratio": None, "troubles": [],
        "false_troubles": [], "healthy_s": 360.0, "named_s": None, "cpu_s": 1.0,
    }  # fmt: skip
    record["adaptive"] = figures | {name: given.pop(name) for name in list(given) if name in figures}
    return record | given


FAILED = {"seed": 7, "class": "spikes", "failed": "Traceback\nValueError: no"}


def last_cells(text: str) -> list[str]:
    return [row.split("|")[-2].strip() for row in text.splitlines()[2:]]


def test_each_goal_is_a_row_with_what_the_runs_came_to() -> None:
    records = [
        run("none", settled_pct=0.01),
        run("knock", worst_ratio=0.9, settled_pct=0.03),
        run("knock", worst_ratio=1.3, large_s=0.2, settled_pct=0.05),
        run("gain_at_once", first_second_pct=0.2, event={"size": -0.03}, settled_pct=0.02),
        run("gain_at_once", first_second_pct=0.6, event={"size": 0.12}, settled_pct=0.04),
        run("zero_at_once", ends_at_rail=True, settled_pct=9.0, troubles=[{"name": "rail"}], false_troubles=["rail"]),
        run("sign", sensor_excess=0.5, sensor_ratio=1.2, named_s=0.4),
        run("stuck_noise", sensor_excess=1.5, sensor_ratio=1.8, named_s=0.1),
        run("sensor_gain", sensor_excess=0.9, named_s=0.6),
        run("foreign", sensor_excess=0.9),
        FAILED,
    ]
    told_goals = goals(records)
    intact, sensors, ratio, knock, step, wrong, settled, false = last_cells(told_goals)
    assert intact == "2 of 6"
    assert wrong == "not measured by these runs"
    assert sensors == "3 of 4; 2 of 4; 1 of 4"
    assert ratio == "1.50 / 1.80"
    assert knock == "1.10 / 1.30"
    # 0.2 % after 3 % and 0.6 % after 12 % are 0.4 and 0.3 % after 6 %.
    assert step == "0.350 / 0.395 % (0.400 / 0.580 %)"
    assert settled.startswith("0.035 %")
    assert false == "1 in 1.00 h of simulated time"
    assert "2 runs of 3 to 12 %" in told_goals
    assert "median over 6 runs" in told_goals


def test_the_runs_of_the_line_are_slow_stages_one_of_each_event() -> None:
    events = [draw(name, seed, 4.0) for name, seed in LINE]
    assert all(random_plant(seed).traits.dt_s >= 1e-3 for _, seed in LINE)
    steps = [event.size for event in events if event.name == "gain_at_once"]
    assert min(steps) < 0.0 < max(steps)
    assert random_plant(dict(LINE)["knock"]).traits.modes
    assert sum(event.category == SENSOR for event in events) == 3
    assert len({seed for _, seed in LINE}) == len(LINE) == 12


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "earthquake"], "expected some of none"),
        (["--runs", "0"], "expected at least 1"),
        (["--after", "1"], "expected 4 s or more"),
        (["--controllers", "5", "0"], "expected ages of 1 sample or more"),
        (["--line", "--table", "x"], "not allowed with"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(arguments)
    assert words in capsys.readouterr().err


def test_controllers_are_shown_by_median_and_worst(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def stage(seed: int, moving_pct: float | None) -> dict[str, Any]:
        one = {
            "way": "I",
            "age": 5,
            "moving_pct": moving_pct,
            "first_second_pct": 0.2,
            "lines_pct": [4.0, 3.0, 2.0, 1.0],
        }
        return {"seed": seed, "ages": [5], "hysteresis": "plays", "cpu_s": 1.0, "controllers": [one]}

    file = tmp_path / "controllers.jsonl"
    file.write_text(
        "".join(json.dumps(stage(k, 0.1 * k)) + "\n" for k in (1, 2, 4))
        + json.dumps({"seed": 5, "ages": [5], "failed": "ValueError: no"})
    )
    assert main(["--table", str(file)]) == 1
    said = capsys.readouterr().out
    assert "3 stages" in said
    assert "| an integrator alone | 5 | 0.200 / 0.400 | 0.200 / 0.200 | 4.000 / 4.000 |" in said


def healthy_run(seed: int, **given: Any) -> dict[str, Any]:
    """Half an hour on a stage with 1 kHz in which nothing was wrong, but for what is given."""
    record = {
        "seed": seed, "class": "healthy", "block": 5, "stage": {"hysteresis": "plays", "dt_s": 1e-3},
        "simulated_s": 1800.0, "mean_pct": 0.05, "figures": {"large_s": 0.0}, "troubles": [], "cpu_s": 1.0,
    }  # fmt: skip
    return record | given


def test_healthy_runs_are_counted_and_each_that_is_not_well_is_told() -> None:
    trouble = [{"name": "sensor_frozen", "named_s": 7.0}]
    said = foreign.healthy_table(
        [healthy_run(1), healthy_run(2, troubles=trouble, mean_pct=0.15), {"seed": 3, "block": 5, "failed": "E: no"}]
    ).splitlines()
    assert said[0].startswith("healthy: 3 stages, 1 failed, 1.00 h; false troubles 1 (sensor_frozen 1); 0 above 5 %")
    assert "median / 95 %: 0.100 / 0.145" in said[0]
    assert "TROUBLE sensor_frozen at 7.00 s" in said[1]
    assert said[2].startswith("seed 3")
    assert len(said) == 3


def test_healthy_runs_go_on_where_the_file_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign, "HEALTHY_S", (8.0, 8.0))
    file = tmp_path / "healthy.jsonl"
    file.write_text(json.dumps(healthy_run(900_001, simulated_s=10.0)) + "\n{cut off")
    hours = 16.0 / 3600.0
    assert main(["--healthy", f"{hours}", "--first-seed", "900001", "--json", str(file), "--block", "20"]) == 0
    records = read_lines([file])
    assert [record["seed"] for record in records] == [900_001, 900_002]
    new = records[1]
    assert new["class"] == "healthy"
    assert new["block"] == 20
    assert new["simulated_s"] == pytest.approx(8.0, abs=0.05)
    assert new["mean_pct"] < 1.0
    assert "frozen" not in new
    # The hours are reached: nothing is run.
    assert main(["--healthy", f"{hours}", "--first-seed", "900001", "--json", str(file)]) == 0
    assert len(read_lines([file])) == 2


def test_a_file_is_continued_with_the_runs_that_it_does_not_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = []

    def run_one(name: str, seed: int, after_s: float) -> dict[str, Any]:
        ran.append(seed)
        return run(name) | {"seed": seed}

    monkeypatch.setattr(foreign, "run_one", run_one)
    file = tmp_path / "foreign.jsonl"
    for runs in ("2", "3"):
        assert main(["--only", "knock", "--runs", runs, "--json", str(file)]) == 0
    assert ran == [0, 1, 2]
    assert "runs: 3, of which 0 failed" in capsys.readouterr().out
