"""The faults that a soak knows: what they are, how long they last, how long everything may take to be well again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: Where a fault happens: to a process, to the stage's samples, to the reference, to the machine.
PROCESS, STAGE, REFERENCE, MACHINE = "process", "stage", "reference", "machine"


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault.

    Attributes
    ----------
    what : for people. where : see above.
    duration_s : how long it lasts, drawn between the two, s.
    recover_s : within this time after its end everything is as before: queries answered, tracking good.
    answered : whether queries are to be answered in time while it lasts. silent_s : for how long they may fail.
    ends_service : whether it ends a serving process; such come early, so that memory can be watched afterwards.
    fast : whether a run in one process can suffer it.
    """

    what: str
    where: str
    duration_s: tuple[float, float]
    recover_s: float
    silent_s: float = 0.0
    ends_service: bool = False
    fast: bool = False


KINDS: Final[dict[str, Kind]] = {
    "kill_primary": Kind("kill -9 of the serving process", PROCESS, (0.0, 0.0), 8.0, 0.2, True),
    "stop_primary": Kind("SIGSTOP of the serving process", PROCESS, (2.0, 3.0), 8.0, 4.0),
    "kill_standby": Kind("kill -9 of the standby", PROCESS, (0.0, 0.0), 8.0, 0.0, True),
    "kill_viewer": Kind("kill -9 of the viewer's stream", PROCESS, (0.0, 0.0), 3.0),
    "slow_viewer": Kind("a subscriber that takes 50 ms for each message", PROCESS, (2.0, 4.0), 3.0),
    "restart_stage": Kind("kill -9 of the stage, and another one counting anew", PROCESS, (0.5, 1.5), 10.0),
    "restart_router": Kind("kill -9 of the router, and another one in its place", PROCESS, (0.2, 0.5), 12.0, 8.0),
    "clock_back": Kind("the wall clock of the service set back by an hour", MACHINE, (2.0, 4.0), 3.0),
    "disk_full": Kind("no more bytes for the recordings", MACHINE, (3.0, 5.0), 10.0),
    "cpu_stolen": Kind("a busy process for each core", MACHINE, (1.5, 3.0), 4.0, 0.5),
    "bad_queries": Kind("a burst of malformed, foreign and oversized messages to every key", PROCESS, (1.0, 2.0), 3.0),
    "gap": Kind("samples that never come", STAGE, (0.3, 2.0), 5.0, fast=True),
    "duplicate": Kind("every sample twice", STAGE, (0.5, 2.0), 3.0, fast=True),
    "reorder": Kind("messages in the wrong order", STAGE, (0.5, 2.0), 3.0, fast=True),
    "nan": Kind("readings that are not numbers", STAGE, (0.5, 2.0), 5.0, fast=True),
    "spike": Kind("every 25th reading off by 30 µm", STAGE, (0.5, 2.0), 5.0, fast=True),
    "freeze": Kind("a sensor that repeats its last reading", STAGE, (0.5, 2.0), 8.0, fast=True),
    "saturate": Kind("a sensor that ends half way", STAGE, (0.5, 2.0), 8.0, fast=True),
    "stage_clock": Kind("the stage's clock set back by an hour", STAGE, (1.0, 2.0), 5.0, fast=True),
    "gain": Kind("the stage's gain changes by some percent, for good", STAGE, (0.0, 0.0), 12.0, fast=True),
    "payload": Kind("the moved mass doubles, or halves again", STAGE, (0.0, 0.0), 10.0, fast=True),
    "dwell": Kind("the reference rests", REFERENCE, (2.0, 4.0), 4.0, fast=True),
}
