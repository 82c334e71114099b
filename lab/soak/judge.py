"""What must hold in a soak: each invariant with the worst value that was observed and its limit, judged at the end.

The stage enforces its own limits, so each invariant about voltages takes the worst of both: the commands as the
controller sent them, and the voltages that came back in the samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pyarrow import parquet

from dehyst.adaptive.online.sensor_trust import SENSOR_FAULTS
from dehyst.adaptive.types import FloatArray
from dehyst.lab.soak.fault_plan import FAULT_KINDS
from dehyst.lab.soak.observed import (
    NUMBERS,
    ROUND_OFF,
    Counted,
    FaultRecord,
    Intervals,
    Observations,
    SampleTracker,
    between,
    told_by,
)
from dehyst.service.answers.which_model import SAMPLES_POISONED, SENSOR_FROZEN, VOLTAGE_DIFFERS
from dehyst.service.storage.recorder import ASIDE
from dehyst.service.storage.segments import close_left_open, segments


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
        return asdict(self) | {"worst": worst}


def _at_most(worst: float | None, limit: float, unit: str, text: str, why: str = "") -> Invariant:
    """Holds if ``worst`` is at most ``limit``; not judged, for the reason ``why``, if it is None."""
    if worst is None:
        return Invariant(None, None, limit, unit, f"{text}: not judged", why)
    return Invariant(bool(worst <= limit), float(worst), limit, unit, text)


# --- Faults as they end: when all was well again, who reported them, and what a wrong sensor cost.

#: Mean |error| of a second that counts as recovered, in percent of the commanded range.
WELL_PCT: Final = 0.3
#: What reports a fault may come so much after its time to recover, s.
_TOLD_S: Final = 2.0
#: A sensor fault must have its name after so much motion, s. The mean error over any half second must stay below this,
#: percent of the range, or this multiple of the worst of the frozen model.
NAMED_S: Final = 0.5
SENSOR_PCT: Final = 1.0
OF_FROZEN: Final = 1.5
#: Troubles that name a sensor or its samples.
_NAMES: Final = SENSOR_FAULTS | {SENSOR_FROZEN, SAMPLES_POISONED, VOLTAGE_DIFFERS}


def assess(observed: Observations) -> None:
    """Fill in for every fault: when all was well again, how long no query was answered, and what reported it."""
    well = {math.floor(s.t_s) for s in observed.seconds if s.judged and 100 * s.mae_um <= WELL_PCT * observed.range_um}
    # A second of the prober lies in two seconds of the run.
    answered = {math.floor(p.t_s) - 1 for p in observed.probes if len(p.trips_us) and not p.failed}
    # A silence belongs to the fault that made it, not to the one before.
    for fault, next_s in zip(observed.faults, [*(f.begin_s for f in observed.faults[1:]), math.inf], strict=False):
        begin, until = fault.window_s[0], fault.window_s[1] + _TOLD_S
        end = fault.end_s if math.isfinite(fault.end_s) else begin
        silent = [p.silent_s for p in between(observed.probes, begin, min(until + 1.0, next_s))]
        fault.silent_s = max(silent, default=0.0)
        for second in range(math.ceil(end), math.floor(until) + 1):
            if second in well and second in answered:
                fault.recovered_s = float(second)
                break
        fault.told = told_by(observed, fault, until)


def stage_gain(faults: Sequence[FaultRecord], at_s: float) -> float:
    """Gain of the stage at ``at_s`` over that when it was identified, by the faults that changed it."""
    return 1.0 + next((f.value for f in reversed(faults) if f.kind == "gain" and f.begin_s < at_s), 0.0)


def judge_sensor_fault(
    fault: FaultRecord, track: SampleTracker, troubles: Sequence[tuple[int, str]], last_seq: int, gain: float = 1.0
) -> None:
    """Note in ``fault``, whose readings were wrong up to sample ``last_seq``, whether it was named in time and how
    large the error became. ``troubles``: (sample number, name) since it began. ``gain``: see `stage_gain`."""
    moved_s, fault.error_pct, frozen_pct = track.sensor_fault(fault.begin_seq, last_seq, gain)
    named = next((seq for seq, name in troubles if name in _NAMES and seq <= last_seq), None)
    if named is not None:
        fault.named_s = track.moved_s(fault.begin_seq, named) if named > fault.begin_seq else 0.0
        if fault.named_s > NAMED_S + track.control.block * track.control.dt_s:
            fault.breaches.append(f"named after {fault.named_s:.2f} s of motion, allowed {NAMED_S:g} s")
    elif moved_s >= NAMED_S:
        fault.breaches.append(f"not named within {moved_s:.2f} s of motion")
    else:
        fault.unjudged.append(f"named in time: the reference moved for {moved_s:.2f} s only")
    allowed_pct = max(SENSOR_PCT, OF_FROZEN * frozen_pct)
    if math.isnan(fault.error_pct):
        fault.unjudged.append("error: no half second in which every voltage came in time")
    elif fault.error_pct > allowed_pct:
        fault.breaches.append(f"error {fault.error_pct:.2f} % of range over half a second, allowed {allowed_pct:.3g} %")


# --- The invariants

#: Longest time without an answer outside fault windows, s; and the margin on top of a fault's own limit: a query that
#: was under way when it began, and the pause before the next.
SILENT_S, SILENT_MARGIN_S = 0.25, 0.15
#: Limit of the age of the snapshot that a client follows, s, which 99 % of its looks must be within.
FOLLOWED_S: Final = 0.05
#: Recovery may be seen so much later than it occurs, since whole seconds are judged, s.
RECOVERED_S: Final = 1.0
#: Limit of the mean |error| outside fault windows, in percent of the commanded range. Good runs had 0.024 to 0.032.
TRACKING_PCT: Final = 0.05
#: Limit of the growth of the memory in use, MB. Under faults a service has one of a few levels (as primary, as standby,
#: after a handover), which differ by 3 MB.
MEMORY_MB: Final = 8.0
#: The warm-up of a process, s: buffers fill. Its first and last minutes after it, s, are compared.
WARM_UP_S, COMPARED_S = 180.0, 300.0
#: Mean size of a small Python object, bytes: allocator pools over blocks, as measured in a service.
_BLOCK_BYTES: Final = 100.0
#: Samples that may be on their way when two counters are read: a message or two.
UNDER_WAY = 64


def judge(observed: Observations, missing: int) -> dict[str, Invariant]:
    """Judge all invariants, after `assess`. ``missing``: samples that were seen and are in no recording."""
    seconds, faults, probes = observed.seconds, observed.faults, observed.probes
    found = {
        "voltages_finite": _at_most(
            sum(s.not_finite for s in seconds), 0, "samples",
            "voltages sent or applied that are not finite, and commands that could not be read",
        ),
        "voltages_within_limits": _at_most(
            max((s.beyond_V for s in seconds), default=0.0), 1e-9, "V",
            "voltage beyond its limits, as sent or as applied",
        ),
        "voltages_within_slew": _at_most(
            max((s.step_V for s in seconds), default=0.0) / observed.step_limit_V, ROUND_OFF, "limits",
            "largest step of the voltage, as sent or as applied, over what the slew limit allows",
        ),
        "answers_safe": _at_most(
            sum(p.unsafe for p in probes) + observed.unsafe_blocks, 0, "answers",
            "answers that were not finite, beyond a limit or too steep",
        ),
    }  # fmt: skip
    found |= _times(observed)
    found["recovers_by_itself"] = _recovers(observed)
    found["faults_happened"] = _at_most(
        int(bool(observed.planned) and not faults), 0, "runs", "runs with a plan of which not one fault began"
    )
    # The run may have ended before a fault could be reported.
    untold = [f for f in faults if not f.told and f.window_s[1] + _TOLD_S <= observed.duration_s]
    found["faults_told"] = _at_most(len(untold), 0, "faults", "faults that no counter and no event told of")
    breaches = [f"{f.kind} at {f.begin_s:.0f} s: {', '.join(f.breaches)}" for f in faults if f.breaches]
    found["faults_held"] = _at_most(
        len(breaches), 0, "faults", "; ".join(["faults in which something did not hold that must", *breaches[:5]])
    )
    found["samples_accounted"] = _samples_accounted(observed.counters)
    found["processes_alive"] = _at_most(len(observed.ended), 0, "processes", "processes that ended by themselves")
    found["no_record_lost"] = _at_most(missing, 0, "samples", "samples that came and are in nobody's recording")
    found["tracking"] = _tracking(observed)
    found["memory"] = _memory(observed)
    return found


def _times(observed: Observations) -> dict[str, Invariant]:
    """Times without an answer, and the age of the snapshot that a client evaluates in its own process."""
    calm = observed.calm()
    # Not the one that began before the run.
    probes = [p for p in observed.probes if p.t_s >= 1.0 and calm(p.t_s) and calm(p.t_s - 1.0)]
    ages = np.concatenate([np.asarray(p.ages_s, dtype=np.float64) for p in probes]) if probes else np.zeros(0)
    over = [f.silent_s - SILENT_MARGIN_S - (FAULT_KINDS[f.kind].silent_s or SILENT_S) for f in observed.faults]
    why = "no second without a fault"
    return {
        "queries_answered": _at_most(
            max((p.silent_s for p in probes), default=None), SILENT_S, "s",
            "longest time without an answer, no fault on", why,
        ),
        "answered_again": _at_most(
            max([0.0, *over]), 0.0, "s", "time without an answer beyond what the fault allows"
        ),
        "follower_age": _at_most(
            float(np.percentile(ages, 99)) if ages.size else None, FOLLOWED_S, "s",
            "age of the snapshot in a client that follows, in 99 % of its looks, no fault on", why,
        ),
    }  # fmt: skip


def _recovers(observed: Observations) -> Invariant:
    """Longest recovery beyond its limit."""
    over: list[float] = []
    for fault in observed.faults:
        end = fault.window_s[1]
        if math.isfinite(fault.recovered_s):
            over.append(fault.recovered_s - end)
        elif end + RECOVERED_S <= observed.duration_s:
            over.append(math.inf)
    return _at_most(max([0.0, *over]), RECOVERED_S, "s", "longest beyond its time until all was well")


def _tracking(observed: Observations) -> Invariant:
    """The mean |error| of the seconds that show how good the model is: no fault, and every voltage came in time."""
    calm = observed.calm()
    held = {math.floor(s.t_s) + i for s in observed.seconds if s.held for i in (0, 1)}
    good = [s for s in observed.seconds if s.judged and calm(s.t_s) and math.floor(s.t_s) not in held]
    judged = sum(s.judged for s in good) * observed.range_um
    error_pct = 100.0 * sum(s.error_sum_um for s in good) / judged if good else None
    text = f"mean absolute error outside fault windows, over {len(good)} s in which every voltage came in time"
    return _at_most(error_pct, TRACKING_PCT, "% of range", text, "no such second")


def _memory(observed: Observations) -> Invariant:
    """Growth of what a service has in use, by the allocators of the C library and of Python: the median of its last
    minutes above that of the first after its warm-up."""
    worst = None
    for t_s, mb in memory_in_use(observed).values():
        after = t_s >= t_s[0] + WARM_UP_S
        if after.any() and np.ptp(t_s[after]) >= 2.0 * COMPARED_S:
            t_s, mb = t_s[after], mb[after]
            first, last = t_s <= t_s[0] + COMPARED_S, t_s >= t_s[-1] - COMPARED_S
            grown = float(np.median(mb[last]) - np.median(mb[first]))
            worst = grown if worst is None else max(worst, grown)
    text = f"growth of what a service has in use, its last {COMPARED_S / 60:g} min above the first after warm-up"
    return _at_most(worst, MEMORY_MB, "MB", text, "too short a run")


def memory_in_use(observed: Observations) -> dict[str, tuple[FloatArray, FloatArray]]:
    """By instance, times, s, and MB in use; none where the allocator of the C library does not say."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for now in observed.counters:
        if now["memory.malloc_bytes"]:
            used = now["memory.malloc_bytes"] + _BLOCK_BYTES * now["memory.python_blocks"]
            rows.setdefault(now.instance, []).append((now.t_s, used / 2**20))
    return {name: (np.array(r)[:, 0], np.array(r)[:, 1]) for name, r in rows.items()}


def _samples_accounted(counters: Iterable[Counted]) -> Invariant:
    """Between two statuses: numbers handled = samples handled - late + lost + left out; received = all verdicts +
    thinned + dropped.

    A learner that cannot keep up leaves samples out and says so. They count as received at once, and as left out when a
    later sample has been handled, which may be seconds after.
    """
    worst, where = 0.0, ""
    last: dict[str, Counted] = {}
    for now in counters:
        # A standby replaces its whole state, counters included, by that of the primary now and then.
        if not now["serves"]:
            last.pop(now.instance, None)
            continue
        received = now["samples.received"] - now["samples.thinned"] - now["samples.dropped"]
        off = {"received and verdicts": abs(received - now["verdicts"])}
        before = last.get(now.instance)
        if before is not None and before["samples.restarts"] == now["samples.restarts"] and before["seq"] >= 0:
            numbers = sum(sign * (now[name] - before[name]) for name, sign in NUMBERS.items())
            off["numbers handled"] = abs(now["seq"] - before["seq"] - numbers)
        last[now.instance] = now
        for what, difference in off.items():
            if difference > worst:
                worst, where = difference, f"; most at {now.t_s:.0f} s in {now.instance}: {what}"
    text = f"difference between samples sent, handled, refused and lost{where if worst > UNDER_WAY else ''}"
    return _at_most(worst, UNDER_WAY, "samples", text)


# --- Samples in the recordings


def recorded(folders: Iterable[Path]) -> tuple[Intervals, int]:
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
            found.add_all(column.astype(np.int64))
    return found, rows


def unrecordable(observed: Observations) -> Intervals:
    """Samples that the services could not record though the monitor saw them: while no file may grow, and while the
    router is gone. The services count both cases themselves."""
    excused = Intervals()
    for fault in observed.faults:
        if fault.kind in ("disk_full", "restart_router"):
            # A second earlier: those wait to be written or sent. A second of the run ends with its number.
            begin, end = fault.window_s
            before = between(observed.seconds, 0.0, begin - 2.0)
            last = between(observed.seconds, begin, end + 1.0)
            if last:
                excused.add(before[-1].seq + 1 if before else 0, last[-1].seq + 1)
    return excused
