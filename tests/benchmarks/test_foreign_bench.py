"""The benchmark of foreign stages: its tables and its line over made-up runs, and the fixed runs of the line."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from benchmarks import foreign
from benchmarks.foreign import (
    main,
    read,
)


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


def healthy_run(seed: int, **given: Any) -> dict[str, Any]:
    """Half an hour on a stage with 1 kHz in which nothing was wrong, but for what is given."""
    record = {
        "seed": seed, "class": "healthy", "block": 5, "stage": {"hysteresis": "plays", "dt_s": 1e-3},
        "simulated_s": 1800.0, "mean_pct": 0.05, "figures": {"large_s": 0.0}, "troubles": [], "cpu_s": 1.0,
    }  # fmt: skip
    return record | given


def test_healthy_runs_go_on_where_the_file_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign, "HEALTHY_S", (8.0, 8.0))
    monkeypatch.setattr(foreign, "_pool", ThreadPoolExecutor)
    file = tmp_path / "healthy.jsonl"
    file.write_text(json.dumps(healthy_run(900_001, simulated_s=10.0)) + "\n{cut off")
    hours = 16.0 / 3600.0
    assert main(["--healthy", f"{hours}", "--first-seed", "900001", "--json", str(file), "--block", "20"]) == 0
    records = read([file])
    assert [record["seed"] for record in records] == [900_001, 900_002]
    new = records[1]
    assert new["class"] == "healthy"
    assert new["block"] == 20
    assert new["simulated_s"] == pytest.approx(8.0, abs=0.05)
    assert new["mean_pct"] < 1.0
    assert "frozen" not in new
    # The hours are reached: nothing is run.
    assert main(["--healthy", f"{hours}", "--first-seed", "900001", "--json", str(file)]) == 0
    assert len(read([file])) == 2
