"""The benchmarks run, and report what scripts read under the keys that are promised."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks import run
from benchmarks.drift import bench_drift
from benchmarks.solver import bench_window
from dehyst.lab.cli import main

#: What `dehyst bench --json` is read for.
WINDOW_KEYS = {
    "update_min_us",
    "update_p99_over_median",
    "dsymv_us",
    "memory_pass_us",
    "loo_us",
    "cholesky_loo_us",
    "refit_over_update",
    *(
        f"{name}_{figure}"
        for name in ("update", "cholesky_update", "predict", "refit")
        for figure in ("us", "p99_us", "over_dsymv", "over_memory_pass")
    ),
}
SIZES = (100, 250, 500, 1000, 2000)


@pytest.fixture(scope="module")
def report() -> dict[str, object]:
    return {
        "window": {"100": bench_window(100, 50)},
        "drift": bench_drift(400, size=50, checks=2),
    }


def check_window(row: dict[str, float]) -> None:
    """Every key is there, and each figure is of what its name says."""
    assert row.keys() >= WINDOW_KEYS
    assert all(value > 0 for value in row.values())
    for name in ("update", "cholesky_update", "predict", "refit"):
        assert row[f"{name}_over_dsymv"] == pytest.approx(row[f"{name}_us"] / row["dsymv_us"])
        assert row[f"{name}_over_memory_pass"] == pytest.approx(row[f"{name}_us"] / row["memory_pass_us"])
        assert row[f"{name}_p99_us"] >= row[f"{name}_us"]
    # What is timed is the recursion and not something that has stopped working: the samples are still solved.
    assert row["worst_residual"] < 1e-9


def test_the_window_is_measured_beside_its_yardsticks(report: dict[str, object]) -> None:
    check_window(report["window"]["100"])  # type: ignore[index]


def test_drift_is_looked_at_in_every_form(report: dict[str, object]) -> None:
    rows = report["drift"]
    assert {row["form"] for row in rows} == {"inverse", "cholesky", "auto"}  # type: ignore[attr-defined]
    for row in rows:  # type: ignore[attr-defined]
        if row["form"] != "inverse" or row["condition"] < 1e5:
            assert row["worst_alpha_error"] < 1e-6, row


def test_the_page_names_every_size(report: dict[str, object]) -> None:
    page = run.page(report)
    assert "100" in page
    assert page.count(" updates ") == len(report["drift"])  # type: ignore[arg-type]


def test_the_command_reports_every_size_and_the_drift(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`dehyst bench --json` itself; only the work behind each of its keys is made smaller."""
    asked: dict[str, list[tuple[Any, ...]]] = {"window": [], "drift": []}

    def window(n: int, repeats: int) -> dict[str, float]:
        asked["window"].append((n, repeats))
        return bench_window(n // 10, 25)

    def drift(updates: int, size: int = 100, **more: Any) -> list[dict[str, float | str]]:
        asked["drift"].append((updates, size))
        return [row | {"size": float(size)} for row in bench_drift(200, size // 5, checks=2, **more)]

    stand_ins = {"bench_window": window, "bench_drift": drift}
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(run, name, stand_in)
    assert main(["bench", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["window"]) == [str(n) for n in SIZES]
    assert [n for n, _ in asked["window"]] == list(SIZES)
    for row in told["window"].values():
        check_window(row)
    assert asked["drift"] == [(1_000_000, 100), (1_000_000, 500)]
    assert {row["size"] for row in told["drift"]} == {100.0, 500.0}
    assert {row["form"] for row in told["drift"] if row["size"] == 100.0} == {"inverse", "cholesky", "auto"}
