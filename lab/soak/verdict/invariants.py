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
from service.storage.recorder import ASIDE
from service.storage.segments import close_left_open, segments


@dataclass(frozen=True, slots=True)
class Invariant:
    """``held``, the worst value observed, its limit, and both in words.

    ``held`` is None if this run allows no judgement; ``why`` then gives the reason in a few words.
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
        form = {"held": self.held, "worst": worst, "limit": self.limit, "unit": self.unit, "text": self.text}

        return form | {"why": self.why}


def at_most(worst: float, limit: float, unit: str, text: str) -> Invariant:
    """Holds if ``worst`` is at most ``limit``."""
    return Invariant(bool(worst <= limit), float(worst), limit, unit, text)


def worst_of(one: Invariant, other: Invariant) -> Invariant:
    """Combine two stretches of a run: broken if one is, judged if one could be, the worst of both values."""
    found = max((one, other), key=lambda i: -math.inf if i.worst is None else i.worst)
    held = False if False in (one.held, other.held) else True if True in (one.held, other.held) else None
    return replace(found, held=held, why=found.why if held is None else "")


def sum_of(one: Invariant, other: Invariant) -> Invariant:
    """Combine two stretches of a run in which something is counted."""
    return at_most((one.worst or 0.0) + (other.worst or 0.0), other.limit, other.unit, other.text)


def unjudged(limit: float, unit: str, why: str, text: str = "") -> Invariant:
    """An invariant that this run cannot judge, and why."""
    return Invariant(None, None, limit, unit, f"{text}: not judged" if text else f"not judged: {why}", why)


# --- Voltages

#: Faults after which another service takes over.
TAKEOVERS = ("kill_primary", "stop_primary")
#: Without a router, commands may reach neither the monitor nor the stage.
_UNSEEN = ("restart_router",)


def safe_voltages(observed: Observations) -> dict[str, Invariant]:
    """Voltages are finite, within limits, and within the slew limit."""
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
    """Answers keep their promise, as checked by the clients that got them."""
    unsafe = sum(p.unsafe for p in observed.query_seconds) + observed.unsafe_blocks
    return at_most(unsafe, 0, "answers", "answers that were not finite, beyond a limit or too steep")


def takeover_continuous(observed: Observations) -> Invariant:
    """Voltages are within the slew limit around each take-over."""
    around: list[SampleSecond] = []
    for fault in observed.faults:
        begin, end = fault.window_s
        if fault.kind in TAKEOVERS:
            around += observed.seconds_between(begin - 1.0, end)
    return at_most(_worst_step(observed, around), ROUND_OFF, "limits", "the same, around a take-over")


def _worst_step(observed: Observations, seconds: Iterable[SampleSecond]) -> float:
    """Largest step as a share of what the slew limit allows."""
    unseen = [fault.window_s for fault in observed.faults if fault.kind in _UNSEEN]
    worst_V = 0.0
    for s in seconds:
        worst_V = max(worst_V, s.step_max_V, s.sent_step_V)
        if s.resumed_V > worst_V and not any(begin - 1.0 <= s.t_s <= end for begin, end in unseen):
            worst_V = s.resumed_V
    return worst_V / observed.step_limit_V


# --- Times

#: Longest time without an answer outside fault windows, s; and the margin on top of a fault's own limit: a query that
#: was under way when it began, and the pause before the next.
SILENT_S, SILENT_MARGIN_S = 0.25, 0.15
#: Limit of the age of the snapshot that a client follows, s, and the share of looks that must be within it.
FOLLOWED_S: Final = 0.05
_SHARE: Final = 0.99
#: Ages are counted in bins of this width, up to this age, s.
_RESOLUTION_S, _OLDEST_S = 1e-4, 5.0
#: Recovery may be seen so much later than it occurs, since whole seconds are judged, s.
RECOVERED_S: Final = 1.0
#: Share of the seconds, or of the faults, that must be fit to be judged.
_LEAST_SHARE: Final = 0.5
#: A fault that did not recover is not judged if the machine was busy for more than this share of its recovery time.
_EXCUSED_SHARE: Final = 0.25


def queries_answered(observed: Observations, machine: MachineLoad) -> Invariant:
    """Longest time without an answer outside fault windows."""
    calm = calm_probes(observed)
    text = "longest time without an answer, no fault on"
    if not calm:
        return unjudged(SILENT_S, "s", "no second without a fault", text)
    spans = [(p.silent_s, p.t_s - 1.0 - p.silent_s, p.t_s) for p in calm]
    judged = [span for span in spans if not machine.stalled(*span[1:])]
    over = [max(0.0, silent_s - machine.allowed_s(begin, end)) for silent_s, begin, end in judged]
    return _judged(over, len(calm), SILENT_S, text, "seconds")


def calm_probes(observed: Observations) -> list[QuerySecond]:
    """The seconds of the prober without a fault, except one that began before the run."""
    return [p for p in observed.query_seconds if p.t_s >= 1.0 and observed.quiet(p.t_s) and observed.quiet(p.t_s - 1.0)]


class Ages:
    """Histogram of the age of the snapshot that a client evaluates in its own process.

    It counts seconds without a fault in which the machine did not stall and other processes left the learner, which
    makes the snapshots, enough processor time.
    """

    def __init__(self) -> None:
        self._looks = np.zeros(round(_OLDEST_S / _RESOLUTION_S) + 1, dtype=np.int64)
        self._judged = self._of = 0

    def add(self, observed: Observations, machine: MachineLoad) -> None:
        """Add the looks of a run or of a stretch of it, each less what the machine excuses."""
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
        """The age that 1 % of the looks exceed; not judged from fewer than ``least`` seconds."""
        text = "age of the snapshot in a client that follows, in 99 % of its looks, no fault on"
        if not self._of:
            return unjudged(FOLLOWED_S, "s", "no second without a fault", text)
        if self._judged < least:
            return unjudged(FOLLOWED_S, "s", f"{self._judged} seconds so far", text)
        passed = np.cumsum(self._looks)
        worst_s = _RESOLUTION_S * float(np.searchsorted(passed, _SHARE * passed[-1])) if passed[-1] else 0.0
        return _with_share_judged(worst_s, self._judged, self._of, FOLLOWED_S, text, "seconds")


def follower_age(observed: Observations, machine: MachineLoad) -> Invariant:
    """Age of the followed snapshot over the whole run."""
    ages = Ages()
    ages.add(observed, machine)
    return ages.invariant()


def answered_again(observed: Observations, machine: MachineLoad) -> Invariant:
    """Longest time without an answer during faults, beyond what each fault allows."""
    over = []
    for fault in observed.faults:
        begin, end = fault.window_s
        allowed_s = (FAULT_KINDS[fault.kind].silent_s or SILENT_S) + SILENT_MARGIN_S
        # This fault makes the bare loop late by itself; its own limit includes that.
        if fault.kind == "cpu_stolen":
            over.append(max(0.0, fault.silent_s - allowed_s))
        elif not machine.stalled(begin, end):
            over.append(max(0.0, fault.silent_s - allowed_s - machine.allowed_s(begin, end)))
    return _judged(over, len(observed.faults), 0.0, "time without an answer beyond what the fault allows", "faults")


def recovers(observed: Observations) -> Invariant:
    """Longest recovery beyond its limit, without the seconds in which the machine was busy."""
    over: list[float] = []
    for fault in observed.faults:
        end = fault.window_s[1]
        if math.isfinite(fault.recovered_s):
            over.append(fault.recovered_s - end - fault.busy_s)
        elif end + RECOVERED_S > observed.duration_s:
            # The fault lasted longer than planned, and the run ended before its recovery time.
            continue
        elif fault.busy_s <= _EXCUSED_SHARE * FAULT_KINDS[fault.kind].recover_s:
            over.append(math.inf)
    return _judged(over, len(observed.faults), RECOVERED_S, "longest beyond its time until all was well", "faults")


def _judged(over: list[float], of: int, limit_s: float, text: str, what: str) -> Invariant:
    """``over``: the values that could be judged, of ``of``. A broken limit counts, however few they are."""
    return _with_share_judged(max(over, default=0.0), len(over), of, limit_s, text, what)


def _with_share_judged(worst: float, judged: int, of: int, limit_s: float, text: str, what: str) -> Invariant:
    left = of - judged
    if left:
        why = f"a bare loop was late by {STALLED_S:g} s, others had the cores, or the run was over"
        text += f"; {left} of {of} {what} not judged: {why}"
    if worst <= limit_s and judged < _LEAST_SHARE * of:
        return Invariant(None, worst, limit_s, "s", text, "too busy a machine")
    return Invariant(bool(worst <= limit_s), worst, limit_s, "s", text)


# --- Memory

T = TypeVar("T")

#: Warm-up of a process: half of its life, within these limits, s; buffers fill and each kind of work is done for the
#: first time for a quarter of an hour. A process must live so long after it to be judged, s.
MEMORY_WARM_S: Final = (180.0, 900.0)
MEMORY_LEAST_S: Final = 300.0
#: A process under faults uses one of a few levels of memory: as primary, as standby, after a handover of state. Three
#: processes that did not grow used 134.4 to 137.4 MB over half an hour. A line from one level to another is not
#: growth.
LEVELS_KB: Final = 4_000.0
_MINUTE_S: Final = 60.0
#: Mean size of a small Python object, bytes: allocator pools over blocks, as measured in a service.
_BLOCK_BYTES: Final = 100.0


@dataclass(frozen=True, slots=True)
class Trend:
    """A slope and its uncertainty, both kB per hour."""

    slope: float

    uncertainty: float


def memory_slopes(observed: Observations) -> list[Trend]:
    """Growth of the memory in use by the services that lived longest after their warm-up, the surest growth first;
    empty if none lived long enough. Resident memory if the allocator cannot report what is in use.

    Memory in use is that of learner, snapshots and marks: it varies by megabytes when faults take samples from the
    window or change the model or the role. A slope of 1 MB an hour shows within half an hour without faults, and
    within hours with them; the uncertainty says so.
    """
    used, levels_kb = _in_use(observed), LEVELS_KB if observed.faults else 0.0
    of = np.median if used else np.min
    trends = _longest(used or _resident(observed), lambda t, kb: _trend(*_minutes(t, kb, of), levels_kb))
    return sorted(trends, key=lambda trend: trend.uncertainty - trend.slope)


def resident_growth(observed: Observations) -> float | None:
    """Largest growth of the resident memory of those processes, MB: the minimum of the last five minutes less that of
    the first five after warm-up. None if none lived for ten minutes."""

    def growth(t_s: FloatArray, kb: FloatArray) -> float:
        first, last = t_s <= t_s[0] + MEMORY_LEAST_S, t_s >= t_s[-1] - MEMORY_LEAST_S
        return float(kb[last].min() - kb[first].min()) / 1024.0

    return max(_longest(_resident(observed), growth, 2.0 * MEMORY_LEAST_S), default=None)


def _longest(
    rows: Mapping[str, list[tuple[float, float]]],
    what: Callable[[FloatArray, FloatArray], T],
    least_s: float = MEMORY_LEAST_S,
) -> list[T]:
    """Apply ``what`` to each process that lived as long as the longest, to a minute, without its warm-up."""
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
    """By service process, (t_s, kB)."""
    found: dict[str, list[tuple[float, float]]] = {}
    for name in ("a", "b", "service"):
        for t_s, kb, number in observed.memory.get(name, []):
            found.setdefault(f"{name}-{number}", []).append((t_s, kb))
    return found


def _in_use(observed: Observations) -> dict[str, list[tuple[float, float]]]:
    """By instance, (t_s, kB): in use by the C library's and by Python's allocator."""
    found: dict[str, list[tuple[float, float]]] = {}
    for t_s, name, now in observed.counters:
        if "memory.malloc_bytes" in now:
            kb = (now["memory.malloc_bytes"] + _BLOCK_BYTES * now["memory.python_blocks"]) / 1024.0
            found.setdefault(name, []).append((t_s, kb))
    return found


def warm_up_s(lived_s: float) -> float:
    """Warm-up of a process that lived for ``lived_s``, s."""
    least_s, most_s = MEMORY_WARM_S
    return min(most_s, max(least_s, 0.5 * lived_s))


def _minutes(t_s: FloatArray, kb: FloatArray, of: Callable[[FloatArray], Any]) -> tuple[FloatArray, FloatArray]:
    """One value per minute, and the middle of the minute. Memory that is used for a moment (a handover, a checkpoint)
    is freed within a minute and is not growth."""
    minute = ((t_s - t_s[0]) // _MINUTE_S).astype(np.int64)
    there = np.unique(minute)
    return t_s[0] + _MINUTE_S * (there + 0.5), np.array([float(of(kb[minute == m])) for m in there])


def _trend(t_s: FloatArray, kb: FloatArray, levels_kb: float) -> Trend:
    """Median of the slopes between each point and the point half a run later (Theil-Sen).

    ``levels_kb``: by how much the memory in use may differ between two minutes without growth.
    """
    half = len(t_s) // 2
    slope = float(np.median((kb[half : 2 * half] - kb[:half]) / (t_s[half : 2 * half] - t_s[:half])))
    left = kb - slope * t_s
    left -= left.mean()
    square = float(left @ left)
    # Neighbouring minutes are correlated: they count as fewer independent ones.
    alike = min(max(float(left[1:] @ left[:-1]) / square, 0.0), 0.9) if square > 0.0 else 0.0
    error = math.sqrt(
        square * (1.0 + alike) / (1.0 - alike) / max(len(kb) - 2, 1) / float(np.sum((t_s - t_s.mean()) ** 2))
    )
    return Trend(3600.0 * slope, 3600.0 * max(2.0 * error, levels_kb / float(np.ptp(t_s))))


# --- All invariants

#: Limit of the mean |error| outside fault windows, in percent of the commanded range. Good runs had 0.024 to 0.032.
TRACKING_PCT: Final = 0.05
MEMORY_KB_PER_HOUR: Final = 1024.0
#: Limit of resident memory growth, MB; fragmentation varies by so much, of about 300 MB.
RESIDENT_MB: Final = 30.0
#: Samples that may be on their way when two counters are read: a message or two.
UNDER_WAY = 64
#: Counters of the status that add up to the numbers handled, with their signs.
_NUMBERS: Final = {
    "samples.received": 1, "samples.thinned": -1, "samples.dropped": -1,
    "samples.late": -1, "samples.lost": 1, "samples.left_out": 1,
}  # fmt: skip


def judge(observed: Observations, missing: int | None, tracking_pct: float = TRACKING_PCT) -> dict[str, Invariant]:
    """Judge all invariants, after `assess_recovery`. ``missing``: samples that were seen and are in no recording."""
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
    found["faults_held"] = faults_held(observed)
    found["samples_accounted"] = samples_accounted(observed)
    found["processes_alive"] = processes_alive(observed)
    if missing is not None:
        found["no_record_lost"] = at_most(missing, 0, "samples", "samples that came and are in nobody's recording")
    found["tracking"] = tracking(tracked(observed, observed.seconds), observed.range_um, tracking_pct)
    # In one process, the memory is also that of stage and controller.
    short = "in one process" if observed.mode == FAST else "too short a run"
    found["memory"] = _memory_invariant(memory_slopes(observed), short)
    found["memory_resident"] = _resident_invariant(resident_growth(observed), short)
    return found


def faults_told(observed: Observations) -> Invariant:
    """Every fault is reported by an event or a counter, unless the run ended before it could be."""
    unreported = [fault for fault in observed.faults if not fault.reported_by]
    early = sum(fault.look_until_s > observed.duration_s for fault in unreported)
    text = "faults that no counter and no event told of"
    if early:
        text += f"; {early} of {len(observed.faults)} not judged: the run was over"
    return at_most(len(unreported) - early, 0, "faults", text)


def faults_held(observed: Observations) -> Invariant:
    """What a kind of fault requires beyond recovery: a sensor fault is named and costs little, no serving instance is
    replaced without need, a frozen axis stays frozen, a folder that vanishes is reported and made again."""
    broken = [fault for fault in observed.faults if fault.breaches]
    text = "faults in which something did not hold that must in this kind"
    if broken:
        text += ": " + "; ".join(
            f"{fault.kind} at {fault.begin_s:.0f} s: {', '.join(fault.breaches)}" for fault in broken[:5]
        )
    unjudged = sum(bool(fault.unjudged) for fault in observed.faults)
    if unjudged:
        text += f"; {unjudged} of {len(observed.faults)} not judged in every part"
    return at_most(len(broken), 0, "faults", text)


def processes_alive(observed: Observations) -> Invariant:
    """No process ends except by a fault."""
    return at_most(len(observed.ended), 0, "processes", "processes that ended by themselves")


def tracked(observed: Observations, seconds: list[SampleSecond]) -> list[SampleSecond]:
    """The ``seconds`` that show how good the model is: no fault, and every voltage came in time."""
    held = {round(s.t_s) + i for s in seconds if s.held for i in (0, 1)}
    quiet = [s for s in seconds if s.judged and observed.quiet(s.t_s) and observed.quiet(s.t_s + 1.0)]
    return [s for s in quiet if round(s.t_s) not in held]


def tracking(quiet: list[SampleSecond], range_um: float, limit_pct: float) -> Invariant:
    """The mean |error| of those seconds is within its limit."""
    return mean_error(sum(s.error_sum_um for s in quiet), sum(s.judged for s in quiet), len(quiet), range_um, limit_pct)


def mean_error(sum_um: float, judged: int, seconds: int, range_um: float, limit_pct: float) -> Invariant:
    """The same from the sum of |error|, µm, over so many samples and seconds."""
    error_pct = 100.0 * sum_um / judged / range_um if judged else None
    text = f"mean |error| outside fault windows, over {seconds} s in which every voltage came in time"
    if error_pct is None:
        return unjudged(limit_pct, "% of range", "no such second", text)
    return Invariant(error_pct <= limit_pct, error_pct, limit_pct, "% of range", text)


def _memory_invariant(trends: list[Trend], short: str) -> Invariant:
    """Broken if one process grows beyond uncertainty, held if none does; otherwise this run cannot judge."""
    text = "growth of what the longest-lived serving processes have in use, after warm-up"
    if not trends:
        return unjudged(MEMORY_KB_PER_HOUR, "kB/hour", short, text)
    each = [_grows(trend) for trend in trends]
    held = False if True in each else None if None in each else True

    text, why = f"{text}, ± {trends[0].uncertainty:.0f}", ""
    if held is None:
        text += ": not judged, a run without faults (--faults none) or one of hours tells"
        why = "too short a run for its doubt"
    return Invariant(held, trends[0].slope, MEMORY_KB_PER_HOUR, "kB/hour", text, why)


def _grows(trend: Trend) -> bool | None:
    """Whether it grows by more than the limit; None if the uncertainty leaves that open."""
    slope, uncertainty = trend.slope, trend.uncertainty
    # Constant within the uncertainty, and below the limit even with it. A falling trend may hide growth.
    level = abs(slope) <= uncertainty and slope + uncertainty <= MEMORY_KB_PER_HOUR
    if level or (slope <= MEMORY_KB_PER_HOUR and uncertainty <= MEMORY_KB_PER_HOUR):
        return False
    return True if slope - uncertainty > MEMORY_KB_PER_HOUR else None


def _resident_invariant(grown_mb: float | None, short: str) -> Invariant:
    text = "resident memory of one of them in its last five minutes above that of the first five after warm-up"
    if grown_mb is None:
        return unjudged(RESIDENT_MB, "MB", short, text)
    return Invariant(grown_mb <= RESIDENT_MB, grown_mb, RESIDENT_MB, "MB", text)


def samples_accounted(observed: Observations) -> Invariant:
    """Between two statuses: numbers handled = samples handled - late + lost + left out; received = all verdicts +
    thinned + dropped.

    A learner that cannot keep up leaves samples out and says so: none of them is unaccounted for. They count as
    received at once, and as left out when a later sample has been handled, which may be seconds after.
    """
    worst, where = 0.0, ""
    last: dict[str, Mapping[str, float]] = {}
    for t_s, name, now in observed.counters:
        # A standby replaces its whole state, counters included, by that of the primary now and then.
        if "samples.received" not in now or not now.get("serves", 1.0):
            last.pop(name, None)
            continue
        verdicts = sum(value for key, value in now.items() if key.startswith("samples.gates."))
        not_handled = now.get("samples.thinned", 0) + now.get("samples.dropped", 0)
        off = {"received and verdicts": abs(now["samples.received"] - verdicts - not_handled)}
        before = last.get(name)
        if before is not None and before["samples.restarts"] == now["samples.restarts"] and before["seq"] >= 0:
            numbers = sum(sign * (now.get(key, 0) - before.get(key, 0)) for key, sign in _NUMBERS.items())
            off["numbers handled"] = abs(now["seq"] - before["seq"] - numbers)
        last[name] = now
        for what, difference in off.items():
            if difference > worst:
                worst, where = difference, f"; most at {t_s:.0f} s in {name}: {what}"
    text = f"difference between samples sent, handled, refused and lost{where if worst > UNDER_WAY else ''}"
    return at_most(worst, UNDER_WAY, "samples", text)


# --- Samples in the recordings


def recorded(folders: list[Path]) -> tuple[Intervals, int]:
    """The sample numbers in the Parquet segments of the recordings ``folders``, and the number of rows.

    Samples that the axis did not handle count too: they are in a folder of their own below each.
    """
    found, rows = Intervals(), 0
    for folder in (folder for each in folders for folder in (each, each / ASIDE)):
        if not folder.is_dir():
            continue
        # A killed process leaves a segment open; only its end is missing.
        close_left_open(folder)
        for path in segments(folder):
            column = parquet.read_table(path, columns=["seq"]).column("seq").to_numpy()
            rows += column.size
            found.add_all(np.unique(column.astype(np.int64)))
    return found, rows
