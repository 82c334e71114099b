"""What must hold in a soak: each invariant with the worst value that was observed and its limit.

The stage enforces its own limits, so each invariant about voltages takes the worst of both: the commands as the
controller sent them, and the voltages that came back in the samples. Times are judged beside a bare paced loop, see
`lab.soak.machine_load`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pyarrow import parquet

from adaptive.types import FloatArray
from lab.soak.fault_plan import FAULT_KINDS
from lab.soak.machine_load import STALLED_S, MachineLoad
from lab.soak.verdict.observations import FAST, ROUND_OFF, Intervals, Observations, QuerySecond, SampleSecond
from service.storage.segments import close_left_open, segments


@dataclass(frozen=True, slots=True)
class Invariant:
    """``held``, the worst value met, the limit it was held against, and both in words.

    ``held`` is None where this run allowed no judgement; ``why`` then says so in a few words, ``text`` in more.
    """

    held: bool | None
    worst: float | None
    limit: float
    unit: str
    text: str
    why: str = ""

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        worst = None if self.worst is None or not math.isfinite(self.worst) else round(self.worst, 6)
        told = {"held": self.held, "worst": worst, "limit": self.limit, "unit": self.unit, "text": self.text}
        return told | {"why": self.why}


def at_most(worst: float, limit: float, unit: str, text: str) -> Invariant:
    """Holds where ``worst`` is at most ``limit``."""
    return Invariant(bool(worst <= limit), float(worst), limit, unit, text)


def worst_of(one: Invariant, other: Invariant) -> Invariant:
    """Of two stretches of one run: broken where either is, judged where either could be, the worst of both."""
    found = max((one, other), key=lambda i: -math.inf if i.worst is None else i.worst)
    held = False if False in (one.held, other.held) else True if True in (one.held, other.held) else None
    return replace(found, held=held, why=found.why if held is None else "")


def sum_of(one: Invariant, other: Invariant) -> Invariant:
    """Of two stretches of one run in which something is counted."""
    return at_most((one.worst or 0.0) + (other.worst or 0.0), other.limit, other.unit, other.text)


def unjudged(limit: float, unit: str, why: str, text: str = "") -> Invariant:
    """What this run does not tell, and why."""
    return Invariant(None, None, limit, unit, f"{text}: not judged" if text else f"not judged: {why}", why)


# --- Voltages

#: Take-overs: whose window is looked at for a jump.
TAKEOVERS = ("kill_primary", "stop_primary")
#: While no router is there, what is sent need not come to whoever watches, nor to the stage.
_UNSEEN = ("restart_router",)


def safe_voltages(observed: Observations) -> dict[str, Invariant]:
    """Finite, within the limits, within the slew limit."""
    seconds = observed.seconds
    beyond_V = max((max(s.beyond_V, s.sent_beyond_V) for s in seconds), default=0.0)
    return {
        "voltages_finite": at_most(
            sum(s.not_finite + s.sent_not_finite for s in seconds), 0, "samples",
            "voltages sent or applied that are not finite, and commands that could not be read",
        ),
        "voltages_within_limits": at_most(beyond_V, 1e-9, "V", "voltage beyond its limits, as sent or as applied"),
        "voltages_within_slew": at_most(
            _worst_step(observed, seconds), ROUND_OFF, "limits",
            "largest step of the voltage, as sent or as applied, over what the slew limit allows",
        ),
    }  # fmt: skip


def answers_safe(observed: Observations) -> Invariant:
    """What the clients themselves found in the answers that they got."""
    unsafe = sum(p.unsafe for p in observed.query_seconds) + observed.unsafe_blocks
    return at_most(unsafe, 0, "answers", "answers that were not finite, beyond a limit or too steep")


def takeover_continuous(observed: Observations) -> Invariant:
    """The slew limit again, around each take-over."""
    around: list[SampleSecond] = []
    for fault in observed.faults:
        begin, end = fault.window_s
        if fault.kind in TAKEOVERS:
            around += observed.seconds_between(begin - 1.0, end)
    return at_most(_worst_step(observed, around), ROUND_OFF, "limits", "the same, around a take-over")


def _worst_step(observed: Observations, seconds: Iterable[SampleSecond]) -> float:
    """In shares of what the slew limit allows."""
    unseen = [fault.window_s for fault in observed.faults if fault.kind in _UNSEEN]
    worst_V = 0.0
    for s in seconds:
        worst_V = max(worst_V, s.step_max_V, s.sent_step_V)
        if s.resumed_V > worst_V and not any(begin - 1.0 <= s.t_s <= end for begin, end in unseen):
            worst_V = s.resumed_V
    return worst_V / observed.step_limit_V


# --- Times

#: Longest time without an answer outside fault windows; and what a fault's own silence may have on top: a query that
#: was under way when it began, and the pause before the next.
SILENT_S, SILENT_MARGIN_S = 0.25, 0.15
#: Age of the snapshot that a client follows, s, and the share of the looks at it that have to be within.
FOLLOWED_S: Final = 0.05
_SHARE: Final = 0.99
#: Ages are counted, not kept: to so much, and up to so much, s.
_RESOLUTION_S, _OLDEST_S = 1e-4, 5.0
#: How long beyond its time a fault's recovery may be seen: seconds are looked at whole.
RECOVERED_S: Final = 1.0
#: Share of the seconds, or of the faults, that has to be fit to be judged.
_LEAST_SHARE: Final = 0.5
#: Share of its time to recover for which the machine has to be busy before a fault that did not is not judged.
_EXCUSED_SHARE: Final = 0.25


def queries_answered(observed: Observations, machine: MachineLoad) -> Invariant:
    """The longest time without an answer outside fault windows."""
    calm = calm_probes(observed)
    text = "longest time without an answer, no fault on"
    if not calm:
        return unjudged(SILENT_S, "s", "no second without a fault", text)
    spans = [(p.silent_s, p.t_s - 1.0 - p.silent_s, p.t_s) for p in calm]
    judged = [span for span in spans if not machine.stalled(*span[1:])]
    over = [max(0.0, silent_s - machine.allowed_s(begin, end)) for silent_s, begin, end in judged]
    return _judged(over, len(calm), SILENT_S, text, "seconds")


def calm_probes(observed: Observations) -> list[QuerySecond]:
    """The seconds of the prober in which no fault was on; of one that began before the run nobody can say."""
    return [p for p in observed.query_seconds if p.t_s >= 1.0 and observed.quiet(p.t_s) and observed.quiet(p.t_s - 1.0)]


class Ages:
    """How old the snapshot was that a client evaluates in its own process: how many looks found which age.

    Seconds without a fault are judged in which the machine had not stood still, and others had left the learner, from
    which a snapshot comes, a processor to learn on.
    """

    def __init__(self) -> None:
        self._looks = np.zeros(round(_OLDEST_S / _RESOLUTION_S) + 1, dtype=np.int64)
        self._judged = self._of = 0

    def add(self, observed: Observations, machine: MachineLoad) -> None:
        """The looks of a run, or of a stretch of it; each less what the machine is allowed."""
        for p in calm_probes(observed):
            if not len(p.ages_s):
                continue
            self._of += 1
            ages_s = np.asarray(p.ages_s, dtype=np.float64)
            begin, end = p.t_s - 1.0 - float(ages_s.max()), p.t_s
            if machine.stalled(begin, end) or machine.taken(begin, end):
                continue
            self._judged += 1
            over_s = np.clip(ages_s - machine.allowed_s(begin, end), 0.0, _OLDEST_S)
            np.add.at(self._looks, np.rint(over_s / _RESOLUTION_S).astype(np.int64), 1)

    def invariant(self, least: int = 0) -> Invariant:
        """The age that one look in a hundred passes; not judged by fewer than ``least`` seconds."""
        text = "age of the snapshot in a client that follows, in 99 % of its looks, no fault on"
        if not self._of:
            return unjudged(FOLLOWED_S, "s", "no second without a fault", text)
        if self._judged < least:
            return unjudged(FOLLOWED_S, "s", f"{self._judged} seconds so far", text)
        passed = np.cumsum(self._looks)
        worst_s = _RESOLUTION_S * float(np.searchsorted(passed, _SHARE * passed[-1])) if passed[-1] else 0.0
        return _told(worst_s, self._judged, self._of, FOLLOWED_S, text, "seconds")


def follower_age(observed: Observations, machine: MachineLoad) -> Invariant:
    """Of the whole run."""
    ages = Ages()
    ages.add(observed, machine)
    return ages.invariant()


def answered_again(observed: Observations, machine: MachineLoad) -> Invariant:
    """The longest time without an answer during faults, beyond what each allows."""
    over = []
    for fault in observed.faults:
        begin, end = fault.window_s
        allowed_s = (FAULT_KINDS[fault.kind].silent_s or SILENT_S) + SILENT_MARGIN_S
        # Those that take the processor away make the bare loop late by themselves, and have that in their own limit.
        if fault.kind == "cpu_stolen":
            over.append(max(0.0, fault.silent_s - allowed_s))
        elif not machine.stalled(begin, end):
            over.append(max(0.0, fault.silent_s - allowed_s - machine.allowed_s(begin, end)))
    return _judged(over, len(observed.faults), 0.0, "time without an answer beyond what the fault allows", "faults")


def recovers(observed: Observations) -> Invariant:
    """The longest that anything took to be well again beyond its time, the seconds of a busy machine left out."""
    over: list[float] = []
    for fault in observed.faults:
        end = fault.window_s[1]
        if math.isfinite(fault.recovered_s):
            over.append(fault.recovered_s - end - fault.busy_s)
        elif end + RECOVERED_S > observed.duration_s:
            # It lasted longer than planned, and the run was over before its time was.
            continue
        elif fault.busy_s <= _EXCUSED_SHARE * FAULT_KINDS[fault.kind].recover_s:
            over.append(math.inf)
    return _judged(over, len(observed.faults), RECOVERED_S, "longest beyond its time until all was well", "faults")


def _judged(over: list[float], of: int, limit_s: float, text: str, what: str) -> Invariant:
    """``over``: those that could be judged, of so many. What is broken is broken, however few they are."""
    return _told(max(over, default=0.0), len(over), of, limit_s, text, what)


def _told(worst: float, judged: int, of: int, limit_s: float, text: str, what: str) -> Invariant:
    left = of - judged
    if left:
        why = f"a bare loop was late by {STALLED_S:g} s, others had the cores, or the run was over"
        text += f"; {left} of {of} {what} not judged: {why}"
    if worst <= limit_s and judged < _LEAST_SHARE * of:
        return Invariant(None, worst, limit_s, "s", text, "too busy a machine")
    return Invariant(bool(worst <= limit_s), worst, limit_s, "s", text)


# --- Memory

T = TypeVar("T")

#: Warm-up: half of a process' life, within these, s. Rings fill and kinds of work are done for the first time for a
#: quarter of an hour. What has lived shorter than the last of them after it is not judged.
MEMORY_WARM_S: Final = (180.0, 900.0)
MEMORY_LEAST_S: Final = 300.0
#: A process under faults has a few levels of memory in use: as the one that serves, as the one that stands by, with a
#: state just handed over. Seen over half an hour of three processes that did not grow: 134.4 to 137.4 MB. A line from
#: one of them to another is no growth.
LEVELS_KB: Final = 4_000.0
_MINUTE_S: Final = 60.0
#: Of a small object of Python's on average: its allocator's pools over their blocks, as measured in a service.
_BLOCK_BYTES: Final = 100.0


@dataclass(frozen=True, slots=True)
class Trend:
    """A slope and by how much it may be wrong, both kB per hour."""

    slope: float
    doubt: float


def memory_slopes(observed: Observations) -> list[Trend]:
    """What the serving processes that lived longest after their warm-up have in use, the one that grows most surely
    first; empty where none lived long enough. Where the allocator cannot tell what is in use, their resident memory.

    What is in use is what the learner, its snapshots and its marks hold: it goes up and down by megabytes when faults
    take samples from the window, change the model or the role. A slope of 1 MB an hour shows in half an hour without
    faults, and in hours with them; the doubt says so.
    """
    used, levels_kb = _in_use(observed), LEVELS_KB if observed.faults else 0.0
    of = np.median if used else np.min
    trends = _longest(used or _resident(observed), lambda t, kb: _trend(*_minutes(t, kb, of), levels_kb))
    return sorted(trends, key=lambda trend: trend.doubt - trend.slope)


def resident_growth(observed: Observations) -> float | None:
    """MB by which the resident memory of those processes ended above where it was after their warm-up, at most: the
    least of the last five minutes less the least of the first five. None where none lived for ten."""

    def growth(t_s: FloatArray, kb: FloatArray) -> float:
        first, last = t_s <= t_s[0] + MEMORY_LEAST_S, t_s >= t_s[-1] - MEMORY_LEAST_S
        return float(kb[last].min() - kb[first].min()) / 1024.0

    return max(_longest(_resident(observed), growth, 2.0 * MEMORY_LEAST_S), default=None)


def _longest(
    rows: Mapping[str, list[tuple[float, float]]],
    what: Callable[[FloatArray, FloatArray], T],
    least_s: float = MEMORY_LEAST_S,
) -> list[T]:
    """Of each process that lived as long as the longest, to a minute; what is before its warm-up left out."""
    found: list[tuple[float, T]] = []
    for taken in rows.values():
        t, kb = (np.array(column) for column in zip(*taken, strict=True))
        after = t >= t[0] + warm_up_s(float(np.ptp(t)))
        lived = float(np.ptp(t[after])) if after.any() else 0.0
        if lived >= least_s:
            found.append((lived, what(t[after], kb[after])))
    longest = max((lived for lived, _ in found), default=0.0)
    return [told for lived, told in found if lived >= longest - _MINUTE_S]


def _resident(observed: Observations) -> dict[str, list[tuple[float, float]]]:
    """By serving process, (t_s, kB)."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name in ("a", "b", "service"):
        for t_s, kb, number in observed.memory.get(name, []):
            found.setdefault(f"{name}-{number}", []).append((t_s, kb))
    return found


def _in_use(observed: Observations) -> dict[str, list[tuple[float, float]]]:
    """By instance, (t_s, kB): of the C library's allocator and of Python's."""
    found: dict[str, list[tuple[float, float]]] = {}
    for t_s, name, now in observed.counters:
        if "memory.malloc_bytes" in now:
            kb = (now["memory.malloc_bytes"] + _BLOCK_BYTES * now["memory.python_blocks"]) / 1024.0
            found.setdefault(name, []).append((t_s, kb))
    return found


def warm_up_s(lived_s: float) -> float:
    """How much of the life of a process is its warm-up, s."""
    least_s, most_s = MEMORY_WARM_S
    return min(most_s, max(least_s, 0.5 * lived_s))


def _minutes(t_s: FloatArray, kb: FloatArray, of: Callable[[FloatArray], Any]) -> tuple[FloatArray, FloatArray]:
    """One value a minute, and its middle: what is in use for a moment (a state that is handed over, a checkpoint) is
    given back within a minute, and is no growth."""
    minute = ((t_s - t_s[0]) // _MINUTE_S).astype(np.int64)
    there = np.unique(minute)
    return t_s[0] + _MINUTE_S * (there + 0.5), np.array([float(of(kb[minute == m])) for m in there])


def _trend(t_s: FloatArray, kb: FloatArray, levels_kb: float) -> Trend:
    """Median of the slopes between the two halves (Theil and Sen's, each point with the one half a run later).

    ``levels_kb`` : by how much what is in use may differ from one minute to another without growing.
    """
    half = len(t_s) // 2
    slope = float(np.median((kb[half : 2 * half] - kb[:half]) / (t_s[half : 2 * half] - t_s[:half])))
    left = kb - slope * t_s
    left -= left.mean()
    square = float(left @ left)
    # What is above the line in one minute is so in the next: so many minutes count as one.
    alike = min(max(float(left[1:] @ left[:-1]) / square, 0.0), 0.9) if square > 0.0 else 0.0
    error = math.sqrt(
        square * (1.0 + alike) / (1.0 - alike) / max(len(kb) - 2, 1) / float(np.sum((t_s - t_s.mean()) ** 2))
    )
    return Trend(3600.0 * slope, 3600.0 * max(2.0 * error, levels_kb / float(np.ptp(t_s))))


# --- All invariants

#: Mean |error| outside fault windows, in percent of the commanded range. Seen in runs that were well: 0.024 to 0.032.
TRACKING_PCT: Final = 0.05
MEMORY_KB_PER_HOUR: Final = 1024.0
#: What lies free between other things goes up and down by so much, of some 300 MB.
RESIDENT_MB: Final = 30.0
#: A message or two may be between two counters when they are read.
UNDER_WAY = 64


def judge(observed: Observations, missing: int | None, tracking_pct: float = TRACKING_PCT) -> dict[str, Invariant]:
    """All invariants; `settle` comes first. ``missing``: samples that were seen and are in no recording."""
    found = safe_voltages(observed) | {"answers_safe": answers_safe(observed)}
    if observed.mode != FAST:
        machine = MachineLoad(observed.loop_delays, observed.other_load)
        found["takeover_continuous"] = takeover_continuous(observed)
        found["queries_answered"] = queries_answered(observed, machine)
        found["answered_again"] = answered_again(observed, machine)
        found["follower_age"] = follower_age(observed, machine)
    found["recovers_by_itself"] = recovers(observed)
    found["faults_happened"] = at_most(
        int(bool(observed.planned) and not observed.faults), 0, "runs", "runs with a plan of which not one fault began"
    )
    found["faults_told"] = faults_told(observed)
    found["samples_accounted"] = samples_accounted(observed)
    found["processes_alive"] = processes_alive(observed)
    if missing is not None:
        found["no_record_lost"] = at_most(missing, 0, "samples", "samples that came and are in nobody's recording")
    found["tracking"] = tracking(tracked(observed, observed.seconds), observed.range_um, tracking_pct)
    # What a run in one process has in use is also the stage's and the controller's.
    short = "in one process" if observed.mode == FAST else "too short a run"
    found["memory"] = _memory_invariant(memory_slopes(observed), short)
    found["memory_resident"] = _resident_invariant(resident_growth(observed), short)
    return found


def faults_told(observed: Observations) -> Invariant:
    """Of every fault somebody has told, or there was no time for it: the run was over."""
    untold = [fault for fault in observed.faults if not fault.reported_by]
    early = sum(fault.look_until_s > observed.duration_s for fault in untold)
    text = "faults that no counter and no event told of"
    if early:
        text += f"; {early} of {len(observed.faults)} not judged: the run was over"
    return at_most(len(untold) - early, 0, "faults", text)


def processes_alive(observed: Observations) -> Invariant:
    """Nobody ends but by a fault."""
    return at_most(len(observed.ended), 0, "processes", "processes that ended by themselves")


def tracked(observed: Observations, seconds: list[SampleSecond]) -> list[SampleSecond]:
    """Of the ``seconds`` those that tell how good the model is: no fault on, and every voltage there in time."""
    held = {round(s.t_s) + i for s in seconds if s.held for i in (0, 1)}
    quiet = [s for s in seconds if s.judged and observed.quiet(s.t_s) and observed.quiet(s.t_s + 1.0)]
    return [s for s in quiet if round(s.t_s) not in held]


def tracking(quiet: list[SampleSecond], range_um: float, limit_pct: float) -> Invariant:
    """The mean |error| of those seconds."""
    return mean_error(sum(s.error_sum_um for s in quiet), sum(s.judged for s in quiet), len(quiet), range_um, limit_pct)


def mean_error(sum_um: float, judged: int, seconds: int, range_um: float, limit_pct: float) -> Invariant:
    """From the sum of |error|, µm, of so many samples in so many seconds."""
    error_pct = 100.0 * sum_um / judged / range_um if judged else None
    text = f"mean |error| outside fault windows, over {seconds} s in which every voltage came in time"
    if error_pct is None:
        return unjudged(limit_pct, "% of range", "no such second", text)
    return Invariant(error_pct <= limit_pct, error_pct, limit_pct, "% of range", text)


def _memory_invariant(trends: list[Trend], short: str) -> Invariant:
    """Broken where one grows beyond doubt, held where none does; else this run cannot tell, and says so."""
    text = "growth of what the longest-lived serving processes have in use, after warm-up"
    if not trends:
        return unjudged(MEMORY_KB_PER_HOUR, "kB/hour", short, text)
    each = [_grows(trend) for trend in trends]
    held = False if True in each else None if None in each else True
    told, why = f"{text}, ± {trends[0].doubt:.0f}", ""
    if held is None:
        told += ": not judged, a run without faults (--faults none) or one of hours tells"
        why = "too short a run for its doubt"
    return Invariant(held, trends[0].slope, MEMORY_KB_PER_HOUR, "kB/hour", told, why)


def _grows(trend: Trend) -> bool | None:
    """Whether it grows by more than the limit; None where its doubt leaves that open."""
    slope, doubt = trend.slope, trend.doubt
    # Level to within the doubt, and below the limit even with it. One that fell tells little of what it hides.
    level = abs(slope) <= doubt and slope + doubt <= MEMORY_KB_PER_HOUR
    if level or (slope <= MEMORY_KB_PER_HOUR and doubt <= MEMORY_KB_PER_HOUR):
        return False
    return True if slope - doubt > MEMORY_KB_PER_HOUR else None


def _resident_invariant(grown_mb: float | None, short: str) -> Invariant:
    text = "resident memory of one of them in its last five minutes above that of the first five after warm-up"
    if grown_mb is None:
        return unjudged(RESIDENT_MB, "MB", short, text)
    return Invariant(grown_mb <= RESIDENT_MB, grown_mb, RESIDENT_MB, "MB", text)


def samples_accounted(observed: Observations) -> Invariant:
    """Numbers handled = samples received - late + lost, and received = all verdicts; between any two statuses."""
    worst, where = 0.0, ""
    last: dict[str, Mapping[str, float]] = {}
    for t_s, name, now in observed.counters:
        # One that stands by takes over the whole state of the one that serves, counters included, now and then.
        if "samples.received" not in now or not now.get("serves", 1.0):
            last.pop(name, None)
            continue
        verdicts = sum(value for key, value in now.items() if key.startswith("samples.gates."))
        off = {
            "received and verdicts": abs(now["samples.received"] - verdicts),
            "dropped": now.get("samples.dropped", 0),
        }
        before = last.get(name)
        if before is not None and before["samples.restarts"] == now["samples.restarts"] and before["seq"] >= 0:
            step = {key: now[key] - before[key] for key in ("seq", "samples.received", "samples.late", "samples.lost")}
            numbers = step["samples.received"] - step["samples.late"] + step["samples.lost"]
            off["numbers handled"] = abs(step["seq"] - numbers)
        last[name] = now
        for what, difference in off.items():
            if difference > worst:
                worst, where = difference, f"; most at {t_s:.0f} s in {name}: {what}"
    text = f"difference between samples sent, handled, refused and lost{where if worst > UNDER_WAY else ''}"
    return at_most(worst, UNDER_WAY, "samples", text)


# --- Which samples are in the recordings of a soak: nothing that reached the services may be missing in all of them.


def recorded(folders: list[Path]) -> tuple[Intervals, int]:
    """The numbers in the Parquet segments below ``folders``, and how many rows there are."""
    found, rows = Intervals(), 0
    for folder in folders:
        if not folder.is_dir():
            continue
        # What a killed process left open is whole but for its end.
        close_left_open(folder)
        for path in segments(folder):
            column = parquet.read_table(path, columns=["seq"]).column("seq").to_numpy()
            rows += column.size
            found.add_all(np.unique(column.astype(np.int64)))
    return found, rows
