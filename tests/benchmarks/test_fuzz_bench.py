"""The fuzzer as a command runs, is guided by what it reaches, and can say no."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fuzz import main
from benchmarks.fuzz_targets import seeds

ROOT = Path(__file__).parents[2]


def fuzz(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz", *options],
        capture_output=True, text=True, timeout=150, check=False, cwd=ROOT,
    )  # fmt: skip


@pytest.mark.e2e
@pytest.mark.slow
def test_the_fuzzer_runs_as_a_command_guided_by_coverage(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    options = ("--out", str(tmp_path), "--payloads", "1500", "--live", "0")
    done = fuzz(*options, "--target", "framed")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "fuzz.json").read_text(encoding="utf-8"))
    assert report["held"]
    assert report["crashes"] == 0
    assert report["payloads"] >= 1500
    assert [target["target"] for target in report["targets"]] == ["framed"]
    for target in report["targets"]:
        # Guided: it counts branches, and keeps more payloads than the honest ones that it began with.
        assert target["edges"] > 20
        assert target["corpus"] > len(seeds(target["target"]))
        assert not target["crashes"]
    honest = tmp_path / "query-crash-none"
    honest.write_bytes(seeds("query")[0])
    assert fuzz("--repeat", str(honest)).returncode == 0


def test_a_target_that_does_not_exist_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["fuzz", "--out", str(tmp_path), "--target", "nothing"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "one of samples" in capsys.readouterr().err
