"""The window beside its yardsticks: one ``dsymv`` of the same size, one bare pass over the same memory, one refit."""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas
from scipy.linalg.lapack import dpotrf, dpotrs

from benchmarks.measuring import DIMENSION, GAMMA, WIDTH, Times, interleaved, stream, times
from dehyst.adaptive import kernels
from dehyst.adaptive.compiled import compiled_reassociating
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window.arrays import BETA
from dehyst.adaptive.window.window import Form, Window, WindowConfig


@compiled_reassociating
def memory_pass(P: FloatArray) -> None:
    """Read and write one triangle once, and do next to nothing with it: what memory alone allows."""
    for i in range(P.shape[0]):
        row = P[i]
        for j in range(i + 1):
            row[j] = row[j] * 0.999


def make_window(X: FloatArray, y: FloatArray, n: int, form: Form) -> Window:
    """A full window of the stream's first ``n`` samples."""
    config = WindowConfig(n, (WIDTH,) * DIMENSION, GAMMA, form=form)
    return Window.from_samples(config, X[:n], y[:n])


class Slide:
    """Replaces the oldest sample by the stream's next, over and over."""

    def __init__(self, window: Window, X: FloatArray, y: FloatArray) -> None:
        self.window, self.X, self.y = window, X, y
        self.at = len(window)

    def __call__(self) -> None:
        k = self.at
        self.window.replace(k % len(self.window), self.X[k % self.y.size], self.y[k % self.y.size])
        self.at = k + 1


def refit(X: FloatArray, y: FloatArray) -> None:
    """The same solution from scratch: Gram matrix, factor, two solves."""
    R = kernels.gram(X, None, np.full(DIMENSION, WIDTH))
    R[np.diag_indices(y.size)] += 1.0 / GAMMA
    factor, _ = dpotrf(R, lower=1, overwrite_a=1)
    dpotrs(factor, np.column_stack([np.ones(y.size), y]), lower=1)


def bench_window(n: int, repeats: int) -> dict[str, float]:
    """All times of a window of ``n`` samples, medians and p99 in µs, and their ratios."""
    X, y = stream(n + 4 * repeats)
    inverse = make_window(X, y, n, "inverse")
    factored = make_window(X, y, n, "cholesky")
    point = X[n].copy()
    symmetric = np.asfortranarray(kernels.gram(X[:n], None, np.full(DIMENSION, WIDTH)))
    vector, out = y[:n].copy(), np.zeros(n)
    triangle = np.ascontiguousarray(symmetric)
    fast = interleaved(
        {
            "update": Slide(inverse, X, y),
            "dsymv": lambda: blas.dsymv(1.0, symmetric, vector, lower=1, y=out, overwrite_y=1),
            "memory_pass": lambda: memory_pass(triangle),
            "predict": lambda: inverse.predict(point),
            "cholesky_update": Slide(factored, X, y),
            "loo": inverse.leave_one_out,
        },
        repeats,
    )
    slow = max(10, repeats // 20)
    # Last: once asked for, a Cholesky window carries the diagonal along, which its steps then pay for.
    fast["cholesky_loo"] = times(factored.leave_one_out, slow)
    fast["refit"] = times(lambda: refit(X[:n], y[:n]), max(5, min(slow, int(2e8 / n**2.5))))
    report = {f"{name}_us": t.median for name, t in fast.items()}
    for name in ("update", "cholesky_update", "predict", "refit"):
        report[f"{name}_p99_us"] = fast[name].p99
        report[f"{name}_over_dsymv"] = _ratio(fast, name, "dsymv")
        report[f"{name}_over_memory_pass"] = _ratio(fast, name, "memory_pass")
    report["update_min_us"] = float(fast["update"].samples.min())
    report["update_p99_over_median"] = fast["update"].p99 / fast["update"].median
    # What the machine does to any call of this length: a timer's tick, a neighbour's load.
    report["dsymv_p99_over_median"] = fast["dsymv"].p99 / fast["dsymv"].median
    report["memory_pass_p99_over_median"] = fast["memory_pass"].p99 / fast["memory_pass"].median
    report["refit_over_update"] = _ratio(fast, "refit", "update")
    A = inverse.arrays
    report["worst_residual"] = float(np.max(np.abs(inverse.y - A.F[BETA] - A.R @ inverse.alpha)))
    return report


def _ratio(measured: dict[str, Times], above: str, below: str) -> float:
    return measured[above].median / measured[below].median
