"""For every fault of a soak: when all was well again, for how long nobody answered, and who told of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice
from typing import Final

from lab.soak.faults.catalogue import KINDS
from lab.soak.processes.machine import Machine
from lab.soak.verdict.ledger import Happened, Ledger

#: Mean |error| in a second that counts as well again, in percent of the commanded range.
WELL_PCT: Final = 0.3

#: What tells of a fault: counters of the status of which one grows (with a "+": all of them in one service), ``event``
#: for any event, ``instance`` for another instance that answers. Kinds that are missing are nobody's business.
TELLERS: Final[dict[str, tuple[str, ...]]] = {
    "kill_primary": ("instance", "event"),
    "stop_primary": ("instance", "event", "samples.lost"),
    "kill_standby": ("instance", "event"),
    "restart_stage": ("samples.restarts",),
    "restart_router": ("samples.lost", "event"),
    "disk_full": ("recorder.errors", "recorder.lost", "event"),
    "bad_queries": ("queries.errors+samples.malformed",),
    "gap": ("samples.lost",),
    "duplicate": ("samples.late",),
    "reorder": ("samples.late",),
    "nan": ("samples.gates.not_finite",),
    "spike": ("samples.gates.glitch", "samples.gates.outlier"),
    "freeze": ("samples.gates.glitch", "samples.gates.outlier", "samples.gates.unexcited", "learner.jumps", "event"),
    # A reading that stays at its end looks like a stage at rest.
    "saturate": (
        "samples.gates.glitch",
        "samples.gates.outlier",
        "samples.gates.saturated",
        "learner.jumps",
        "samples.gates.unexcited",
        "event",
    ),
    "stage_clock": ("samples.gates.timing", "samples.gates.out_of_order", "event"),
    "dwell": ("samples.gates.unexcited",),
}


def settle(ledger: Ledger, count: int | None = None) -> None:
    """Fill in when all was well again, for how long nobody answered, and who told of it: for every fault, or the first
    ``count``."""
    mae = {round(s.t_s): 100.0 * s.mae_um / ledger.range_um for s in ledger.seconds if s.judged}
    machine = Machine(ledger.bare, ledger.others)
    begins = [fault.begin_s for fault in ledger.faults[1:]]
    for fault, next_s in islice(zip(ledger.faults, [*begins, math.inf], strict=False), count):
        end = fault.end_s if math.isfinite(fault.end_s) else fault.begin_s
        last = fault.window_s[1] + 2.0
        # On a machine that is busy all takes longer: as many seconds as it was are looked at on top.
        last += machine.busy_s(end, last)
        within = ledger.probes_between(fault.begin_s, last + 1.0)
        fault.silent_s = max((p.silent_s for p in within if p.t_s <= next_s), default=0.0)
        for p in within:
            second = round(math.floor(p.t_s))
            good = [mae.get(second + i, math.inf) <= WELL_PCT for i in (0, 1)]
            if p.t_s - 1.0 >= end and not p.failed and len(p.service_us) and all(good):
                fault.recovered_s = p.t_s - 1.0
                break
        fault.busy_s = machine.busy_s(end, min(fault.recovered_s, last) if math.isfinite(fault.recovered_s) else last)
        if ledger.mode == "fast":
            for second in range(math.ceil(end), math.floor(last) + 1):
                if mae.get(second, math.inf) <= WELL_PCT:
                    fault.recovered_s = float(second)
                    break
        fault.told, fault.look_until_s = _told(ledger, fault, last), last


def _told(ledger: Ledger, fault: Happened, end: float) -> str:
    """Which counter or event told of a fault until ``end``, s; "" for none, "-" where none is asked for."""
    tellers = TELLERS.get(fault.kind)
    if tellers is None:
        return "-"
    begin = fault.begin_s
    counters = ledger.counters_between(begin - 30.0, end)
    for teller in tellers:
        if teller == "event":
            # Who comes and goes is of no interest but for those who were killed.
            alive = ("came", "gone") if not KINDS[fault.kind].ends_service else ()
            said = [e for e in ledger.events_between(begin, end) if e.get("event") not in alive]
            if said:
                return f"event {said[0].get('event')}"
        elif teller == "instance":
            before = {name for t, name, _ in counters if begin - 5.0 <= t <= begin}
            new = {name for t, name, _ in counters if begin < t <= end} - before
            gone = before - {name for t, name, _ in counters if begin + 1.5 < t <= end}
            if new or gone:
                return "another instance"
        else:
            names = teller.split("+")
            for who in {who for _, who, _ in counters}:
                if all(_grew([row for row in counters if row[1] == who], name, begin) for name in names):
                    return teller
    return ""


def _grew(rows: list[tuple[float, str, Mapping[str, float]]], name: str, begin_s: float) -> bool:
    """Whether a counter of one service was higher after ``begin_s`` than at last before it."""
    was = [row.get(name, 0.0) for t_s, _, row in rows if t_s <= begin_s]
    now = [row.get(name, 0.0) for t_s, _, row in rows if t_s > begin_s]
    return bool(now) and max(now) > (was[-1] if was else 0.0)
