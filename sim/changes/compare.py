"""What has changed between a stretch in which a model was good and a recent one: causes, by what they explain.

Both stretches are explained jointly: what the frozen model never held (common columns, over both) and what has come
since (the causes' columns, over the recent one alone). A cause is named where blocks of data that were not used
for its numbers become clearly better with it. The model is frozen: nothing that has learnt the change away hides it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray, InverseModel
from sim.changes.columns import OFFSET, Scales, Stretch
from sim.changes.regression import Problem, enough, problem_of, solve_scaled

# --- What a comparison of two stretches has found: the causes with their numbers, and the words for them.


SCHEMA = 1


@dataclass(frozen=True)
class Change:
    """One cause: its numbers with 95 % intervals, and the share of the held-out squared error that it removed."""

    name: str
    alternatives: tuple[str, ...]
    numbers: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    heldout_gain: float
    text: str


@dataclass(frozen=True)
class Comparison:
    """What has changed. Errors are rms of the frozen model, as displacement, µm.

    ``verdict``: ``unchanged``; ``changed``, by ``changes``; ``unexplained``: grown, and no cause known explains it.
    ``gain_t_s``, ``gain``: the stage's relative gain over time, stretch by stretch, against the reference.
    """

    verdict: str
    changes: tuple[Change, ...]
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
    """A cause as a person would say it, with its size."""
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


#: A cause must remove this share of the held-out squared error, by so many standard errors.
LEAST_GAIN, LEAST_SIGMAS = 0.1, 3.0
#: One that does as well within this share of the gain, or within so many standard errors, is an alternative.
CLOSE_SHARE, CLOSE_SIGMAS = 0.05, 2.0
#: The error has grown where it is this much larger than before (rms), and more than this share of the range.
GROWN, GROWN_SHARE = 1.3, 5e-4
MOST_CAUSES = 3


def compare(model: InverseModel, reference: Stretch, recent: Stretch) -> Comparison:
    """What has changed from ``reference`` to ``recent``, seen by ``model`` frozen.

    Raises TooFewSamples where a stretch is too short, InputError where the reference does not move.
    """
    for name, stretch in (("reference", reference), ("recent", recent)):
        enough(name, int(stretch.scored.sum()), stretch.dt_s)
    scales = Scales.of(reference)
    if not (np.isfinite(scales.slope_V_per_um) and scales.slope_V_per_um != 0.0 and scales.range_um > 0.0):
        raise InputError("reference: got a stretch that does not move, expected motion: move the stage")
    problem, common = problem_of(model, reference, recent, scales)
    chosen, gains = _search(problem)
    after = problem.errors(chosen)
    now = problem.recent
    # What the error was and has become: with the common part as the reference alone knows it.
    first = solve_scaled(common[~now], problem.r[~now])
    flat = (problem.r - common @ first) / scales.slope_V_per_um
    before_um, recent_um = _rms(flat[~now]), _rms(flat[now])
    left_um = _rms(after[now]) / abs(scales.slope_V_per_um)
    changes = _named(problem, chosen, gains, scales)
    grown = recent_um > GROWN * before_um and recent_um - before_um > GROWN_SHARE * scales.range_um
    more = left_um > GROWN * before_um and left_um - before_um > max(GROWN_SHARE * scales.range_um, 0.1 * recent_um)
    if not grown:
        # Small numbers that only trade places with one another are no news.
        verdict, text, changes = "unchanged", "nothing has changed that this motion shows", ()
    elif changes:
        verdict, text = "changed", f"the model's error grew: {'; '.join(c.text for c in changes)}"
        text += "; and something that no known cause explains" if more else ""
    elif more:
        verdict, text = "unexplained", "the model's error grew, and no known cause explains it"
    else:
        verdict, text = "unchanged", "no more has changed than an offset too small for a name"
    return Comparison(verdict, changes, before_um, recent_um, left_um, text)


def _search(problem: Problem) -> tuple[tuple[int, ...], dict[int, float]]:
    """Causes one after the other, the one that removes most first; and the share that each removed.

    An offset is in from the start, because creep and warmth always move one a little; whether it is worth a name
    is asked at the end. ``gains`` has an entry for each cause that is.
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
            share, sigmas = _won(problem, now, errors)
            if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and (best is None or share > best[0]):
                best = share, i, errors
        if best is None:
            break
        gains[best[1]] = best[0]
        chosen, now = (*chosen, best[1]), best[2]
    share, sigmas = _won(problem, problem.errors(chosen[1:]), now)
    if share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (*chosen[1:], offset)):
        gains[offset] = share
    return (chosen, gains) if gains else _alone(problem, chosen)


def _alone(problem: Problem, otherwise: tuple[int, ...]) -> tuple[tuple[int, ...], dict[int, float]]:
    """The one cause that explains most without an offset beside it, where a short or narrow motion mixes the two up."""
    none = problem.errors(())
    best: tuple[float, int] | None = None
    for i in range(len(problem.causes)):
        share, sigmas = _won(problem, none, problem.errors((i,)))
        good = share > LEAST_GAIN and sigmas > LEAST_SIGMAS and _large(problem, (i,))
        if good and (best is None or share > best[0]):
            best = share, i
    return ((best[1],), {best[1]: best[0]}) if best is not None else (otherwise, {})


def _won(problem: Problem, before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Share of the held-out squared error that is gone, and by how many standard errors."""
    base = problem.by_block(before)
    won = base - problem.by_block(after)
    share = float(won.sum() / max(float(base.sum()), 1e-30))
    return share, float(won.sum() / max(float(np.std(won)) * np.sqrt(won.size), 1e-30))


def _large(problem: Problem, chosen: tuple[int, ...]) -> bool:
    """Whether the last of ``chosen`` has a number beyond the size below which nobody would call it a change."""
    cause = problem.causes[chosen[-1]]
    beta, _, _ = problem.fit(chosen)
    return bool(np.max(np.abs(beta[-len(cause.numbers) :])) > cause.least)


def _rivals(problem: Problem, chosen: tuple[int, ...], place: int) -> tuple[str, ...]:
    """Causes that do as well in the place of ``chosen[place]``, within what these blocks can tell."""
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


def _named(problem: Problem, chosen: tuple[int, ...], gains: dict[int, float], scales: Scales) -> tuple[Change, ...]:
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
        out.append(Change(cause.name, others, numbers, intervals, gains[i], text))
    return tuple(sorted(out, key=lambda c: -c.heldout_gain))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")
