"""The trial of hyper-parameters on samples that they were not tuned on.

:func:`compare` puts proposal and present side by side on the samples that have come since: each is first foretold, then
learnt, by two windows that differ in nothing else. Pure and deterministic; it may run anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive import kernels
from adaptive.errors import InputError, NumericsError
from adaptive.online.kernel_window import SAME
from adaptive.tuning.config import RetuneConfig
from adaptive.types import BoolArray, FloatArray, Hyperparameters, WindowData
from adaptive.window.arrays import Status
from adaptive.window.config import WindowConfig
from adaptive.window.window import Window

#: Independent samples below which nothing is said: a deviation estimated from fewer says too little.
_FEWEST = 8.0


@dataclass(frozen=True, slots=True)
class Trial:
    """What came out of a trial.

    before_V, after_V : rms errors, V, of the present and of the proposed hyper-parameters on ``fresh`` samples.
    independent : how many independent ones those are worth. sigmas : the mean difference of the errors' sizes, in its
    own standard deviations, positive where the proposal is better.
    better : it is. open : its errors are smaller by enough, but that may be chance; more samples will tell.
    """

    fresh: int
    before_V: float
    after_V: float
    independent: float
    sigmas: float
    better: bool
    open: bool


def compare(before: WindowData, after: WindowData, hyper: Hyperparameters, config: RetuneConfig | None = None) -> Trial:
    """``hyper``, tuned on ``before``, against what was at work then, on what ``after`` holds beyond that.

    ``after``: a later state of the same window, or just what has come since; in order of age, oldest first.

    Raises InputError where nothing is fresh, NumericsError where a window can't be factored.
    """
    config = config or RetuneConfig()
    fresh = fresh_rows(before, after)
    order = np.flatnonzero(fresh)[np.argsort(-after.age[fresh], kind="stable")]
    if not order.size:
        raise InputError("after: got no sample that is not in before; wait for more")
    # Full as the learner's: whether its window had room for more can't be told from here, and hardly matters.
    capacity = before.targets_V.size
    windows = [_window(before, of, capacity) for of in (before.hyper, hyper)]
    errors = np.empty((2, order.size))
    for k, row in enumerate(order):
        x, target = np.ascontiguousarray(after.kernel[row]), float(after.targets_V[row])
        for i, window in enumerate(windows):
            errors[i, k] = target - window.predict(x)
        slot = _slot(windows[0], before.hyper, x, capacity)
        for window in windows:
            _learn(window, slot, x, target)
    rms = np.sqrt((errors**2).mean(axis=1))
    # Of the sizes, not of the squares: a few large errors would drown the many small ones.
    sigmas, independent = significance(np.abs(errors[0]) - np.abs(errors[1]))
    smaller = bool(np.isfinite(errors).all()) and bool(rms[1] < (1.0 - config.gain) * rms[0])
    better = smaller and sigmas >= config.sigmas
    # What points the other way will not come round: it would be asked until chance says yes.
    undecided = smaller and not better and sigmas >= 0.0
    return Trial(int(order.size), float(rms[0]), float(rms[1]), independent, sigmas, better, undecided)


def fresh_rows(before: WindowData, after: WindowData) -> BoolArray:
    """(n,) True for each sample of ``after`` that ``before`` does not hold."""
    known = {row.tobytes() for row in np.column_stack([before.kernel, before.targets_V])}
    rows = np.column_stack([after.kernel, after.targets_V])
    return np.array([row.tobytes() not in known for row in rows], dtype=np.bool_)


def significance(difference: FloatArray) -> tuple[float, float]:
    """(mean of ``difference`` (n,) in its own standard deviations, number of independent samples that (n,) is worth).

    Errors along a trajectory are alike for as long as the stage takes to go elsewhere. How long that is, is taken from
    their own correlation: its sum up to where the sum of two neighbouring lags is no longer positive (Geyer 1992, the
    initial positive sequence). 0 standard deviations where too few are independent to say anything.
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
    return Window.from_samples(config, data.kernel, data.targets_V, data.weights)


def _slot(window: Window, hyper: Hyperparameters, x: FloatArray, capacity: int) -> int:
    """The slot of the nearest sample, as the learner has it; one beyond the last where there is room."""
    near = kernels.gram(window.X, x[None, :], np.array(hyper.widths))[:, 0]
    nearest = int(np.argmax(near))
    return len(window) if len(window) < capacity and near[nearest] < SAME else nearest


def _learn(window: Window, slot: int, x: FloatArray, target_V: float) -> None:
    status = window.append(x, target_V) if slot == len(window) else window.replace(slot, x, target_V)
    if status != Status.ACCEPTED:
        raise NumericsError(f"window: a sample was refused ({status}); these hyper-parameters are not to be used")
