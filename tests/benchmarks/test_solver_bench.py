"""The benchmarks run, and report what scripts read under the keys that are promised."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks import solver
from benchmarks.solver import SIZES, bench_drift, bench_window
from dehyst.lab.cli import main


def test_the_command_reports_every_size_and_the_drift(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`dehyst bench` itself; only the work behind each of its keys is made smaller."""
    asked: list[tuple[int, int]] = []

    def drift(updates: int, size: int = 100, **more: Any) -> list[dict[str, Any]]:
        asked.append((updates, size))
        return [row | {"size": float(size)} for row in bench_drift(200, 20, checks=2, **more)]

    measured = bench_window(50, 25)
    monkeypatch.setattr(solver, "bench_window", lambda n, repeats: measured)
    monkeypatch.setattr(solver, "bench_drift", drift)
    assert main(["bench", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["window"]) == [str(n) for n in SIZES]
    for row in told["window"].values():
        assert all(value > 0 for value in row.values())
        for name in ("update", "cholesky_update", "predict", "refit"):
            assert row[f"{name}_over_dsymv"] == pytest.approx(row[f"{name}_us"] / row["dsymv_us"])
            assert row[f"{name}_p99_us"] >= row[f"{name}_us"]
        # What is timed is the recursion and not something that has stopped working: the samples are still solved.
        assert row["worst_residual"] < 1e-9
    assert asked == [(1_000_000, 100), (1_000_000, 500)]
    assert {row["form"] for row in told["drift"] if row["size"] == 100.0} == {"inverse", "cholesky", "auto"}
    for row in told["drift"]:
        if row["form"] != "inverse" or row["condition"] < 1e5:
            assert row["worst_alpha_error"] < 1e-6, row
    page = solver.page(told)
    assert all(f"\n{n:>6} " in page for n in SIZES)
    assert page.count(" updates ") == len(told["drift"])
