"""The benchmarks run, and report what scripts read under the keys that are promised."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import run
from benchmarks.drift import bench_drift
from benchmarks.peers import bench_peers
from benchmarks.solver import bench_window

#: What `dehyst bench --json` is read for.
WINDOW_KEYS = {
    "update_us",
    "update_p99_us",
    "predict_us",
    "variance_us",
    "dsymv_us",
    "memory_pass_us",
    "update_over_dsymv",
    "refit_us",
}


@pytest.fixture(scope="module")
def report() -> dict[str, object]:
    return {
        "window": {"100": bench_window(100, 50)},
        "peers": bench_peers(60, 5),
        "drift": bench_drift(400, size=50, checks=2),
    }


def test_the_window_is_measured_beside_its_yardsticks(report: dict[str, object]) -> None:
    row = report["window"]["100"]  # type: ignore[index]
    assert row.keys() >= WINDOW_KEYS
    assert all(value > 0 for value in row.values())
    assert row["update_over_dsymv"] == pytest.approx(row["update_us"] / row["dsymv_us"])
    # What is timed is the recursion and not something that has stopped working: the samples are still solved.
    assert row["worst_residual"] < 1e-9


def test_peers_learn_the_same_stream(report: dict[str, object]) -> None:
    peers = report["peers"]
    assert peers.keys() >= {"krls", "sklearn_krr"}  # type: ignore[attr-defined]
    assert all(np.isfinite(row["rmse"]) for row in peers.values())  # type: ignore[attr-defined]


def test_drift_is_looked_at_in_every_form(report: dict[str, object]) -> None:
    rows = report["drift"]
    assert {row["form"] for row in rows} == {"inverse", "cholesky", "auto"}  # type: ignore[attr-defined]
    for row in rows:  # type: ignore[attr-defined]
        if row["form"] != "inverse" or row["condition"] < 1e5:
            assert row["worst_alpha_error"] < 1e-6, row


def test_the_page_names_every_size(report: dict[str, object]) -> None:
    page = run.page(report)
    assert "100" in page
    assert "krls" in page
    assert page.count("updates") == len(report["drift"]) + 1  # type: ignore[arg-type]
