"""The window beside its yardsticks (one ``dsymv`` of the same size, one pass over the same memory, one refit), and the
drift of its recursion from the direct solver over very many updates. ``dehyst bench`` prints both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas
from scipy.linalg.lapack import dpotrf, dpotrs
from threadpoolctl import threadpool_limits

from dehyst.adaptive import features, lssvm
from dehyst.adaptive.compiled import compiled, compiled_reassociating
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.warm import warm
from dehyst.adaptive.window import steps as window_core
from dehyst.adaptive.window.arrays import BETA, WindowArrays
from dehyst.adaptive.window.window import Form, Window, WindowConfig

SIZES: Final = (100, 250, 500, 1000, 2000)
#: Features of a sample: displacement, velocity and three play operators.
DIMENSION: Final = 5
WIDTH, GAMMA = 1.0, 100.0
Report = dict[str, Any]


def run(quick: bool = False) -> Report:
    """Run everything with one BLAS thread: ``quick`` in under a minute, otherwise in some minutes.

    Returns ``{"window": {N: {...}}, "drift": [...]}``; times in µs, errors without unit.
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


def page(report: Report) -> str:
    """The report as tables."""
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
    lines = ["One step of the window, medians in µs (one BLAS thread)", ""]
    lines.append(f"{'N':>6}" + "".join(f"{title:>10}" for _, title in columns))
    for n, row in report["window"].items():
        lines.append(f"{n:>6}" + "".join(f"{row[key]:>10.2f}" for key, _ in columns))
    lines += ["", "Relative error of alpha after many updates, near-duplicates in the stream", ""]
    for row in report["drift"]:
        lines.append(
            f"  N {row['size']:.0f}  cond {row['condition']:.1e}  {row['form']:>9} ({row['at_work']})  "
            f"{row['updates']:.0f} updates  worst {row['worst_alpha_error']:.1e}  refinements {row['refinements']:.0f}"
        )
    return "\n".join(lines)


# --- The window.


def stream(count: int) -> tuple[FloatArray, FloatArray]:
    """Normalised X (count, d), y (count,) along a smooth random trajectory; 0.2 % noise, a fifth near-duplicates."""
    rng = np.random.default_rng(1)
    t = np.arange(count) * 0.02
    tones = rng.uniform(0.2, 3.0, (DIMENSION, 3)), rng.uniform(0, 2 * np.pi, (DIMENSION, 3))
    X = np.stack([np.mean(0.5 + 0.5 * np.sin(np.outer(t, f) + p), axis=1) for f, p in zip(*tones, strict=True)], axis=1)
    _double(X, rng, 50)
    y = np.sin(3 * X[:, 0]) + X[:, 1] * X[:, 2] + 0.3 * np.abs(X[:, 3] - 0.5) + 0.1 * X[:, 4]
    return np.ascontiguousarray(X), y + 0.002 * rng.standard_normal(count)


def _double(X: FloatArray, rng: np.random.Generator, back: int) -> None:
    """Replace a fifth of the points by one of up to ``back`` before, 1e-7 away."""
    for k in np.flatnonzero(rng.random(len(X)) < 0.2).tolist():
        X[k] = X[max(k - 1 - int(rng.integers(back)), 0)] + 1e-7 * rng.standard_normal(X.shape[1])


def times(call: Callable[[], object], repeats: int, warm_calls: int = 1) -> FloatArray:
    """(repeats,) wall times of single calls, µs, after ``warm_calls`` that do not count."""
    for _ in range(warm_calls):
        call()
    taken = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter_ns()
        call()
        taken[i] = time.perf_counter_ns() - start
    return taken / 1e3


def interleaved(calls: dict[str, Callable[[], object]], repeats: int, block: int = 25) -> dict[str, FloatArray]:
    """Time several calls in turns of ``block``, so that changes of clock frequency or load affect all alike."""
    turns = range(max(1, repeats // block))
    parts = [{name: times(call, min(block, repeats)) for name, call in calls.items()} for _ in turns]
    return {name: np.concatenate([part[name] for part in parts]) for name in calls}


@compiled_reassociating
def memory_pass(P: FloatArray) -> None:
    """Read and write one triangle once, and do next to nothing with it: what memory alone allows."""
    for i in range(P.shape[0]):
        row = P[i]
        for j in range(i + 1):
            row[j] = row[j] * 0.999


class Slide:
    """Replaces the oldest sample of a window by the stream's next, over and over."""

    def __init__(self, X: FloatArray, y: FloatArray, n: int, form: Form) -> None:
        self.window = Window.from_samples(WindowConfig(n, (WIDTH,) * DIMENSION, GAMMA, form=form), X[:n], y[:n])
        self.X, self.y, self.at = X, y, n

    def __call__(self) -> None:
        k = self.at
        self.window.replace(k % len(self.window), self.X[k % self.y.size], self.y[k % self.y.size])
        self.at = k + 1


def refit(X: FloatArray, y: FloatArray) -> None:
    """The same solution from scratch: Gram matrix, factor, two solves."""
    R = features.gram(X, None, np.full(DIMENSION, WIDTH))
    R[np.diag_indices(y.size)] += 1.0 / GAMMA
    factor, _ = dpotrf(R, lower=1, overwrite_a=1)
    dpotrs(factor, np.column_stack([np.ones(y.size), y]), lower=1)


def bench_window(n: int, repeats: int) -> dict[str, float]:
    """Of each call median and p99 in µs and the median over that of ``dsymv``, for a window of ``n`` samples."""
    X, y = stream(n + 4 * repeats)
    update = Slide(X, y, n, "inverse")
    point = X[n].copy()
    symmetric = np.asfortranarray(features.gram(X[:n], None, np.full(DIMENSION, WIDTH)))
    vector, out = y[:n].copy(), np.zeros(n)
    triangle = np.ascontiguousarray(symmetric)
    measured = interleaved(
        {
            "update": update,
            "dsymv": lambda: blas.dsymv(1.0, symmetric, vector, lower=1, y=out, overwrite_y=1),
            "memory_pass": lambda: memory_pass(triangle),
            "predict": lambda: update.window.predict(point),
            "cholesky_update": Slide(X, y, n, "cholesky"),
        },
        repeats,
    )
    measured["refit"] = times(lambda: refit(X[:n], y[:n]), max(5, min(repeats // 20, int(2e8 / n**2.5))), 3)
    report = {}
    for name, taken in measured.items():
        report[f"{name}_us"] = float(np.median(taken))
        report[f"{name}_p99_us"] = float(np.percentile(taken, 99))
        report[f"{name}_over_dsymv"] = report[f"{name}_us"] / float(np.median(measured["dsymv"]))
    window = update.window
    A = window.arrays
    report["worst_residual"] = float(np.max(np.abs(window.y - A.F[BETA] - A.R @ window.alpha)))
    return report


# --- The drift.

#: gamma and width for condition numbers from about 1e3 to 1e8 with windows of 100 samples in three dimensions.
HARDNESS: Final = ((1e2, 0.5), (1.5e3, 1.0), (1e4, 1.0), (1e5, 1.0), (1.2e6, 1.5))
#: The same for about 1e5 and 1e8 with windows of 500, the size of the learner's.
HARDNESS_500: Final = ((4e2, 1.0), (4e5, 1.2))
FORMS: Final[tuple[Form, ...]] = ("inverse", "cholesky", "auto")


@compiled
def _slide(A: WindowArrays, X: FloatArray, y: FloatArray, slots: NDArray[np.int64], start: int) -> int:
    for k in range(start, y.shape[0]):
        if window_core.replace(A, slots[k], X[k], y[k]) != 0:
            return k
    return y.shape[0]


def _slide_and_heal(window: Window, X: FloatArray, y: FloatArray, slots: NDArray[np.int64]) -> None:
    """Learn all samples; if a step is refused, factor the window again, as the learner does."""
    at = _slide(window.arrays, X, y, slots, 0)
    while at < y.size:
        window.heal()
        at = _slide(window.arrays, X, y, slots, at + 1)


def _samples(rng: np.random.Generator, count: int, size: int) -> tuple[FloatArray, FloatArray]:
    """Uniform points in three dimensions, a fifth of them within 1e-7 of an earlier one."""
    X = rng.random((count, 3))
    _double(X, rng, size // 2)
    return X, np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(count)


def bench_drift(updates: int, size: int = 100, checks: int = 10, forms: tuple[Form, ...] = FORMS) -> list[Report]:
    """Worst relative error of alpha over ``checks`` checks in a stream of ``updates``, slots replaced at random."""
    report: list[Report] = []
    for gamma, width in HARDNESS if size < 500 else HARDNESS_500:
        for form in forms:
            rng, worst = np.random.default_rng(1), 0.0
            config = WindowConfig(size, (width,) * 3, gamma, form=form, accuracy=1e-8)
            window = Window.from_samples(config, *_samples(rng, size, size))
            for _ in range(checks):
                X, y = _samples(rng, updates // checks, size)
                _slide_and_heal(window, X, y, rng.integers(0, size, y.size))
                direct = lssvm.fit(window.X, window.y, width, gamma).model.alpha
                worst = max(worst, float(np.linalg.norm(window.alpha - direct) / np.linalg.norm(direct)))
            condition, refinements = float(np.linalg.cond(window.arrays.R)), window.counters()["refinements"]
            report.append(
                {"size": size, "form": form, "at_work": window.form, "condition": condition, "updates": updates,
                 "worst_alpha_error": worst, "refinements": refinements}
            )  # fmt: skip
    return report
