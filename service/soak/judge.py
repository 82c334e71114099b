"""From what a soak has seen to its verdict: the invariants, each with its worst value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from service.soak.invariant import Invariant, most
from service.soak.ledger import Ledger
from service.soak.machine import Machine
from service.soak.outcome import Trend, memory_slope, resident_growth
from service.soak.timing import answered_again, queries_answered, recovers

#: Mean |error| outside fault windows, in percent of the commanded range.
TRACKING_PCT: Final = 0.1
MEMORY_KB_PER_HOUR: Final = 1024.0
#: What lies free between other things goes up and down by so much, of some 300 MB.
RESIDENT_MB: Final = 30.0
#: A message or two may be between two counters when they are read.
UNDER_WAY = 64


def judge(ledger: Ledger, missing: int | None, tracking_pct: float = TRACKING_PCT) -> dict[str, Invariant]:
    """All invariants; `settle` comes first. ``missing``: samples that were seen and are in no recording."""
    seconds, probes = ledger.seconds, ledger.probes
    held = {round(s.t_s) + i for s in seconds if s.held for i in (0, 1)}
    quiet = [s for s in seconds if s.judged and ledger.quiet(s.t_s) and ledger.quiet(s.t_s + 1.0)]
    quiet = [s for s in quiet if round(s.t_s) not in held]
    judged = sum(s.judged for s in quiet)
    error_pct = 100.0 * sum(s.error_sum_um for s in quiet) / judged / ledger.range_um if judged else None
    step = max((s.step_max_V for s in seconds), default=0.0) / ledger.step_limit_V
    found = {
        "voltages_finite": most(sum(s.not_finite for s in seconds), 0, "samples", "applied voltages that are finite"),
        "voltages_within_limits": most(
            max((s.beyond_V for s in seconds), default=0.0), 1e-9, "V", "applied voltage beyond its limits"
        ),
        "voltages_within_slew": most(
            step, 1.0 + 1e-6, "limits", "largest step of the applied voltage, over what the slew limit allows"
        ),
        "answers_safe": most(
            sum(p.unsafe for p in probes) + ledger.unsafe_blocks,
            0,
            "answers",
            "answers that were not finite, beyond a limit or too steep",
        ),
    }
    if ledger.mode != "fast":
        takeovers = [f.window_s for f in ledger.faults if f.kind in ("kill_primary", "stop_primary")]
        steps = [s.step_max_V for s in seconds if any(a - 1.0 <= s.t_s <= b for a, b in takeovers)]
        found["takeover_continuous"] = most(
            max(steps, default=0.0) / ledger.step_limit_V, 1.0 + 1e-6, "limits", "the same, around a take-over"
        )
        machine = Machine(ledger.bare, ledger.others)
        found["queries_answered"] = queries_answered(ledger, machine)
        found["answered_again"] = answered_again(ledger, machine)
    found["recovers_by_itself"] = recovers(ledger)
    found["faults_happened"] = most(
        int(bool(ledger.planned) and not ledger.faults), 0, "runs", "runs with a plan of which not one fault began"
    )
    found["faults_told"] = most(
        sum(1 for f in ledger.faults if not f.told), 0, "faults", "faults that no counter and no event told of"
    )
    found["samples_accounted"] = _accounted(ledger)
    found["processes_alive"] = most(len(ledger.ended), 0, "processes", "processes that ended by themselves")
    if missing is not None:
        found["no_record_lost"] = most(missing, 0, "samples", "samples that came and are in nobody's recording")
    found["tracking"] = Invariant(
        None if error_pct is None else error_pct <= tracking_pct, error_pct, tracking_pct, "% of range",
        f"mean |error| outside fault windows, over {len(quiet)} s in which every voltage came in time"
        + ("" if quiet else ": not judged"),
    )  # fmt: skip
    found["memory"] = _memory(memory_slope(ledger))
    grown = resident_growth(ledger)
    found["memory_resident"] = Invariant(
        grown is None or grown <= RESIDENT_MB, grown, RESIDENT_MB, "MB",
        "resident memory of that process in its last five minutes above that of the first five after warm-up"
        + ("" if grown is not None else ": too short a run to judge"),
    )  # fmt: skip
    return found


def _memory(trend: Trend | None) -> Invariant:
    """Broken where it grows beyond doubt, held where it does not; else this run cannot tell, and says so."""
    text = "growth of what the longest-lived serving process has in use, after warm-up"
    if trend is None:
        return Invariant(True, None, MEMORY_KB_PER_HOUR, "kB/hour", f"{text}: too short a run to judge")
    held: bool | None = None
    if trend.slope <= MEMORY_KB_PER_HOUR and trend.doubt <= MEMORY_KB_PER_HOUR:
        held = True
    elif trend.slope - trend.doubt > MEMORY_KB_PER_HOUR:
        held = False
    told = f"{text}, ± {trend.doubt:.0f}"
    if held is None:
        told += ": not judged, a run without faults (--faults none) or one of hours tells"
    return Invariant(held, trend.slope, MEMORY_KB_PER_HOUR, "kB/hour", told)


def _accounted(ledger: Ledger) -> Invariant:
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
