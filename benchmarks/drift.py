"""Drift of the recursion from the direct solver over very many updates, by condition number and form."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive import lssvm
from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window import steps as window_core
from dehyst.adaptive.window.arrays import WindowArrays
from dehyst.adaptive.window.window import Form, Window, WindowConfig

#: gamma and width for condition numbers from about 1e3 to 1e8 with windows of 100 samples in three dimensions.
HARDNESS: tuple[tuple[float, float], ...] = ((1e2, 0.5), (1.5e3, 1.0), (1e4, 1.0), (1e5, 1.0), (1.2e6, 1.5))
#: The same for about 1e5 and 1e8 with windows of 500, the size of the learner's.
HARDNESS_500: tuple[tuple[float, float], ...] = ((4e2, 1.0), (4e5, 1.2))
DIMENSION = 3
FORMS: tuple[Form, ...] = ("inverse", "cholesky", "auto")


@compiled
def _slide(A: WindowArrays, X: FloatArray, y: FloatArray, slots: NDArray[np.int64], start: int) -> int:
    for k in range(start, y.shape[0]):
        if window_core.replace(A, slots[k], X[k], y[k], 1.0) != 0:
            return k
    return y.shape[0]


def _slide_and_heal(window: Window, X: FloatArray, y: FloatArray, slots: NDArray[np.int64]) -> int:
    """Learn all samples; if a step is refused, factor the window again, as the learner does. Returns how often."""
    refused, at = 0, _slide(window.arrays, X, y, slots, 0)
    while at < y.size:
        refused += 1
        window.heal()
        at = _slide(window.arrays, X, y, slots, at + 1)
    return refused


def _samples(rng: np.random.Generator, count: int, size: int) -> tuple[FloatArray, FloatArray]:
    """Uniform points, a fifth of them within 1e-7 of an earlier one."""
    X = rng.random((count, DIMENSION))
    for k in np.flatnonzero(rng.random(count) < 0.2).tolist():
        X[k] = X[max(k - 1 - int(rng.integers(size // 2)), 0)] + 1e-7 * rng.standard_normal(DIMENSION)
    return X, np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(count)


def bench_drift(
    updates: int, size: int = 100, checks: int = 10, accuracy: float = 1e-8, forms: tuple[Form, ...] = FORMS
) -> list[dict[str, float | str]]:
    """Worst relative error of alpha over ``checks`` checks in a stream of ``updates``, slots replaced at random."""
    report: list[dict[str, float | str]] = []
    for gamma, width in HARDNESS if size < 500 else HARDNESS_500:
        for form in forms:
            rng = np.random.default_rng(1)
            config = WindowConfig(size, (width,) * DIMENSION, gamma, form=form, accuracy=accuracy)
            window = Window.from_samples(config, *_samples(rng, size, size))
            worst, refused, start = 0.0, 0, time.perf_counter()
            for _ in range(checks):
                X, y = _samples(rng, updates // checks, size)
                refused += _slide_and_heal(window, X, y, rng.integers(0, size, y.size))
                direct = lssvm.fit(window.X, window.y, width, gamma).model.alpha
                worst = max(worst, float(np.linalg.norm(window.alpha - direct) / np.linalg.norm(direct)))
            report.append(
                {
                    "size": float(size),
                    "form": form,
                    "at_work": window.form,
                    "condition": float(np.linalg.cond(window.arrays.R)),
                    "updates": float(updates),
                    "worst_alpha_error": worst,
                    "refinements": float(window.counters()["refinements"]),
                    "refused": float(refused),
                    "seconds": time.perf_counter() - start,
                }
            )
    return report
