"""Search for the hyper-parameters with the best evidence: level 2, (2.35), for gamma; level 3, (2.36), or the joint
optimum for the kernel widths.

The evidence has several optima, and a part of the samples may not show the deepest one. Therefore a coarse scan checks
the answer; its widths go from the distance of neighbouring samples to their extent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.lssvm import one_thread
from dehyst.adaptive.tuning.evidence import Evidence, EvidenceSamples, evaluate
from dehyst.adaptive.types import FloatArray

#: The chapter's start comes first; the others are there because the evidence has several optima.
STARTS: tuple[tuple[float, float], ...] = ((100.0, 1.0), (1e4, 0.4), (1e5, 2.5), (1e3, 6.0))


@dataclass(frozen=True, slots=True)
class InferenceConfig:
    """Settings of the search.

    Attributes
    ----------
    method : ``joint`` minimises J2 over gamma and all widths at once; ``three_level`` is the chapter's: J3 over
        the widths, with gamma at the optimum of J2 for each of them.
    ard : one width a feature; otherwise one for all.
    starts : (gamma, sigma) to start from, both positive.
    gamma_range, width_range : bounds; the upper bound on gamma also bounds the condition number.
    search_rows : starts are compared on at most this many evenly taken samples, the best goes on with all.
    iterations : at most, of each descent.
    scan_rows : rows, evenly taken, of the coarse scan that the answer is checked against; 0 for no check.
    """

    method: Literal["joint", "three_level"] = "joint"
    ard: bool = True
    starts: Sequence[tuple[float, float]] = STARTS
    gamma_range: tuple[float, float] = (1e-2, 1e8)
    width_range: tuple[float, float] = (0.02, 50.0)
    search_rows: int = 160
    iterations: int = 40
    scan_rows: int = 500

    def __post_init__(self) -> None:
        if self.method not in ("joint", "three_level"):
            raise InputError(f"method: got {self.method!r}, expected 'joint' or 'three_level'")
        if not self.starts or any(not (g > 0 and s > 0) for g, s in self.starts):
            raise InputError(f"starts: got {self.starts!r}, expected at least one pair (gamma, sigma), both positive")
        for name, (low, high) in (("gamma_range", self.gamma_range), ("width_range", self.width_range)):
            if not 0 < low < high:
                raise InputError(f"{name}: got {(low, high)}, expected 0 < low < high")


@dataclass(frozen=True, slots=True)
class Inference:
    """Result: ``best`` with its gamma and widths, the optimum from each start in ``tried``, number of evaluations."""

    best: Evidence
    tried: tuple[Evidence, ...]
    evaluations: int


class CountedEvidence:
    """`evaluate` on fixed samples: counts its calls, and gives no value where a factorisation fails."""

    def __init__(self, data: EvidenceSamples) -> None:
        self.data = data
        self.calls = 0

    def __call__(self, gamma: float, widths: FloatArray, third_level: bool = False) -> Evidence | None:
        """Evidence at one pair of gamma and widths (d,); None where it is not finite."""
        self.calls += 1
        try:
            found = evaluate(self.data, gamma, widths, third_level)
        except NumericsError:
            return None
        return found if np.isfinite(found.J3) and np.isfinite(found.J2_gradient).all() else None

    def J2(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """J2 with its gradient at (1 + d,) logarithms of gamma and all widths; REFUSED and 0 where it has no value."""
        found = self(float(np.exp(theta[0])), np.exp(theta[1:]))
        return (REFUSED, np.zeros(theta.size)) if found is None else (found.J2, found.J2_gradient)


#: Value of a point that cannot be evaluated: far above all others, finite for the line search.
REFUSED = 1e12
#: A function with its gradient.
Objective = Callable[[FloatArray], tuple[float, FloatArray]]


def descend(
    objective: Objective, start: FloatArray, low: FloatArray, high: FloatArray, iterations: int, tolerance: float
) -> FloatArray:
    """Local minimum in a box, by L-BFGS-B from ``start``; all (k,). ``tolerance``: relative change of the last step."""
    options = {"maxiter": iterations, "maxfun": 3 * iterations, "ftol": tolerance, "gtol": 1e-3}
    box = list(zip(low, high, strict=True))
    found = minimize(objective, np.clip(start, low, high), jac=True, method="L-BFGS-B", bounds=box, options=options)
    return np.asarray(np.clip(found.x, low, high), dtype=np.float64)


@one_thread
def infer(data: EvidenceSamples, config: InferenceConfig | None = None) -> Inference:
    """Find gamma and the kernel widths. Deterministic, with one BLAS thread whatever the environment says.

    Raises
    ------
    NumericsError : no start could be evaluated.
    """
    config = config or InferenceConfig()
    few, whole = CountedEvidence(data.subset(_evenly(data.size, config.search_rows))), CountedEvidence(data)
    count = data.dimension if config.ard else 1
    tried = []
    for gamma, sigma in config.starts:
        start = np.log(np.concatenate([[gamma], np.full(count, sigma)]))
        found = _descend(few, start, config, "joint")
        if found is not None:
            tried.append(found)
    if not tried:
        raise NumericsError("evidence: no start could be evaluated; lower gamma_range or drop duplicated samples")
    tried.sort(key=lambda e: e.J2)
    best = tried[0]
    polished = _descend(whole, _logarithms(best, config), config, "joint")
    scanned = CountedEvidence(data.subset(_evenly(data.size, config.scan_rows)))
    if polished is not None and config.scan_rows:
        for start in _scan(scanned, polished, config):
            other = _descend(whole, start, config, "joint")
            if other is not None and other.J2 < polished.J2 - _DEEPER:
                polished = other
    # The optimum of J3 lies close to the joint one, which takes a third of the evaluations to approach.
    if polished is not None and config.method == "three_level":
        polished = _descend(whole, _logarithms(polished, config), config, "three_level")
    if polished is None:
        raise NumericsError(
            "evidence: the optimum of a part of the samples cannot be evaluated on all; lower gamma_range"
        )
    return Inference(polished, tuple(tried), few.calls + whole.calls + scanned.calls)


# --- The check of an answer against a coarse scan.

#: Factor between two widths of the scan, and most of them; the gammas of the scan.
_STEP, _MOST_WIDTHS = 1.5, 16
_GAMMAS = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7)
#: Most descents from the scan, and by how much J2 must fall to be another optimum.
_DESCENTS, _DEEPER = 2, 0.5


def length_scales(X: FloatArray, ard: bool) -> tuple[FloatArray, float, float]:
    """(scale of each feature (d,), least and largest width in these scales that the samples (n, d) can tell apart).

    The scale of a feature is its standard deviation with ``ard``, else 1. The least width is the median distance of a
    sample to its nearest neighbour, the largest twice the extent.
    """
    spread = np.std(X, axis=0)
    scale = np.where(spread > 0.0, spread, 1.0) if ard else np.ones(X.shape[1])
    scaled = X / scale
    squared = np.sum((scaled[:, None, :] - scaled[None, :, :]) ** 2, axis=2)
    largest = 2.0 * float(np.sqrt(squared.max()))
    # Samples that coincide tell nothing of the distance.
    squared[squared == 0.0] = np.inf
    near = np.sqrt(squared.min(axis=1))
    near = near[np.isfinite(near)]
    return scale, float(np.median(near)) if near.size else largest, largest


def _scan(value: CountedEvidence, found: Evidence, config: InferenceConfig) -> list[FloatArray]:
    """Logarithms of gamma and widths at the deepest valleys of a coarse scan, without the one that ``found`` is in."""
    scale, least, largest = length_scales(value.data.X, config.ard)
    count = int(np.clip(np.ceil(np.log(max(largest / least, 1.0)) / np.log(_STEP)) + 1, 1, _MOST_WIDTHS))
    widths = [np.clip(factor * scale, *config.width_range) for factor in np.geomspace(least, largest, count)]
    gammas = [gamma for gamma in _GAMMAS if config.gamma_range[0] <= gamma <= config.gamma_range[1]]
    gammas = gammas or [float(np.sqrt(np.prod(config.gamma_range)))]
    J2 = np.full((count + 2, len(gammas) + 2), np.inf)
    for i, width in enumerate(widths):
        for j, gamma in enumerate(gammas):
            if i and np.array_equal(width, widths[i - 1]):
                continue  # at a bound of the widths
            at = value(gamma, width)
            J2[i + 1, j + 1] = np.inf if at is None else at.J2
    mine = np.log(found.gamma), float(np.mean(np.log(found.widths / scale)))
    valleys = []
    for i in range(count):
        for j, gamma in enumerate(gammas):
            depth = J2[i + 1, j + 1]
            if not np.isfinite(depth) or depth > J2[i : i + 3, j : j + 3].min():
                continue
            here = np.log(gamma), float(np.mean(np.log(widths[i] / scale)))
            if abs(here[0] - mine[0]) > np.log(10.0) or abs(here[1] - mine[1]) > np.log(_STEP):
                own = widths[i] if config.ard else widths[i][:1]
                valleys.append((depth, np.log(np.concatenate([[gamma], own]))))
    valleys.sort(key=lambda valley: valley[0])
    return [theta for _, theta in valleys[:_DESCENTS]]


def _evenly(size: int, most: int) -> NDArray[np.int64]:
    """At most ``most`` of ``size`` rows, evenly taken."""
    rows: NDArray[np.int64] = np.unique(np.linspace(0, size - 1, min(most, size)).round().astype(np.int64))
    return rows


def _logarithms(found: Evidence, config: InferenceConfig) -> FloatArray:
    widths = found.widths if config.ard else found.widths[:1]
    return np.asarray(np.log(np.concatenate([[found.gamma], widths])), dtype=np.float64)


def _spread(widths: FloatArray, dimension: int) -> FloatArray:
    return widths if widths.size == dimension else np.full(dimension, float(widths[0]))


def _collect(gradient: FloatArray, count: int) -> FloatArray:
    return gradient if gradient.size == count else np.array([np.sum(gradient)])


def _descend(value: CountedEvidence, start: FloatArray, config: InferenceConfig, method: str) -> Evidence | None:
    """Evidence of the local optimum from ``start``, logarithms of gamma and widths; None where none has a value."""
    best: list[Evidence] = []
    count, d = start.size - 1, value.data.dimension
    log_gamma, log_width = np.log(config.gamma_range), np.log(config.width_range)
    last_gamma = float(np.exp(start[0]))

    def joint(theta: FloatArray) -> tuple[float, FloatArray]:
        found = value(float(np.exp(theta[0])), _spread(np.exp(theta[1:]), d))
        if found is None:
            return REFUSED, np.zeros(theta.size)
        if not best or found.J2 < best[0].J2:
            best[:] = [found]
        return found.J2, np.concatenate([found.J2_gradient[:1], _collect(found.J2_gradient[1:], count)])

    def third(theta: FloatArray) -> tuple[float, FloatArray]:
        nonlocal last_gamma
        found = level_two(value, last_gamma, _spread(np.exp(theta), d), config, True)
        if found is None:
            return REFUSED, np.zeros(theta.size)
        last_gamma = found.gamma
        if not best or found.J3 < best[0].J3:
            best[:] = [found]
        return found.J3, _collect(found.J3_gradient, count)

    low, high = np.full(count, log_width[0]), np.full(count, log_width[1])
    if method == "joint":
        low, high = np.concatenate([log_gamma[:1], low]), np.concatenate([log_gamma[1:], high])
        descend(joint, start, low, high, config.iterations, 1e-10)
    else:
        descend(third, start[1:], low, high, config.iterations, 1e-10)
    return best[0] if best else None


def level_two(
    value: CountedEvidence, gamma: float, widths: FloatArray, config: InferenceConfig, third_level: bool
) -> Evidence | None:
    """Level 2: gamma at the optimum of J2 for given widths (d,), or the bound of its range that is nearest to it.

    Root of dJ2/dlog gamma near ``gamma`` by safeguarded secant steps in log gamma. None where it cannot be evaluated.
    """
    low, high = np.log(config.gamma_range)
    at = float(np.clip(np.log(gamma), low, high))
    below: float | None = None  # slope negative here: the optimum lies above
    above: float | None = None
    previous: tuple[float, float] | None = None
    found: Evidence | None = None
    for _ in range(30):
        found = value(float(np.exp(at)), widths)
        if found is None:
            return None
        slope = float(found.J2_gradient[0])
        if abs(slope) < 3e-7 * value.data.size or (slope > 0 and at == low) or (slope < 0 and at == high):
            break
        if slope < 0:
            below = at
        else:
            above = at
        step = -np.sign(slope) * 1.0
        if previous is not None and slope != previous[1]:
            secant = -slope * (at - previous[0]) / (slope - previous[1])
            if np.sign(secant) == np.sign(step):
                step = float(np.clip(secant, -3.0, 3.0))
        previous = (at, slope)
        target = float(np.clip(at + step, low, high))
        if below is not None and above is not None and not min(below, above) < target < max(below, above):
            target = 0.5 * (below + above)
        if abs(target - at) < 1e-12:
            break
        at = target
    if found is not None and third_level:
        found = value(found.gamma, widths, True)
    return found
