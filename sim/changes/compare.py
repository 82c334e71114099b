"""What has changed in a stage between a stretch in which a model was good and a recent one.

Both stretches are explained together: by columns that act in both (what the frozen model always lacked) and by columns
of possible causes that act in the recent one alone. A cause is named where it clearly improves the prediction of
blocks that were not used for its numbers. The model is frozen, so no learning can hide the change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray, InverseModel
from sim.changes.regression import ChangeRegression, regression_of, require_enough, solve_scaled
from sim.changes.signatures import OFFSET, Scales, Stretch

SCHEMA = 1


@dataclass(frozen=True)
class FoundChange:
    """A cause with its numbers, their 95 % intervals, and the share of the held-out squared error that it removes."""

    name: str
    alternatives: tuple[str, ...]
    numbers: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    heldout_gain: float
    text: str


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes
    ----------
    verdict : ``unchanged``; ``changed``; or ``unexplained``, where the error grew and no known cause explains it.
    changes : the causes, the most important one first.
    before_um, recent_um, left_um : rms error of the frozen model as displacement, µm, in the reference, in the recent
        stretch, and there after the causes.
    text : the result in words.
    """

    verdict: str
    changes: tuple[FoundChange, ...]
    before_um: float
    recent_um: float
    left_um: float
    text: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "text": self.text,
            "error_before_um": self.before_um,
            "error_recent_um": self.recent_um,
            "error_explained_um": self.left_um,
            "effects": [
                {
                    "name": c.name,
                    "alternatives": list(c.alternatives),
                    "parameters": c.numbers,
                    "intervals": {name: list(span) for name, span in c.intervals.items()},
                    "heldout_gain": c.heldout_gain,
                    "text": c.text,
                }
                for c in self.changes
            ],
        }


def phrase(name: str, values: FloatArray, scales: Scales) -> str:
    """A cause and its size in words."""
    first = float(values[0])
    match name:
        case "gain_drift":
            return f"gain drift, {100.0 * first:+.1f} %"
        case "thermal_drift":
            return f"thermal drift or another offset, {first:+.3g} µm"
        case "sensor_lag":
            return f"lag, {1e3 * first:+.3g} ms"
        case "payload_change":
            return f"payload on the stage, {first:+.2g} s² of 1/ω²"
        case "sensor_nonlinearity":
            return f"bend of the characteristic, {100.0 * first:+.2g} % of half the range"
        case "hysteresis_shape":
            return f"shape of the loop, {100.0 * float(np.sum(values)):+.2g} % of the motion"
        case "mains_hum":
            return f"mains hum, {float(np.hypot(*values)) / abs(scales.slope_V_per_um) * 1e3:.3g} nm"
    return name


#: Least share of the held-out squared error that a cause must remove, and by how many standard errors.
LEAST_GAIN, LEAST_SIGMAS = 0.1, 3.0
#: A cause that does as well within this share of the gain, or within so many standard errors, is an alternative.
CLOSE_SHARE, CLOSE_SIGMAS = 0.05, 2.0
#: The rms error has grown where it exceeds this multiple of the former, and by more than this share of the range.
GROWN, GROWN_SHARE = 1.3, 5e-4
MOST_CAUSES = 3


def compare(model: InverseModel, reference: Stretch, recent: Stretch) -> Comparison:
    """What has changed from ``reference`` to ``recent``, measured with the frozen ``model``.

    Raises TooFewSamples where a stretch is too short, InputError where the stage does not move in the reference.
    """
    for name, stretch in (("reference", reference), ("recent", recent)):
        require_enough(name, int(stretch.scored.sum()), stretch.dt_s)
    scales = Scales.of(reference)
    if not (np.isfinite(scales.slope_V_per_um) and scales.slope_V_per_um != 0.0 and scales.range_um > 0.0):
        raise InputError("reference: got a stretch without motion, expected a moving stage: move it")
    problem, common = regression_of(model, reference, recent, scales)
    chosen, gains = _search(problem)
    after = problem.errors(chosen)
    now = problem.recent
    # Errors before and now, without the common part as the reference alone determines it.
    first = solve_scaled(common[~now], problem.r[~now])
    flat = (problem.r - common @ first) / scales.slope_V_per_um
    before_um, recent_um = _rms(flat[~now]), _rms(flat[now])
    left_um = _rms(after[now]) / abs(scales.slope_V_per_um)
    changes = _named(problem, chosen, gains, scales)
    grown = recent_um > GROWN * before_um and recent_um - before_um > GROWN_SHARE * scales.range_um
    more = left_um > GROWN * before_um and left_um - before_um > max(GROWN_SHARE * scales.range_um, 0.1 * recent_um)
    if not grown:
        # Without a larger error, causes with small numbers only compensate one another.
        verdict, text, changes = "unchanged", "nothing has changed that this motion shows", ()
    elif changes:
        verdict, text = "changed", f"the model's error grew: {'; '.join(c.text for c in changes)}"
        text += "; and something that no known cause explains" if more else ""
    elif more:
        verdict, text = "unexplained", "the model's error grew, and no known cause explains it"
    else:
        verdict, text = "unchanged", "only an offset has changed, by too little to name it"
    return Comparison(verdict, changes, before_um, recent_um, left_um, text)


def _search(problem: ChangeRegression) -> tuple[tuple[int, ...], dict[int, float]]:
    """Choose causes one by one, the one that removes most first. Returns them, and the share that each removes.

    An offset is included from the start, because creep and temperature always move it a little. Whether it counts as a
    change is decided at the end; the shares have an entry only for causes that do.
    """
    offset = next(i for i, c in enumerate(problem.causes) if c.name == OFFSET)
    chosen: tuple[int, ...] = (offset,)
    gains: dict[int, float] = {}
    now = problem.errors(chosen)
    while len(gains) < MOST_CAUSES:
        best: tuple[float, int, FloatArray] | None = None
        for i in range(len(problem.causes)):
            if i in chosen or not _large(problem, (*chosen, i)):
                continue
            errors = problem.errors((*chosen, i))
            share, sigmas = _improvement(problem, now, errors)
            if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and (best is None or share > best[0]):
                best = share, i, errors
        if best is None:
            break
        gains[best[1]] = best[0]
        chosen, now = (*chosen, best[1]), best[2]
    share, sigmas = _improvement(problem, problem.errors(chosen[1:]), now)
    if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (*chosen[1:], offset)):
        gains[offset] = share
    return (chosen, gains) if gains else _alone(problem, chosen)


def _alone(problem: ChangeRegression, otherwise: tuple[int, ...]) -> tuple[tuple[int, ...], dict[int, float]]:
    """The single cause that explains most without an offset, for motion too short or narrow to separate the two."""
    none = problem.errors(())
    best: tuple[float, int] | None = None
    for i in range(len(problem.causes)):
        share, sigmas = _improvement(problem, none, problem.errors((i,)))
        good = share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (i,))
        if good and (best is None or share > best[0]):
            best = share, i
    return ((best[1],), {best[1]: best[0]}) if best is not None else (otherwise, {})


def _improvement(problem: ChangeRegression, before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Removed share of the held-out squared error, and by how many standard errors."""
    base = problem.by_block(before)
    won = base - problem.by_block(after)
    share = float(won.sum() / max(float(base.sum()), 1e-30))
    return share, float(won.sum() / max(float(np.std(won)) * np.sqrt(won.size), 1e-30))


def _large(problem: ChangeRegression, chosen: tuple[int, ...]) -> bool:
    """Whether a number of the last of ``chosen`` exceeds the least size that counts as a change."""
    cause = problem.causes[chosen[-1]]
    beta, _, _ = problem.fit(chosen)
    return bool(np.max(np.abs(beta[-len(cause.numbers) :])) > cause.least)


def _rivals(problem: ChangeRegression, chosen: tuple[int, ...], place: int) -> tuple[str, ...]:
    """Causes that do as well as ``chosen[place]`` within the accuracy of these blocks."""
    rest = chosen[:place] + chosen[place + 1 :]
    mine, less = problem.by_block(problem.errors(chosen)), problem.by_block(problem.errors(rest))
    gain = float(less.sum() - mine.sum())
    names = []
    for i, cause in enumerate(problem.causes):
        if i in chosen:
            continue
        lost = problem.by_block(problem.errors((*rest, i))) - mine
        sigmas = float(lost.sum() / max(float(np.std(lost)) * np.sqrt(lost.size), 1e-30))
        if lost.sum() < CLOSE_SHARE * gain or (sigmas < CLOSE_SIGMAS and lost.sum() < 0.25 * gain):
            names.append(cause.name)
    return tuple(names)


def _named(
    problem: ChangeRegression, chosen: tuple[int, ...], gains: dict[int, float], scales: Scales
) -> tuple[FoundChange, ...]:
    beta, sigma, _ = problem.fit(chosen)
    at = problem.common.shape[1]
    out = []
    for place, i in enumerate(chosen):
        cause = problem.causes[i]
        k = len(cause.numbers)
        values, spans = beta[at : at + k], 1.96 * sigma[at : at + k]
        at += k
        if i not in gains:
            continue
        numbers = {name: float(v) for name, v in zip(cause.numbers, values, strict=True)}
        intervals = {n: (float(v - s), float(v + s)) for n, v, s in zip(cause.numbers, values, spans, strict=True)}
        others = tuple(dict.fromkeys((*cause.alternatives, *_rivals(problem, chosen, place))))
        text = phrase(cause.name, values, scales)
        if others:
            text += f" (or {', '.join(others)})"
        out.append(FoundChange(cause.name, others, numbers, intervals, gains[i], text))
    return tuple(sorted(out, key=lambda c: -c.heldout_gain))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")
