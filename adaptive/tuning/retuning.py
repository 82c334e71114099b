"""Re-tuning of a learner's window: propose hyper-parameters by the evidence, and compare them on fresh samples.

`propose` minimises J2 (``adaptive.tuning.evidence``) over log gamma and all log widths, from the present values and
from several starts around them. `compare` then lets two windows, one with the present and one with the proposed values,
predict and learn the samples that have come since. Both are pure and deterministic, and take up to seconds, so that a
background process can run them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.lssvm import one_thread
from dehyst.adaptive.online.kernel_window import SAME
from dehyst.adaptive.tuning.config import RetuneConfig
from dehyst.adaptive.tuning.evidence import evidence_samples
from dehyst.adaptive.tuning.search import REFUSED, CountedEvidence, descend
from dehyst.adaptive.types import BoolArray, FloatArray, Hyperparameters, WindowData
from dehyst.adaptive.window.arrays import Status
from dehyst.adaptive.window.window import Window, WindowConfig

#: Fewest independent samples for a comparison: the standard deviation of fewer is too uncertain.
_FEWEST = 8.0

# --- Propose.


@dataclass(frozen=True, slots=True)
class Proposal:
    """``hyper`` with its J2 and that of the present values (both on all samples), and the number of evaluations."""

    hyper: Hyperparameters
    J2: float
    J2_before: float
    evaluations: int


def bounds_of(hyper: Hyperparameters, config: RetuneConfig) -> tuple[FloatArray, FloatArray]:
    """(1 + d,) smallest and largest logarithms of gamma and widths to search; the present values are inside."""
    centre = _logarithms(hyper)
    reach = np.log(np.array([config.gamma_reach, *[config.width_reach] * len(hyper.widths)]))
    floor = np.log(np.array([config.gamma_range[0], *[config.width_range[0]] * len(hyper.widths)]))
    ceiling = np.log(np.array([config.gamma_range[1], *[config.width_range[1]] * len(hyper.widths)]))
    return np.minimum(np.maximum(centre - reach, floor), centre), np.maximum(
        np.minimum(centre + reach, ceiling), centre
    )


@one_thread
def propose(data: WindowData, config: RetuneConfig | None = None) -> Proposal:
    """The hyper-parameters with the best evidence on ``data``, or the present ones where none are better.

    With one BLAS thread, as `adaptive.tuning.search.infer`. Raises InputError on too few samples or targets that are
    all equal, NumericsError where the present values cannot be evaluated.
    """
    config = config or RetuneConfig()
    n = data.targets_V.shape[0]
    if n < config.least:
        raise InputError(f"data: got {n} samples, expected at least {config.least} to tune on; let the window fill")
    centre, scale = float(np.mean(data.targets_V)), float(np.std(data.targets_V))
    if not scale > 0.0:
        raise InputError("data: all targets are equal, nothing can be inferred from them; excite the stage")
    # Neither the differences of J2 nor its optimum depend on the scale of the targets.
    whole = evidence_samples(data.kernel, (data.targets_V - centre) / scale)
    part = whole.subset(_spread_rows(n, config.rows))
    here = _logarithms(data.hyper)
    low, high = bounds_of(data.hyper, config)
    objective, partial = CountedEvidence(whole), CountedEvidence(part)
    before, _ = objective.J2(here)
    if before >= REFUSED:
        raise NumericsError(
            "evidence: the present hyper-parameters cannot be evaluated on the window's samples; narrow gamma_range"
        )
    starts = pattern(here, low, high, config.starts)
    found = [descend(partial.J2, start, low, high, config.iterations, 1e-9) for start in starts]
    # The best of the descents on a part continues on all samples, beside the present values.
    first = min(found, key=lambda point: partial.J2(point)[0], default=here)
    ends = [here, *(descend(objective.J2, start, low, high, config.iterations, 1e-9) for start in (first, here))]
    values = [objective.J2(end)[0] for end in ends]
    best = int(np.argmin(values))
    hyper = data.hyper if best == 0 else _hyper(ends[best])
    return Proposal(hyper, values[best], before, objective.calls + partial.calls)


def pattern(here: FloatArray, low: FloatArray, high: FloatArray, count: int) -> FloatArray:
    """(count, 1 + d) starts: the present values, then points spread evenly over the box (a Kronecker sequence)."""
    # Powers of the root of x^(d+1) = x + 1 (the plastic numbers) fill a box of any dimension evenly.
    d, root = here.size, 2.0
    for _ in range(50):
        root = (1.0 + root) ** (1.0 / (d + 1))
    steps = np.power(root, -np.arange(1.0, d + 1.0))
    spread = np.mod(0.5 + np.outer(np.arange(1, count), steps), 1.0)
    return np.vstack([here, low + spread * (high - low)])


def _logarithms(hyper: Hyperparameters) -> FloatArray:
    return np.log(np.array([hyper.gamma, *hyper.widths], dtype=np.float64))


def _hyper(theta: FloatArray) -> Hyperparameters:
    return Hyperparameters(float(np.exp(theta[0])), tuple(float(w) for w in np.exp(theta[1:])))


def _spread_rows(n: int, rows: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, n - 1, min(rows, n)).round().astype(np.int64))


# --- Compare.


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of `compare`.

    before_V, after_V : rms errors, V, of the present and of the proposed hyper-parameters on ``fresh`` samples.
    independent : number of independent samples that these are worth. sigmas : mean difference of the errors' sizes,
    in its own standard deviations, positive where the proposal is better.
    better : the proposal is significantly better. open : its errors are smaller by enough, but not significantly;
    compare again with more samples.
    """

    fresh: int
    before_V: float
    after_V: float
    independent: float
    sigmas: float
    better: bool
    open: bool


def compare(
    before: WindowData, after: WindowData, hyper: Hyperparameters, config: RetuneConfig | None = None
) -> Comparison:
    """Compare ``hyper``, tuned on ``before``, with the hyper-parameters of ``before`` on fresh samples of ``after``.

    ``after`` : a later state of the same window, or only the samples since. They are taken oldest first; each is
    predicted, then learnt, by two windows that differ in the hyper-parameters only.

    Raises InputError where no sample is fresh, NumericsError where a window cannot be factored.
    """
    config = config or RetuneConfig()
    fresh = fresh_rows(before, after)
    order = np.flatnonzero(fresh)[np.argsort(-after.age[fresh], kind="stable")]
    if not order.size:
        raise InputError("after: got no sample that is not in before; wait for more")
    # Taken as full: whether the learner's window had free slots is not known here, and matters little.
    capacity = before.targets_V.size
    windows = [_window(before, of, capacity) for of in (before.hyper, hyper)]
    errors = np.empty((2, order.size))
    for k, row in enumerate(order):
        x, target = np.ascontiguousarray(after.kernel[row]), float(after.targets_V[row])
        for i, window in enumerate(windows):
            errors[i, k] = target - window.predict(x)
        slot = _slot(windows[0], x)
        for window in windows:
            _learn(window, slot, x, target)
    rms = np.sqrt((errors**2).mean(axis=1))
    # Sizes, not squares: a few large errors would hide many small ones.
    sigmas, independent = significance(np.abs(errors[0]) - np.abs(errors[1]))
    smaller = bool(np.isfinite(errors).all()) and bool(rms[1] < (1.0 - config.gain) * rms[0])
    better = smaller and sigmas >= config.sigmas
    # Do not compare a losing proposal again: repeated looks inflate false positives.
    undecided = smaller and not better and sigmas >= 0.0
    return Comparison(int(order.size), float(rms[0]), float(rms[1]), independent, sigmas, better, undecided)


def fresh_rows(before: WindowData, after: WindowData) -> BoolArray:
    """(n,) True for each sample of ``after`` that ``before`` does not hold."""
    known = {row.tobytes() for row in np.column_stack([before.kernel, before.targets_V])}
    rows = np.column_stack([after.kernel, after.targets_V])
    return np.array([row.tobytes() not in known for row in rows], dtype=np.bool_)


def significance(difference: FloatArray) -> tuple[float, float]:
    """(mean of ``difference`` (n,) in its own standard deviations, number of independent samples that (n,) is worth).

    Errors along a trajectory are correlated. The number of independent ones follows from the sum of their
    autocorrelation up to where two neighbouring lags no longer sum to a positive value (Geyer 1992, initial positive
    sequence). 0 standard deviations where fewer than eight are independent.
    """
    n = difference.size
    centred = difference - difference.mean()
    variance = float(centred @ centred) / n
    if n < _FEWEST or not variance > 0.0 or not np.isfinite(variance):
        return 0.0, float(n)
    total = 1.0
    for lag in range(1, n - 1, 2):
        pair = float(centred[:-lag] @ centred[lag:] + centred[: -lag - 1] @ centred[lag + 1 :]) / (n * variance)
        if not pair > 0.0:
            break
        total += 2.0 * pair
    independent = n / total
    if independent < _FEWEST:
        return 0.0, independent
    return float(difference.mean() / np.sqrt(variance / (independent - 1.0))), independent


def _window(data: WindowData, hyper: Hyperparameters, capacity: int) -> Window:
    config = WindowConfig(capacity, tuple(hyper.widths), hyper.gamma)
    return Window.from_samples(config, data.kernel, data.targets_V)


def _slot(window: Window, x: FloatArray) -> int:
    """The slot that the learner would take: that of the nearest sample, or a free one where none is close."""
    nearest, value = window.nearest(x)
    return len(window) if not window.full and value < SAME else nearest


def _learn(window: Window, slot: int, x: FloatArray, target_V: float) -> None:
    status = window.append(x, target_V) if slot == len(window) else window.replace(slot, x, target_V)
    if status != Status.ACCEPTED:
        raise NumericsError(f"window: refused a sample ({status.name}); these hyper-parameters cannot be used")
