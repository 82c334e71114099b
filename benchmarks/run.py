"""All benchmarks of the solver, as numbers and as text."""

from __future__ import annotations

from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.drift import bench_drift
from benchmarks.solver import bench_window
from dehyst.adaptive.warm import warm

SIZES = (100, 250, 500, 1000, 2000)


def run(quick: bool = False) -> dict[str, Any]:
    """Run everything with one BLAS thread: ``quick`` in under a minute, otherwise in some minutes.

    Returns
    -------
    ``{"window": {N: {...}}, "drift": [...]}``; times in µs, errors without unit.
    """
    warm()
    with threadpool_limits(1):
        window = {}
        for n in SIZES:
            repeats = 2000 if n <= 500 else 400 if n <= 1000 else 100
            window[str(n)] = bench_window(n, repeats // 4 if quick else repeats)
        updates = 20_000 if quick else 1_000_000
        drift = bench_drift(updates) + bench_drift(updates, 500, forms=("auto",))
    return {"window": window, "drift": drift}


def page(report: dict[str, Any]) -> str:
    """The report as tables."""
    lines = ["One step of the window, medians in µs (one BLAS thread)", ""]
    columns = (
        ("update_us", "update"),
        ("update_p99_us", "p99"),
        ("dsymv_us", "dsymv"),
        ("update_over_dsymv", "ratio"),
        ("memory_pass_us", "memory"),
        ("predict_us", "predict"),
        ("cholesky_update_us", "Cholesky"),
        ("refit_us", "refit"),
    )
    lines.append(f"{'N':>6}" + "".join(f"{title:>10}" for _, title in columns))
    for n, row in report["window"].items():
        lines.append(f"{n:>6}" + "".join(f"{row[key]:>10.2f}" for key, _ in columns))
    if "500" in report["window"]:
        row = report["window"]["500"]
        spread = ((name, row[f"{name}_p99_over_median"]) for name in ("update", "dsymv", "memory_pass"))
        lines += ["", "p99 over the median at N = 500: " + ", ".join(f"{name} {value:.2f}" for name, value in spread)]
    lines += ["", "Relative error of alpha after many updates, near-duplicates in the stream", ""]
    for row in report["drift"]:
        lines.append(
            f"  N {row['size']:.0f}  cond {row['condition']:.1e}  {row['form']:>9} ({row['at_work']})  "
            f"{row['updates']:.0f} updates  "
            f"worst {row['worst_alpha_error']:.1e}  refinements {row['refinements']:.0f}"
        )
    return "\n".join(lines)
