"""The window of this build and of another checkout in turns, in one process, beside a ``dsymv`` of the same size.

``python -m benchmarks.two_builds OTHER`` with the folder of the other checkout (``git worktree add OTHER COMMIT``).
Prints medians and p99 of a replacement in both forms, in units of the median ``dsymv`` of the run.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.linalg import blas

from adaptive.types import FloatArray
from adaptive.window.window import Form, Window
from benchmarks import solver
from benchmarks.measuring import interleaved, stream

SIZES = (100, 200, 500)
FORMS: tuple[Form, ...] = ("inverse", "cholesky")
_PACKAGES = ("adaptive", "benchmarks")


def solver_of(checkout: Path) -> ModuleType:
    """`benchmarks.solver` of another checkout, with the window of that checkout; this build's modules stay imported."""
    if not (checkout / "benchmarks" / "solver.py").is_file():
        raise SystemExit(f"OTHER: got {checkout}, expected the folder of a checkout, with benchmarks/solver.py")
    own = {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] in _PACKAGES}
    sys.path.insert(0, str(checkout.resolve()))
    try:
        return importlib.import_module("benchmarks.solver")
    finally:
        sys.path.pop(0)
        for name in [name for name in sys.modules if name.split(".")[0] in _PACKAGES]:
            del sys.modules[name]
        sys.modules.update(own)


class Anywhere:
    """Replaces the sample of a random slot by the stream's next, over and over."""

    def __init__(self, window: Window, X: FloatArray, y: FloatArray) -> None:
        self.window, self.X, self.y = window, X, y
        self.at, self._rng = len(window), np.random.default_rng(0)

    def __call__(self) -> None:
        k = self.at % self.y.size
        self.window.replace(int(self._rng.integers(len(self.window))), self.X[k], self.y[k])
        self.at += 1


def compare(builds: dict[str, ModuleType], n: int, repeats: int, anywhere: bool) -> list[str]:
    """Lines of a table: median and p99 in dsymv, and the median in µs, of each build and form."""
    X, y = stream(n + 4 * repeats)
    calls: dict[str, Callable[[], object]] = {}
    for name, module in builds.items():
        for form in FORMS:
            window = module.make_window(X, y, n, form)
            calls[f"{form}, {name}"] = Anywhere(window, X, y) if anywhere else module.Slide(window, X, y)
    matrix = np.asfortranarray(solver.make_window(X, y, n, "inverse").arrays.R)
    vector, out = y[:n].copy(), np.zeros(n)
    calls["dsymv"] = lambda: blas.dsymv(1.0, matrix, vector, lower=1, y=out, overwrite_y=1)
    measured = interleaved(calls, repeats)
    unit = measured["dsymv"].median
    return [
        f"| {n} | {name} | {t.median / unit:.2f} | {t.p99 / unit:.2f} | {t.median:.1f} |"
        for name, t in measured.items()
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.two_builds", description=__doc__)
    parser.add_argument("other", type=Path, metavar="OTHER", help="folder of the other checkout")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="N")
    parser.add_argument("--repeats", type=int, default=1500, help="timed replacements of each build and form")
    parser.add_argument("--anywhere", action="store_true", help="replace random slots, not the oldest sample")
    given = parser.parse_args(arguments)
    builds = {"other": solver_of(given.other), "this": solver}
    print("| N | window | median/dsymv | p99/dsymv | median, µs |\n|---|---|---|---|---|")
    for n in given.sizes:
        print("\n".join(compare(builds, n, given.repeats, given.anywhere)), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
