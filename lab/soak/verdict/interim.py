"""Judges a soak while it runs, once a minute, so that a run that dies on its third day leaves a verdict up to then.

Each look judges only what is new: its cost depends on the minute, not on the days before it, and it copies no more. A
fault is assessed when its recovery time is over. What only a whole run can show is judged at its end.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

from lab.soak.machine_load import MachineLoad
from lab.soak.verdict.invariants import (
    MEMORY_KB_PER_HOUR,
    RESIDENT_MB,
    TRACKING_PCT,
    Ages,
    Invariant,
    answered_again,
    answers_safe,
    faults_held,
    faults_told,
    mean_error,
    processes_alive,
    queries_answered,
    recovers,
    safe_voltages,
    samples_accounted,
    sum_of,
    takeover_continuous,
    tracked,
    unjudged,
    worst_of,
)
from lab.soak.verdict.observations import FAST, FaultRecord, Observations, assess_recovery
from lab.soak.verdict.outcome import of_kinds, soak_summary, write_summary

T = TypeVar("T")

#: Period of the looks, s of the run.
EVERY_S: Final = 60.0
#: Observations that are younger than this may not be complete yet, s.
_LAG_S: Final = 4.0
#: A fault is assessed this long after the end of its recovery time, s: on a busy machine later seconds count too.
_OVER_S: Final = 16.0
#: A fault is compared with the statuses of this time before it, s. Faults older than the second number have no effect.
_BEFORE_S, _PAST_S = 35.0, 120.0
#: Invariants that count something, so that stretches are added.
_COUNTED: Final = ("voltages_finite", "answers_safe", "faults_told", "faults_held")
#: Seconds with ages before their 99 % is judged: in fewer, the first half second of a run has too much weight.
_AGES_OF_S: Final = 60
_AT_THE_END: Final = "known only at the end"


class InterimJudge:
    """Judges observations while they are collected; see `due`.

    Parameters
    ----------
    path : of ``soak.json``. tracking_pct : limit of the mean error; None if it is known only at the end.
    """

    def __init__(
        self, observed: Observations, path: Path, say: Callable[[str], None], tracking_pct: float | None = TRACKING_PCT
    ) -> None:
        self._ledger, self._path, self._say, self._tracking_pct = observed, path, say, tracking_pct
        self._next_s = EVERY_S
        #: Until when the seconds have been judged, s; and the faults that have been assessed.
        self._until_s = 0.0
        self._settled: list[FaultRecord] = []
        self._found: dict[str, Invariant] = {}
        self._error = [0.0, 0, 0]
        self._ages = Ages()
        self._held = 0
        self._broken: set[str] = set()

    def due(self, now_s: float, samples: Callable[[], Mapping[str, int]]) -> None:
        """Once a minute: judge, report what is broken, and write ``soak.json``. ``samples`` returns its counts of
        samples."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + EVERY_S
        found = self.look(now_s, samples())
        try:
            write_summary(self._path, found)
        except OSError as error:
            self._say(f"  soak.json of the run so far: {error}")

    def look(self, now_s: float, samples: Mapping[str, int]) -> dict[str, Any]:
        """The content of ``soak.json`` as far as it is known at ``now_s``."""
        observed, until_s = self._ledger, max(now_s - _LAG_S, self._until_s)
        # The statuses and seconds just before are needed for comparison.
        fresh = _part(observed, self._until_s, until_s, now_s)
        context = _part(observed, self._until_s - 3.0, until_s, now_s)
        self._seconds(fresh, context)
        if observed.mode != FAST:
            around = _part(observed, self._until_s - 3.0, now_s, now_s)
            self._times(fresh, MachineLoad(around.loop_delays, around.other_load))
        self._faults(now_s)
        self._until_s = until_s
        found = self._invariants()
        for name in [name for name, one in found.items() if one.held is False and name not in self._broken]:
            self._broken.add(name)

            note = f"{name}: first seen broken at {now_s:.0f} s"
            self._say(f"  (!) {note}: {_value(found[name])}, {found[name].text}")
            observed.notes.append(note)
        counts = dict(samples) | {"without_their_voltage_in_time": self._held}
        # Latencies are those of this stretch: those of the whole run would have to be sorted at every look.
        stretch = soak_summary(replace(fresh, counters=[]), found, counts, over=False)
        return stretch | {"duration_s": round(now_s, 1), "faults": of_kinds(self._settled)}

    def _add(self, found: Mapping[str, Invariant]) -> None:
        for name, one in found.items():
            before = self._found.get(name)
            merge = sum_of if name in _COUNTED else worst_of
            self._found[name] = one if before is None else merge(before, one)

    def _seconds(self, fresh: Observations, context: Observations) -> None:
        """Judge voltages, samples and the error of the seconds since the last look."""
        self._add(safe_voltages(fresh) | {"answers_safe": answers_safe(fresh)})
        self._add({"samples_accounted": samples_accounted(context)})
        if fresh.mode != FAST:
            self._add({"takeover_continuous": takeover_continuous(fresh)})
        self._held += sum(s.held for s in fresh.seconds)
        for second in tracked(context, context.seconds):
            if second.t_s >= self._until_s:
                for i, value in enumerate((second.error_sum_um, second.judged, 1)):
                    self._error[i] += value

    def _times(self, fresh: Observations, machine: MachineLoad) -> None:
        """Judge times without an answer and the age of the followed snapshot, outside fault windows."""
        self._add({"queries_answered": queries_answered(fresh, machine)})
        self._ages.add(fresh, machine)

    def _faults(self, now_s: float) -> None:
        """Assess copies of the faults that are over by now; the end of the run assesses all faults again."""
        faults = self._ledger.faults
        first = last = len(self._settled)
        while last < len(faults) and faults[last].ended and faults[last].window_s[1] + _OVER_S <= now_s:
            last += 1
        if first == last:
            return
        seen = _part(self._ledger, faults[first].begin_s - _BEFORE_S, now_s, now_s)
        # With the next fault: from its beginning on, a silence belongs to it.
        copies = [replace(fault) for fault in faults[first : last + 1]]
        assess_recovery(replace(seen, faults=copies), last - first)
        part = replace(seen, faults=copies[: last - first])
        self._settled += part.faults
        self._add(
            {"recovers_by_itself": recovers(part), "faults_told": faults_told(part), "faults_held": faults_held(part)}
        )
        if part.mode != FAST:
            self._add({"answered_again": answered_again(part, MachineLoad(part.loop_delays, part.other_load))})

    def _invariants(self) -> dict[str, Invariant]:
        observed = self._ledger
        found = dict(self._found)
        # The controller counts from the beginning of the run.
        found["answers_safe"] = sum_of(found["answers_safe"], answers_safe(replace(observed, query_seconds=[])))
        found["processes_alive"] = processes_alive(observed)
        found["faults_happened"] = unjudged(0, "runs", _AT_THE_END)
        if observed.mode != FAST:
            found["follower_age"] = self._ages.invariant(_AGES_OF_S)
            found["no_record_lost"] = unjudged(0, "samples", _AT_THE_END)
        sum_um, judged, seconds = self._error
        found["tracking"] = (
            unjudged(TRACKING_PCT, "% of range", _AT_THE_END)
            if self._tracking_pct is None
            else mean_error(sum_um, int(judged), int(seconds), observed.range_um, self._tracking_pct)
        )
        found["memory"] = unjudged(MEMORY_KB_PER_HOUR, "kB/hour", _AT_THE_END)
        found["memory_resident"] = unjudged(RESIDENT_MB, "MB", _AT_THE_END)
        return found


def _part(observed: Observations, begin_s: float, end_s: float, now_s: float) -> Observations:
    """The observations from ``begin_s`` until before ``end_s``. A fault that has not ended lasts until ``now_s``."""

    def cut(rows: Sequence[T], time_of: Callable[[T], float]) -> list[T]:
        return list(rows[bisect_left(rows, begin_s, key=time_of) : bisect_left(rows, end_s, key=time_of)])

    faults = observed.faults[bisect_left(observed.faults, begin_s - _PAST_S, key=lambda fault: fault.begin_s) :]
    return replace(
        observed,
        duration_s=now_s,
        faults=[fault if fault.ended else replace(fault, end_s=now_s) for fault in faults],
        seconds=cut(observed.seconds, lambda second: second.t_s),
        query_seconds=cut(observed.query_seconds, lambda probe: probe.t_s),
        counters=cut(observed.counters, lambda row: row[0]),
        events=cut(observed.events, lambda event: float(event["t_s"])),
        loop_delays=cut(observed.loop_delays, lambda row: row[0]),
        other_load=cut(observed.other_load, lambda row: row[0]),
        memory={},
        cpu={},
        ended=[],
        notes=[],
        unsafe_blocks=0,
    )


def _value(invariant: Invariant) -> str:
    worst = "never" if invariant.worst is None else f"{invariant.worst:.4g}"
    return f"{worst} of {invariant.limit:.4g} {invariant.unit}"
