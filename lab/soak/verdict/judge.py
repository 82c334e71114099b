"""From what a soak has seen to its verdict: the invariants, each with its worst value."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from pyarrow import parquet

from lab.soak.processes.machine import Machine
from lab.soak.verdict.invariant import Invariant, most, unjudged
from lab.soak.verdict.ledger import FAST, Ledger
from lab.soak.verdict.memory import Trend, memory_slopes, resident_growth
from lab.soak.verdict.safety import answers_safe, safe_voltages, takeover_continuous
from lab.soak.verdict.timing import answered_again, follower_age, queries_answered, recovers
from lab.soak.verdict.track import Intervals, Second
from service.storage.segments import close_left_open, segments

#: Mean |error| outside fault windows, in percent of the commanded range. Seen in runs that were well: 0.024 to 0.032.
TRACKING_PCT: Final = 0.05
MEMORY_KB_PER_HOUR: Final = 1024.0
#: What lies free between other things goes up and down by so much, of some 300 MB.
RESIDENT_MB: Final = 30.0
#: A message or two may be between two counters when they are read.
UNDER_WAY = 64


def judge(ledger: Ledger, missing: int | None, tracking_pct: float = TRACKING_PCT) -> dict[str, Invariant]:
    """All invariants; `settle` comes first. ``missing``: samples that were seen and are in no recording."""
    found = safe_voltages(ledger) | {"answers_safe": answers_safe(ledger)}
    if ledger.mode != FAST:
        machine = Machine(ledger.bare, ledger.others)
        found["takeover_continuous"] = takeover_continuous(ledger)
        found["queries_answered"] = queries_answered(ledger, machine)
        found["answered_again"] = answered_again(ledger, machine)
        found["follower_age"] = follower_age(ledger, machine)
    found["recovers_by_itself"] = recovers(ledger)
    found["faults_happened"] = most(
        int(bool(ledger.planned) and not ledger.faults), 0, "runs", "runs with a plan of which not one fault began"
    )
    found["faults_told"] = faults_told(ledger)
    found["samples_accounted"] = samples_accounted(ledger)
    found["processes_alive"] = processes_alive(ledger)
    if missing is not None:
        found["no_record_lost"] = most(missing, 0, "samples", "samples that came and are in nobody's recording")
    found["tracking"] = tracking(tracked(ledger, ledger.seconds), ledger.range_um, tracking_pct)
    # What a run in one process has in use is also the stage's and the controller's.
    short = "in one process" if ledger.mode == FAST else "too short a run"
    found["memory"] = _memory(memory_slopes(ledger), short)
    found["memory_resident"] = _resident(resident_growth(ledger), short)
    return found


def faults_told(ledger: Ledger) -> Invariant:
    """Of every fault somebody has told, or there was no time for it: the run was over."""
    untold = [fault for fault in ledger.faults if not fault.told]
    early = sum(fault.look_until_s > ledger.duration_s for fault in untold)
    text = "faults that no counter and no event told of"
    if early:
        text += f"; {early} of {len(ledger.faults)} not judged: the run was over"
    return most(len(untold) - early, 0, "faults", text)


def processes_alive(ledger: Ledger) -> Invariant:
    """Nobody ends but by a fault."""
    return most(len(ledger.ended), 0, "processes", "processes that ended by themselves")


def tracked(ledger: Ledger, seconds: list[Second]) -> list[Second]:
    """Of the ``seconds`` those that tell how good the model is: no fault on, and every voltage there in time."""
    held = {round(s.t_s) + i for s in seconds if s.held for i in (0, 1)}
    quiet = [s for s in seconds if s.judged and ledger.quiet(s.t_s) and ledger.quiet(s.t_s + 1.0)]
    return [s for s in quiet if round(s.t_s) not in held]


def tracking(quiet: list[Second], range_um: float, limit_pct: float) -> Invariant:
    """The mean |error| of those seconds."""
    return mean_error(sum(s.error_sum_um for s in quiet), sum(s.judged for s in quiet), len(quiet), range_um, limit_pct)


def mean_error(sum_um: float, judged: int, seconds: int, range_um: float, limit_pct: float) -> Invariant:
    """From the sum of |error|, µm, of so many samples in so many seconds."""
    error_pct = 100.0 * sum_um / judged / range_um if judged else None
    text = f"mean |error| outside fault windows, over {seconds} s in which every voltage came in time"
    if error_pct is None:
        return unjudged(limit_pct, "% of range", "no such second", text)
    return Invariant(error_pct <= limit_pct, error_pct, limit_pct, "% of range", text)


def _memory(trends: list[Trend], short: str) -> Invariant:
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


def _resident(grown_mb: float | None, short: str) -> Invariant:
    text = "resident memory of one of them in its last five minutes above that of the first five after warm-up"
    if grown_mb is None:
        return unjudged(RESIDENT_MB, "MB", short, text)
    return Invariant(grown_mb <= RESIDENT_MB, grown_mb, RESIDENT_MB, "MB", text)


def samples_accounted(ledger: Ledger) -> Invariant:
    """Numbers handled = samples received - late + lost, and received = all verdicts; between any two statuses."""
    worst, where = 0.0, ""
    last: dict[str, Mapping[str, float]] = {}
    for t_s, name, now in ledger.counters:
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
    return most(worst, UNDER_WAY, "samples", text)


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
