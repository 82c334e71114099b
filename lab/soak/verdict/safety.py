"""The invariants of a soak that are about voltages: those that were sent, and those that the stage applied.

A stage keeps to its own limits whatever it is sent, so that each invariant takes the worst of both: of the commands as
they left the controller, before anybody limited them, and of what came back in the samples.
"""

from __future__ import annotations

from collections.abc import Iterable

from lab.soak.verdict.invariant import Invariant, most
from lab.soak.verdict.ledger import Ledger
from lab.soak.verdict.track import ROUND_OFF, Second

#: Take-overs: whose window is looked at for a jump.
TAKEOVERS = ("kill_primary", "stop_primary")
#: While no router is there, what is sent need not come to whoever watches, nor to the stage.
_UNSEEN = ("restart_router",)


def safe_voltages(ledger: Ledger) -> dict[str, Invariant]:
    """Finite, within the limits, within the slew limit."""
    seconds = ledger.seconds
    beyond_V = max((max(s.beyond_V, s.sent_beyond_V) for s in seconds), default=0.0)
    return {
        "voltages_finite": most(
            sum(s.not_finite + s.sent_not_finite for s in seconds), 0, "samples",
            "voltages sent or applied that are not finite, and commands that could not be read",
        ),
        "voltages_within_limits": most(beyond_V, 1e-9, "V", "voltage beyond its limits, as sent or as applied"),
        "voltages_within_slew": most(
            _worst_step(ledger, seconds), ROUND_OFF, "limits",
            "largest step of the voltage, as sent or as applied, over what the slew limit allows",
        ),
    }  # fmt: skip


def answers_safe(ledger: Ledger) -> Invariant:
    """What the clients themselves found in the answers that they got."""
    unsafe = sum(p.unsafe for p in ledger.probes) + ledger.unsafe_blocks
    return most(unsafe, 0, "answers", "answers that were not finite, beyond a limit or too steep")


def takeover_continuous(ledger: Ledger) -> Invariant:
    """The slew limit again, around each take-over."""
    around: list[Second] = []
    for fault in ledger.faults:
        begin, end = fault.window_s
        if fault.kind in TAKEOVERS:
            around += ledger.seconds_between(begin - 1.0, end)
    return most(_worst_step(ledger, around), ROUND_OFF, "limits", "the same, around a take-over")


def _worst_step(ledger: Ledger, seconds: Iterable[Second]) -> float:
    """In shares of what the slew limit allows."""
    unseen = [fault.window_s for fault in ledger.faults if fault.kind in _UNSEEN]
    worst_V = 0.0
    for s in seconds:
        worst_V = max(worst_V, s.step_max_V, s.sent_step_V)
        if s.resumed_V > worst_V and not any(begin - 1.0 <= s.t_s <= end for begin, end in unseen):
            worst_V = s.resumed_V
    return worst_V / ledger.step_limit_V
