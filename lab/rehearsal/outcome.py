"""The outcome of a run in figures: errors in percent of the commanded range, voltage limits, and reported troubles."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from dehyst.adaptive.types import BoolArray, FloatArray
from dehyst.lab.rehearsal.disturbance import SENSOR, Event
from dehyst.lab.rehearsal.runs import LoopRecord
from dehyst.service.answers.guard import Limits
from dehyst.service.reports.tables import json_form
from dehyst.sim.masks import runs

#: Window of the worst mean error, s; error that must not last, percent of the range.
WINDOW_S: Final = 0.5
LARGE_PCT: Final = 5.0
#: Time over which "before" and "settled" are taken, s.
QUIET_S: Final = 2.0
#: A voltage this close to a limit, as a share of the drive, is at the limit.
RAIL_SHARE: Final = 1e-3
#: A stage this close to its reference, percent of the range, is at the limit because of the reference.
ASKED_PCT: Final = 2.0
#: A run ends at a limit if the voltage is there for its last part of this length, s.
END_S: Final = 0.1
#: Interruptions up to this, s, do not count: a stage that swings, or a voltage that changes from limit to limit.
BREAK_S: Final = 0.01
#: A reference that moves by less than this share of the range per second is at rest.
REST_PER_S: Final = 0.02
#: Error allowed during a sensor fault: percent of the range, or this multiple of the error of the better of two models
#: that do not learn: the identified one, and the last estimate before the fault.
SENSOR_PCT, SENSOR_FACTOR = 1.0, 1.5


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Errors of one model in one run, percent of the commanded range; NaN if the run has no such part.

    Attributes
    ----------
    before_pct : mean absolute error of the last 2 s before the event.
    first_second_pct, then_pct : of the first second from the event on, and of 1 to 4 s after it.
    during_pct : during the event, NaN if it does not last.
    settled_pct : of the last 2 s of the run.
    worst_half_second_pct : largest mean over half a second, from the event on.
    large_s : longest time with an error above 5 % in the whole run. It does not count where the voltage is at the limit
        that moves the stage towards the reference. Interruptions up to 10 ms do not end it.
    large_at_s : when that began, s after the event (negative: before it); NaN if never.
    ends_at_rail : whether the run ended at a limit of the drive that the reference did not require.
    """

    before_pct: float
    first_second_pct: float
    then_pct: float
    during_pct: float
    settled_pct: float
    worst_half_second_pct: float
    large_s: float
    large_at_s: float
    ends_at_rail: bool


@dataclass(frozen=True, slots=True)
class Trouble:
    """A trouble that the axis reported.

    Attributes
    ----------
    name : of the trouble. named_s : when it was first reported, s after the event began (negative: before it).
    motion_s : how long the reference had moved by then since the event began, s. until_s : when the report ended, s
    after the event began; NaN if it lasted to the end.
    """

    name: str
    named_s: float
    motion_s: float
    until_s: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """A run in figures.

    Attributes
    ----------
    event : what happened. text : its description. category : INTACT or SENSOR. left_out : why it did not happen.
    adaptive, frozen : the two models. worst_ratio : worst half second of the adaptive model over that of the frozen
    one.
    sensor_ratio : mean error during a sensor fault over that of the better of the frozen model and of the last estimate
    before the fault; NaN for other events.
    sensor_excess : during a sensor fault, the largest mean error over half a second as a share of what is allowed (the
    larger of 1 % and 1.5 times that of the better one in the same half second); NaN for other events.
    troubles : in the order in which they began. false_troubles : names of those that began before anything had
    happened.
    healthy_s : how long nothing had happened, s.
    named_s : motion, s, from the event to its first report; NaN if it was not reported, or is no sensor fault.
    jumps : jumps that the learner has believed from the event on.
    simulated_s : length of the run, s.
    """

    event: Event
    text: str
    category: str
    left_out: str
    adaptive: ErrorFigures
    frozen: ErrorFigures
    worst_ratio: float
    sensor_ratio: float
    sensor_excess: float
    troubles: tuple[Trouble, ...]
    false_troubles: tuple[str, ...]
    healthy_s: float
    named_s: float
    jumps: int
    simulated_s: float

    def as_dict(self) -> dict[str, Any]:
        """JSON form: values that are not finite become null, numbers have seven digits."""
        form: dict[str, Any] = json_form(asdict(self))
        return form


def figures(course: LoopRecord, event: Event, range_um: float, limits: Limits, dt_s: float) -> ErrorFigures:
    """The figures of one run of one model."""
    error_pct = _error_pct(course, range_um)
    n = error_pct.size
    at, end = round(event.at_s / dt_s), round(event.end_s / dt_s)
    second, quiet = round(1.0 / dt_s), round(QUIET_S / dt_s)
    window = max(1, round(WINDOW_S / dt_s))
    pause = round(BREAK_S / dt_s)
    beyond = _beyond_reach(course, event, limits, dt_s)
    rail = gaps_filled(_at_limit(course, limits) & (error_pct > ASKED_PCT) & ~beyond, pause)
    # An interruption at the very end cannot be told from the end of the time at the limit.
    last = rail[n - max(1, round(END_S / dt_s)) : n - pause]
    large, from_tick = longest_stretch(gaps_filled((error_pct > LARGE_PCT) & ~beyond, pause))
    return ErrorFigures(
        before_pct=_mean(error_pct[max(0, at - quiet) : at]),
        first_second_pct=_mean(error_pct[at : at + second]),
        then_pct=_mean(error_pct[at + second : at + 4 * second]),
        during_pct=_mean(error_pct[at:end]),
        settled_pct=_mean(error_pct[max(end, n - quiet) :]),
        worst_half_second_pct=float(moving_mean(error_pct[at:], window).max()),
        large_s=large * dt_s,
        large_at_s=(from_tick - at) * dt_s if large else float("nan"),
        ends_at_rail=bool(last.all()),
    )


def outcome(
    event: Event, adaptive: LoopRecord, frozen: LoopRecord, last: LoopRecord | None, range_um: float, limits: Limits,
    dt_s: float, left_out: str,
) -> Outcome:  # fmt: skip
    """The outcome of a run; all records have the same reference. ``last`` : of the last estimate before a sensor fault,
    None for other events."""
    one, other = (figures(course, event, range_um, limits, dt_s) for course in (adaptive, frozen))
    troubles = _troubles(adaptive, event, range_um, dt_s)
    sensor = event.category == SENSOR
    ratio = excess = float("nan")
    if last is not None:
        better_pct = min(other.during_pct, figures(last, event, range_um, limits, dt_s).during_pct)
        ratio = one.during_pct / max(better_pct, 1e-12)
        excess = _sensor_excess(adaptive, (frozen, last), event, range_um, dt_s)
    healthy_s = adaptive.t_s.size * dt_s if event.kind == "none" else event.at_s
    # A report before or after a sensor fault is not about it.
    true = [t for t in troubles if sensor and 0.0 <= t.named_s <= event.over_s]
    return Outcome(
        event=event,
        text=event.text,
        category=event.category,
        left_out=left_out,
        adaptive=one,
        frozen=other,
        worst_ratio=one.worst_half_second_pct / max(other.worst_half_second_pct, 1e-12),
        sensor_ratio=ratio,
        sensor_excess=excess,
        troubles=troubles,
        false_troubles=tuple(t.name for t in troubles if t.named_s + event.at_s < healthy_s),
        healthy_s=healthy_s,
        named_s=true[0].motion_s if true else float("nan"),
        jumps=int(adaptive.jumps[-1] - adaptive.jumps[max(0, round(event.at_s / dt_s) - 1)]),
        simulated_s=adaptive.t_s.size * dt_s,
    )


def moving_mean(values: FloatArray, window: int) -> FloatArray:
    """Means over every ``window`` neighbours; over all values if there are fewer."""
    window = min(window, values.size)
    total = np.concatenate([[0.0], np.cumsum(values)])
    means: FloatArray = (total[window:] - total[:-window]) / window
    return means


def gaps_filled(holds: BoolArray, most: int) -> BoolArray:
    """``holds`` (n,) with gaps of up to ``most`` samples filled where it is true on both sides."""
    at = np.arange(holds.size)
    before = np.maximum.accumulate(np.where(holds, at, -holds.size))
    after = np.minimum.accumulate(np.where(holds, at, 2 * holds.size)[::-1])[::-1]
    filled: BoolArray = holds | (after - before <= most + 1)
    return filled


def longest_stretch(holds: BoolArray) -> tuple[int, int]:
    """(length, first index) of the longest stretch that is true; (0, 0) if there is none."""
    stretches = runs(holds)
    if not stretches.size:
        return 0, 0
    start, stop = stretches[np.argmax(np.diff(stretches))]
    return int(stop - start), int(start)


def _error_pct(course: LoopRecord, range_um: float) -> FloatArray:
    error: FloatArray = 100.0 / range_um * np.abs(course.wanted_um - course.true_um)
    return error


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _beyond_reach(course: LoopRecord, event: Event, limits: Limits, dt_s: float) -> BoolArray:
    """(n,) where the reference is beyond reach: by the event, or because the voltage is at the limit that moves the
    stage towards it and does not get it there."""
    t_s, u = course.t_s, course.u_V
    by_event = (t_s >= event.at_s) & (t_s <= event.end_s + dt_s) & (event.kind == "rail")
    rising = np.sign(np.dot(u - u.mean(), course.true_um - course.true_um.mean()))
    missing_um = rising * (course.wanted_um - course.true_um)
    up = u > 0.5 * (limits.u_min_V + limits.u_max_V)
    beyond: BoolArray = by_event | (_at_limit(course, limits) & np.where(up, missing_um > 0.0, missing_um < 0.0))
    return beyond


def _at_limit(course: LoopRecord, limits: Limits) -> BoolArray:
    near = RAIL_SHARE * (limits.u_max_V - limits.u_min_V)
    return (course.u_V <= limits.u_min_V + near) | (course.u_V >= limits.u_max_V - near)


def _troubles(course: LoopRecord, event: Event, range_um: float, dt_s: float) -> tuple[Trouble, ...]:
    at = round(event.at_s / dt_s)
    moving = np.abs(np.diff(course.wanted_um, prepend=course.wanted_um[0])) > REST_PER_S * range_um * dt_s
    moved_s = dt_s * np.cumsum(moving[at:])
    edges = np.flatnonzero(np.diff(course.trouble, prepend=0))
    found = []
    for k in edges.tolist():
        name = course.troubles[course.trouble[k]]
        if not name:
            continue
        over = np.flatnonzero(course.trouble[k:] != course.trouble[k])
        until_s = (k + int(over[0]) - at) * dt_s if over.size else float("nan")
        found.append(Trouble(name, (k - at) * dt_s, float(moved_s[k - at]) if k >= at else 0.0, until_s))
    return tuple(found)


def _sensor_excess(
    adaptive: LoopRecord, others: tuple[LoopRecord, LoopRecord], event: Event, range_um: float, dt_s: float
) -> float:
    part = slice(round(event.at_s / dt_s), round(event.end_s / dt_s))
    window = max(1, round(WINDOW_S / dt_s))
    one, *rest = (moving_mean(_error_pct(course, range_um)[part], window) for course in (adaptive, *others))
    return float((one / np.maximum(SENSOR_PCT, SENSOR_FACTOR * np.minimum(*rest))).max())
