"""Hyper-parameters from the live window, proposed by the evidence; ``adaptive.tuning.trial`` tries them.

:func:`propose` minimises J2 (``adaptive.tuning.evidence``) over log gamma and all log widths, with its analytic
gradients,
from what is at work and from several starts around it. Pure and deterministic; it may run anywhere, and takes up to
seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from adaptive.errors import InputError, NumericsError
from adaptive.tuning.config import RetuneConfig
from adaptive.tuning.evidence import Problem, evaluate, problem
from adaptive.tuning.trial import Trial, compare, fresh_rows
from adaptive.types import FloatArray, Hyperparameters, WindowData

__all__ = ["Proposal", "RetuneConfig", "Trial", "compare", "fresh_rows", "propose"]

#: Value of a point that can't be evaluated: far above all others, finite for the line search.
_REFUSED = 1e12
#: ``search(data, start, low, high)``: (s, 1 + d) starts worth a descent, best first, in logarithms of gamma and widths.
Search = Callable[[Problem, FloatArray, FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Proposal:
    """``hyper`` with its J2, that of what is at work (both on all samples), and how many evaluations it took."""

    hyper: Hyperparameters
    J2: float
    J2_before: float
    evaluations: int


def bounds_of(hyper: Hyperparameters, config: RetuneConfig) -> tuple[FloatArray, FloatArray]:
    """(1 + d,) least and greatest logarithms of gamma and widths that are searched."""
    centre = _logarithms(hyper)
    reach = np.log(np.array([config.gamma_reach, *[config.width_reach] * len(hyper.widths)]))
    floor = np.log(np.array([config.gamma_range[0], *[config.width_range[0]] * len(hyper.widths)]))
    ceiling = np.log(np.array([config.gamma_range[1], *[config.width_range[1]] * len(hyper.widths)]))
    # What is at work lies inside, wherever it came from.
    return np.minimum(np.maximum(centre - reach, floor), centre), np.maximum(
        np.minimum(centre + reach, ceiling), centre
    )


def propose(data: WindowData, config: RetuneConfig | None = None, search: Search | None = None) -> Proposal:
    """The best hyper-parameters by the evidence of ``data``; what is at work where nothing is better.

    ``search`` gives starts in place of a fixed pattern around the present. Raises InputError on too few samples or
    targets that are all equal, NumericsError where not even what is at work can be evaluated.
    """
    config = config or RetuneConfig()
    n = data.targets_V.shape[0]
    if n < config.least:
        raise InputError(f"data: got {n} samples, expected at least {config.least} to tune on; let the window fill")
    centre, scale = float(np.mean(data.targets_V)), float(np.std(data.targets_V))
    if not scale > 0.0:
        raise InputError("data: all targets are equal, nothing can be inferred from them; excite the stage")
    # Neither J2's differences nor its optimum depend on the targets' scale.
    whole = problem(data.kernel, (data.targets_V - centre) / scale, data.weights)
    part = whole.subset(_spread_rows(n, config.rows))
    here = _logarithms(data.hyper)
    low, high = bounds_of(data.hyper, config)
    objective, partial = _Objective(whole), _Objective(part)
    before, _ = objective(here)
    if before >= _REFUSED:
        raise NumericsError("evidence: what is at work can't be evaluated on the window's samples")
    starts = pattern(here, low, high, config.starts) if search is None else search(part, here, low, high)
    found = [_descend(partial, start, low, high, config.iterations) for start in starts[: config.starts]]
    # Of the descents on a part, the best goes on with all samples, beside what is at work.
    first = min(found, key=lambda point: partial(point)[0], default=here)
    ends = [here, *(_descend(objective, start, low, high, config.iterations) for start in (first, here))]
    values = [objective(end)[0] for end in ends]
    best = int(np.argmin(values))
    hyper = data.hyper if best == 0 else _hyper(ends[best])
    return Proposal(hyper, values[best], before, objective.calls + partial.calls)


def pattern(here: FloatArray, low: FloatArray, high: FloatArray, count: int) -> FloatArray:
    """(count, 1 + d) starts: what is at work, then points spread evenly over the box (a Kronecker sequence)."""
    # Powers of the root of x^(d+1) = x + 1 (the plastic numbers) fill a box of any dimension evenly.
    d, root = here.size, 2.0
    for _ in range(50):
        root = (1.0 + root) ** (1.0 / (d + 1))
    steps = np.power(root, -np.arange(1.0, d + 1.0))
    spread = np.mod(0.5 + np.outer(np.arange(1, count), steps), 1.0)
    return np.vstack([here, low + spread * (high - low)])


class _Objective:
    """J2 with its gradient at (1 + d,) logarithms, calls counted; a refusal where it can't be evaluated."""

    def __init__(self, data: Problem) -> None:
        self.data = data
        self.calls = 0

    def __call__(self, theta: FloatArray) -> tuple[float, FloatArray]:
        self.calls += 1
        try:
            found = evaluate(self.data, float(np.exp(theta[0])), np.exp(theta[1:]))
        except NumericsError:
            return _REFUSED, np.zeros(theta.size)
        if not (np.isfinite(found.J2) and np.isfinite(found.J2_gradient).all()):
            return _REFUSED, np.zeros(theta.size)
        return found.J2, found.J2_gradient


def _descend(
    objective: _Objective, start: FloatArray, low: FloatArray, high: FloatArray, iterations: int
) -> FloatArray:
    options = {"maxiter": iterations, "maxfun": 3 * iterations, "ftol": 1e-9, "gtol": 1e-3}
    box = list(zip(low, high, strict=True))
    start = np.clip(start, low, high)
    found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=box, options=options)
    return np.asarray(np.clip(found.x, low, high), dtype=np.float64)


def _logarithms(hyper: Hyperparameters) -> FloatArray:
    return np.log(np.array([hyper.gamma, *hyper.widths], dtype=np.float64))


def _hyper(theta: FloatArray) -> Hyperparameters:
    return Hyperparameters(float(np.exp(theta[0])), tuple(float(w) for w in np.exp(theta[1:])))


def _spread_rows(n: int, rows: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, n - 1, min(rows, n)).round().astype(np.int64))
