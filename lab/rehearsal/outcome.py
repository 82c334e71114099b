"""What a run came to, in figures: errors in percent of the commanded range, rails, and what was called trouble."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from adaptive.types import BoolArray, FloatArray
from lab.rehearsal.events import SENSOR, Event
from lab.rehearsal.loop import Course
from service.answers.guard import Limits

#: Windows that the worst is looked for in, s; error that must not last, percent of the range.
WINDOW_S: Final = 0.5
LARGE_PCT: Final = 5.0
#: What "before" and "settled" are taken over, s.
QUIET_S: Final = 2.0
#: A voltage this near to a limit, as a share of the drive, is at the limit.
RAIL_SHARE: Final = 1e-3
#: A stage that is this near to where it is wanted, percent of the range, is at the rail because the reference is.
ASKED_PCT: Final = 2.0
#: A run ends at a rail where the voltage is at a limit for the whole of its end, s.
END_S: Final = 0.1
#: What is interrupted for no longer than this, s, goes on: a stage that swings, or a voltage from limit to limit.
BREAK_S: Final = 0.01
#: A reference that moves by less than this share of the range in a second is at rest.
REST_PER_S: Final = 0.02
#: While a sensor is wrong, an error up to this, percent of the range, or so many times the frozen model's, is in order.
SENSOR_PCT, SENSOR_FACTOR = 1.0, 1.5


@dataclass(frozen=True, slots=True)
class Figures:
    """Errors of one model in one run, percent of the commanded range; nan where the run has no such part.

    Attributes
    ----------
    before_pct : mean absolute error of the last 2 s before the event. first_second_pct, then_pct : of the first second
    from the event on, and of 1 to 4 s after it. during_pct : while it lasts, nan where it does not last.
    settled_pct : of the last 2 s of the run. worst_half_second_pct : the largest mean over half a second from the event
    on. worst_pct : the largest error from the event on. large_s : longest time for which the error stayed above 5 %, in
    the whole run, but for what is beyond reach: where the voltage is at the limit that draws the stage to its target.
    A moment below, of up to 10 ms, does not end it. large_at_s : when that began, s after the event
    (negative: before it); nan where it never was. rail_s : longest time at a limit of the drive that the reference did
    not ask for. ends_at_rail : whether the run ended so.
    """

    before_pct: float
    first_second_pct: float
    then_pct: float
    during_pct: float
    settled_pct: float
    worst_half_second_pct: float
    worst_pct: float
    large_s: float
    large_at_s: float
    rail_s: float
    ends_at_rail: bool


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that the axis called wrong.

    Attributes
    ----------
    name : what it said. named_s : when it first said so, s after the event began (negative: before it).
    motion_s : for how long the reference had moved by then since the event began, s. until_s : when it no longer said
    anything, s after the event began; nan where it went on to the end.
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
    event : what happened. text : as a person would say it. category : INTACT or SENSOR. left_out : why it did not.
    adaptive, frozen : the two models. worst_ratio : worst half second of the adaptive one over that of the frozen one.
    sensor_excess : while a sensor is wrong, the largest mean error over half a second as a share of what is in order
    (the larger of 1 % and 1.5 times the frozen model's in the same half second); nan for other events.
    troubles : in the order in which they began. false_troubles : names of those that began while nothing had happened.
    healthy_s : for how long nothing had happened, s.
    named_s : motion, s, from the event to its first naming; nan where it was not named, or is no fault of a sensor.
    noted : names of the events that the axis noted from the event on, with how many of each.
    simulated_s : length of the run, s.
    """

    event: Event
    text: str
    category: str
    left_out: str
    adaptive: Figures
    frozen: Figures
    worst_ratio: float
    sensor_excess: float
    troubles: tuple[Trouble, ...]
    false_troubles: tuple[str, ...]
    healthy_s: float
    named_s: float
    noted: dict[str, int]
    simulated_s: float

    def as_dict(self) -> dict[str, Any]:
        """JSON form: what is not finite becomes null, numbers have seven digits."""
        told: dict[str, Any] = _plain(asdict(self))
        return told


def figures(course: Course, event: Event, range_um: float, limits: Limits, dt_s: float) -> Figures:
    """The figures of one course."""
    error_pct = _error_pct(course, range_um)
    n = error_pct.size
    at, end = round(event.at_s / dt_s), round(event.end_s / dt_s)
    second, quiet = round(1.0 / dt_s), round(QUIET_S / dt_s)
    window = max(1, round(WINDOW_S / dt_s))
    pause = round(BREAK_S / dt_s)
    beyond = _beyond_reach(course, event, limits, dt_s)
    rail = bridged(_at_limit(course, limits) & (error_pct > ASKED_PCT) & ~beyond, pause)
    # The last interruption cannot be told from an end of it.
    last = rail[n - max(1, round(END_S / dt_s)) : n - pause]
    large, from_tick = longest(bridged((error_pct > LARGE_PCT) & ~beyond, pause))
    return Figures(
        before_pct=_mean(error_pct[max(0, at - quiet) : at]),
        first_second_pct=_mean(error_pct[at : at + second]),
        then_pct=_mean(error_pct[at + second : at + 4 * second]),
        during_pct=_mean(error_pct[at:end]),
        settled_pct=_mean(error_pct[max(end, n - quiet) :]),
        worst_half_second_pct=float(moving_mean(error_pct[at:], window).max()),
        worst_pct=float(error_pct[at:].max()),
        large_s=large * dt_s,
        large_at_s=(from_tick - at) * dt_s if large else float("nan"),
        rail_s=longest(rail)[0] * dt_s,
        ends_at_rail=bool(last.all()),
    )


def outcome(
    event: Event, adaptive: Course, frozen: Course, range_um: float, limits: Limits, dt_s: float, left_out: str
) -> Outcome:
    """The outcome of a run; both courses are of the same reference."""
    one, other = (figures(course, event, range_um, limits, dt_s) for course in (adaptive, frozen))
    troubles = _troubles(adaptive, event, range_um, dt_s)
    sensor = event.category == SENSOR
    healthy_s = adaptive.t_s.size * dt_s if event.kind == "none" else event.at_s
    # What begins before a sensor is wrong, or when it is well again, is no word about its fault.
    true = [t for t in troubles if sensor and 0.0 <= t.named_s <= event.over_s]
    noted: dict[str, int] = {}
    for t_s, name, _ in adaptive.events:
        if t_s >= event.at_s:
            noted[name] = noted.get(name, 0) + 1
    return Outcome(
        event=event,
        text=event.text,
        category=event.category,
        left_out=left_out,
        adaptive=one,
        frozen=other,
        worst_ratio=one.worst_half_second_pct / max(other.worst_half_second_pct, 1e-12),
        sensor_excess=_sensor_excess(adaptive, frozen, event, range_um, dt_s) if sensor else float("nan"),
        troubles=troubles,
        false_troubles=tuple(t.name for t in troubles if t.named_s + event.at_s < healthy_s),
        healthy_s=healthy_s,
        named_s=true[0].motion_s if true else float("nan"),
        noted=noted,
        simulated_s=adaptive.t_s.size * dt_s,
    )


def moving_mean(values: FloatArray, window: int) -> FloatArray:
    """Means over every ``window`` neighbours; over all of them where there are fewer."""
    window = min(window, values.size)
    total = np.concatenate([[0.0], np.cumsum(values)])
    means: FloatArray = (total[window:] - total[:-window]) / window
    return means


def bridged(holds: BoolArray, most: int) -> BoolArray:
    """``holds`` (n,), with the gaps of up to ``most`` samples filled where it holds before and after them."""
    at = np.arange(holds.size)
    before = np.maximum.accumulate(np.where(holds, at, -holds.size))
    after = np.minimum.accumulate(np.where(holds, at, 2 * holds.size)[::-1])[::-1]
    filled: BoolArray = holds | (after - before <= most + 1)
    return filled


def longest(holds: BoolArray) -> tuple[int, int]:
    """(length, beginning) of the longest stretch in which it holds; (0, 0) where it nowhere does."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]])))
    if not edges.size:
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    return int(lengths.max()), int(edges[2 * int(lengths.argmax())])


def _error_pct(course: Course, range_um: float) -> FloatArray:
    error: FloatArray = 100.0 / range_um * np.abs(course.wanted_um - course.true_um)
    return error


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _beyond_reach(course: Course, event: Event, limits: Limits, dt_s: float) -> BoolArray:
    """(n,) where the reference asks for what is beyond reach: by the event, or where the voltage is at the limit that
    draws the stage to where it is wanted, and does not get it there."""
    t_s, u = course.t_s, course.u_V
    by_event = (t_s >= event.at_s) & (t_s <= event.end_s + dt_s) & (event.kind == "rail")
    rising = np.sign(np.dot(u - u.mean(), course.true_um - course.true_um.mean()))
    missing_um = rising * (course.wanted_um - course.true_um)
    up = u > 0.5 * (limits.u_min_V + limits.u_max_V)
    beyond: BoolArray = by_event | (_at_limit(course, limits) & np.where(up, missing_um > 0.0, missing_um < 0.0))
    return beyond


def _at_limit(course: Course, limits: Limits) -> BoolArray:
    near = RAIL_SHARE * (limits.u_max_V - limits.u_min_V)
    return (course.u_V <= limits.u_min_V + near) | (course.u_V >= limits.u_max_V - near)


def _troubles(course: Course, event: Event, range_um: float, dt_s: float) -> tuple[Trouble, ...]:
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


def _sensor_excess(adaptive: Course, frozen: Course, event: Event, range_um: float, dt_s: float) -> float:
    part = slice(round(event.at_s / dt_s), round(event.end_s / dt_s))
    window = max(1, round(WINDOW_S / dt_s))
    one, other = (moving_mean(_error_pct(course, range_um)[part], window) for course in (adaptive, frozen))
    return float((one / np.maximum(SENSOR_PCT, SENSOR_FACTOR * other)).max())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if np.isfinite(value) else None
    return value
