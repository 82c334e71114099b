"""The benchmark of a sudden change: fresher answers take it up sooner, and what is asked for is judged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.step import GOALS, main


def test_a_fresher_model_takes_up_a_change_sooner(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "step.json"
    assert main(["--seeds", "20", "--ages", "20", "80", "--seconds", "8", "--json", str(out)]) == 0
    runs = {age: rows[0] for age, rows in json.loads(out.read_text()).items()}
    assert set(runs["20"]) == {"before", *GOALS}
    # The place at the change is the same, so that what each millisecond costs is.
    assert 1.5 < runs["80"]["first"] / runs["20"]["first"] < 4.0
    assert runs["80"]["then"] < GOALS["then"]
    assert "| 20 ms |" in capsys.readouterr().out


def test_an_age_that_is_no_whole_block_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--ages", "30"])
    assert "multiples of 20" in capsys.readouterr().err
