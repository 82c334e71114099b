"""The fuzzer as a command runs, is guided by what it reaches, and can say no; the fire at a live service likewise."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fuzz import main
from benchmarks.fuzz_live import bombard, compared
from benchmarks.fuzz_targets import TARGETS, seeds
from benchmarks.mutations import mutated

ROOT = Path(__file__).parents[2]


def fuzz(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.fuzz", *options],
        capture_output=True, text=True, timeout=150, check=False, cwd=ROOT,
    )  # fmt: skip


def test_five_thousand_payloads_over_every_reader_do_no_more_than_be_refused() -> None:
    rng = np.random.default_rng(11)
    targets = {name: make() for name, make in TARGETS.items()}
    each = -(-5000 // len(targets))
    refused = dict.fromkeys(targets, 0)
    for name, target in targets.items():
        honest = seeds(name)
        for k in range(each):
            payload = mutated(honest[k % len(honest)], rng)
            target(payload)  # which lets nothing pass but what is documented
            refused[name] += payload not in honest
    assert min(refused.values()) > each // 2


@pytest.mark.e2e
@pytest.mark.slow
def test_the_fuzzer_runs_as_a_command_guided_by_coverage(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    done = fuzz(
        "--out",
        str(tmp_path),
        "--target",
        "query",
        "--target",
        "framed",
        "--payloads",
        "5000",
        "--live",
        "0",
        "--states",
        "30",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "fuzz.json").read_text(encoding="utf-8"))
    assert report["held"]
    assert report["crashes"] == 0
    assert report["payloads"] >= 5000
    assert [target["target"] for target in report["targets"]] == ["query", "framed"]
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


@pytest.mark.e2e
@pytest.mark.slow
def test_a_live_service_under_a_little_fire_is_judged_and_all_three_p99_are_told(tmp_path: Path) -> None:
    told = bombard(tmp_path, 4.0, 150.0, 3)
    assert told["fired"] >= 100
    assert told["refused"] > 20
    assert told["malformed_samples"] > 5
    assert told["query_errors"] > 5
    # How fast is for a machine that does nothing else; the rest holds on any.
    assert {name: held for name, held in told["checks"].items() if name != "p99"} == {
        "ends_well": True, "all_answered": True, "no_growth": True,
    }, told  # fmt: skip
    assert told["held"] == all(told["checks"].values())
    for phase in ("quiet", "honest_fire", "malformed_fire"):
        assert told[phase]["count"] > 50
        assert 0.0 < told[phase]["p50_us"] <= told[phase]["p99_us"]
    p99 = told["p99"]
    assert p99["over_quiet"] == pytest.approx(p99["malformed_us"] / p99["quiet_us"])
    assert p99["over_honest_fire"] == pytest.approx(p99["malformed_us"] / p99["honest_us"])


def test_the_limit_is_set_by_the_honest_fire_and_by_what_a_machine_does_by_itself() -> None:
    def limit_us(honest_us: float) -> float:
        phases = {"quiet": 500.0, "honest_fire": honest_us, "malformed_fire": 900.0}
        return compared({name: {"p99_us": value} for name, value in phases.items()})["limit_us"]

    assert limit_us(2000.0) == 3000.0
    assert limit_us(400.0) == 700.0
