"""The invariants of a soak that are about time, judged beside a bare loop: see :mod:`lab.soak.processes.machine`."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lab.soak.faults.catalogue import KINDS
from lab.soak.processes.machine import STALLED_S, Machine
from lab.soak.verdict.invariant import Invariant, unjudged
from lab.soak.verdict.ledger import Ledger, Probe

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


def queries_answered(ledger: Ledger, machine: Machine) -> Invariant:
    """The longest time without an answer outside fault windows."""
    calm = calm_probes(ledger)
    text = "longest time without an answer, no fault on"
    if not calm:
        return unjudged(SILENT_S, "s", "no second without a fault", text)
    spans = [(p.silent_s, p.t_s - 1.0 - p.silent_s, p.t_s) for p in calm]
    judged = [span for span in spans if not machine.stalled(*span[1:])]
    over = [max(0.0, silent_s - machine.allowed_s(begin, end)) for silent_s, begin, end in judged]
    return _judged(over, len(calm), SILENT_S, text, "seconds")


def calm_probes(ledger: Ledger) -> list[Probe]:
    """The seconds of the prober in which no fault was on; of one that began before the run nobody can say."""
    return [p for p in ledger.probes if p.t_s >= 1.0 and ledger.quiet(p.t_s) and ledger.quiet(p.t_s - 1.0)]


class Ages:
    """How old the snapshot was that a client evaluates in its own process: how many looks found which age.

    Seconds without a fault are judged in which the machine had not stood still, and others had left the learner, from
    which a snapshot comes, a processor to learn on.
    """

    def __init__(self) -> None:
        self._looks = np.zeros(round(_OLDEST_S / _RESOLUTION_S) + 1, dtype=np.int64)
        self._judged = self._of = 0

    def add(self, ledger: Ledger, machine: Machine) -> None:
        """The looks of a run, or of a stretch of it; each less what the machine is allowed."""
        for p in calm_probes(ledger):
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


def follower_age(ledger: Ledger, machine: Machine) -> Invariant:
    """Of the whole run."""
    ages = Ages()
    ages.add(ledger, machine)
    return ages.invariant()


def answered_again(ledger: Ledger, machine: Machine) -> Invariant:
    """The longest time without an answer during faults, beyond what each allows."""
    over = []
    for fault in ledger.faults:
        begin, end = fault.window_s
        allowed_s = (KINDS[fault.kind].silent_s or SILENT_S) + SILENT_MARGIN_S
        # Those that take the processor away make the bare loop late by themselves, and have that in their own limit.
        if fault.kind == "cpu_stolen":
            over.append(max(0.0, fault.silent_s - allowed_s))
        elif not machine.stalled(begin, end):
            over.append(max(0.0, fault.silent_s - allowed_s - machine.allowed_s(begin, end)))
    return _judged(over, len(ledger.faults), 0.0, "time without an answer beyond what the fault allows", "faults")


def recovers(ledger: Ledger) -> Invariant:
    """The longest that anything took to be well again beyond its time, the seconds of a busy machine left out."""
    over: list[float] = []
    for fault in ledger.faults:
        end = fault.window_s[1]
        if math.isfinite(fault.recovered_s):
            over.append(fault.recovered_s - end - fault.busy_s)
        elif end + RECOVERED_S > ledger.duration_s:
            # It lasted longer than planned, and the run was over before its time was.
            continue
        elif fault.busy_s <= _EXCUSED_SHARE * KINDS[fault.kind].recover_s:
            over.append(math.inf)
    return _judged(over, len(ledger.faults), RECOVERED_S, "longest beyond its time until all was well", "faults")


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
