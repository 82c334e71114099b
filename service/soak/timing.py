"""The invariants of a soak that are about time, judged beside a bare loop: see :mod:`service.soak.machine`."""

from __future__ import annotations

import math
from typing import Final

from service.soak.catalogue import KINDS
from service.soak.invariant import Invariant
from service.soak.ledger import Ledger
from service.soak.machine import STALLED_S, Machine

#: Longest time without an answer outside fault windows; and what a fault's own silence may have on top: a query that
#: was under way when it began, and the pause before the next.
SILENT_S, SILENT_MARGIN_S = 0.25, 0.15
#: How long beyond its time a fault's recovery may be seen: seconds are looked at whole.
RECOVERED_S: Final = 1.0
#: Share of the seconds, or of the faults, that has to be fit to be judged.
_LEAST_SHARE: Final = 0.5
#: Share of its time to recover for which the machine has to be busy before a fault that did not is not judged.
_EXCUSED_SHARE: Final = 0.25


def queries_answered(ledger: Ledger, machine: Machine) -> Invariant:
    """The longest time without an answer outside fault windows."""
    calm = [p for p in ledger.probes if ledger.quiet(p.t_s) and ledger.quiet(p.t_s - 1.0)]
    spans = [(p.silent_s, p.t_s - 1.0 - p.silent_s, p.t_s) for p in calm]
    over = [
        silent_s - machine.allowed_s(begin, end) for silent_s, begin, end in spans if not machine.stalled(begin, end)
    ]
    return _judged(over, len(calm), SILENT_S, "longest time without an answer, no fault on", "seconds")


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
    worst = max(over, default=0.0)
    left = of - len(over)
    if left:
        why = f"a bare loop was late by {STALLED_S:g} s, others had the cores, or the run was over"
        text += f"; {left} of {of} {what} not judged: {why}"
    if worst <= limit_s and len(over) < _LEAST_SHARE * of:
        return Invariant(None, worst, limit_s, "s", text)
    return Invariant(bool(worst <= limit_s), worst, limit_s, "s", text)
