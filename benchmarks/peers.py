"""Other solvers on the same stream: scikit-learn's refits and the sliding-window KRLS of PyPI's ``krls``.

Every solver predicts each sample before it learns it; the report gives the error of these predictions and the time.
Solvers without a bias get samples centred on the mean of the first window.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from benchmarks.measuring import GAMMA, WIDTH, stream
from benchmarks.solver import make_window

#: predict (1, d) -> value, learn sample k of the stream.
Peer = tuple[Callable[[FloatArray], float], Callable[[int], object]]


def bench_peers(n: int, steps: int) -> dict[str, dict[str, Any]]:
    """Median time to learn one sample with a window of ``n``, and the error of predicting it, by solver.

    For a solver that cannot be imported the reason is under "missing"; ``pip install dehyst[peers]`` installs them
    all.
    """
    X, y = stream(n + steps)
    y = y - y[:n].mean()
    makers: dict[str, Callable[[FloatArray, FloatArray, int], Peer]] = {
        "dehyst": _ours,
        "sklearn_krr": _kernel_ridge,
        "sklearn_gpr": _gaussian_process,
        "krls": _krls,
    }
    report: dict[str, dict[str, Any]] = {}
    for name, make in makers.items():
        try:
            predict, learn = make(X, y, n)
        except ImportError as error:
            report[name] = {"missing": str(error)}
            continue
        taken, errors = np.empty(steps), np.empty(steps)
        for i in range(steps):
            k = n + i
            errors[i] = y[k] - predict(X[k : k + 1])
            start = time.perf_counter_ns()
            learn(k)
            taken[i] = (time.perf_counter_ns() - start) / 1e3
        report[name] = {
            "update_us": float(np.median(taken)),
            "rmse": float(np.sqrt(np.mean(errors**2))),
            "samples": float(steps),
        }
    for entry in report.values():
        if "missing" not in entry:
            entry["over_dehyst"] = entry["update_us"] / report["dehyst"]["update_us"]
    return report


def _ours(X: FloatArray, y: FloatArray, n: int) -> Peer:
    window = make_window(X, y, n, "inverse")
    return lambda x: window.predict(x[0]), lambda k: window.replace(k % n, X[k], y[k])


def _kernel_ridge(X: FloatArray, y: FloatArray, n: int) -> Peer:
    from sklearn.kernel_ridge import KernelRidge

    model = KernelRidge(alpha=1.0 / GAMMA, kernel="rbf", gamma=1.0 / WIDTH**2).fit(X[:n], y[:n])
    return lambda x: float(model.predict(x)[0]), lambda k: model.fit(X[k + 1 - n : k + 1], y[k + 1 - n : k + 1])


def _gaussian_process(X: FloatArray, y: FloatArray, n: int) -> Peer:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    kernel = RBF(WIDTH / np.sqrt(2.0), length_scale_bounds="fixed")
    model = GaussianProcessRegressor(kernel, alpha=1.0 / GAMMA, optimizer=None).fit(X[:n], y[:n])
    return lambda x: float(model.predict(x)[0]), lambda k: model.fit(X[k + 1 - n : k + 1], y[k + 1 - n : k + 1])


def _krls(X: FloatArray, y: FloatArray, n: int) -> Peer:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from krls.krls import SW_KRLS

    # Its kernel is exp(-d²/(2 sigma²)).
    model = SW_KRLS(N=n, c=1.0 / GAMMA, kernel_type="Gaussian", sigma=WIDTH / float(np.sqrt(2.0)))
    model.fit(X[:n], y[:n])
    return lambda x: float(np.ravel(model.predict(x))[0]), lambda k: model.evolve(X[k : k + 1], y[k : k + 1])
