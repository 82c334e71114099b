"""What each fault of a soak does when it begins and when it ends."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from dehyst.lab.soak.controller import AXIS, STAGE
from dehyst.lab.soak.fault_plan import CHANGES, PlannedFault
from dehyst.lab.soak.observed import Monitor
from dehyst.lab.soak.rig import SERVICES, SoakRig
from dehyst.lab.testbed.shifted_clock import write_offset
from dehyst.service.stage_node.faults import DELIVERY, READING, fault_key

#: Bytes that a process may still add to a file while the disk is full.
_DISK_FULL_BYTES: Final = 4096
#: A service can take over if its status, and the newest sample in it, are not older than this, s.
_BEHIND_S: Final = 3.0
#: A process that was killed is started again after this time, s.
_RESTART_S: Final = 1.0

#: What ends a fault; None if it ends by itself.
Undo = Callable[[], object] | None


class FaultActions:
    """Begins and ends faults, one at a time.

    Attributes
    ----------
    primary : name of the service that answers now. killed : ids of the processes that were ended on purpose.
    notes : what could not be done.
    """

    def __init__(self, soak: SoakRig, monitor: Monitor) -> None:
        self.notes: list[str] = []
        self.killed: set[int] = set()
        self.primary = SERVICES[0]
        self._soak = soak
        self._monitor = monitor
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._undo: Undo = None
        self._disturbers = 0
        self._kinds: dict[str, Callable[[PlannedFault], Undo]] = {
            **dict.fromkeys(
                CHANGES, lambda fault: self._tell_stage("change", values={CHANGES[fault.kind]: fault.value})
            ),
            "kill_primary": lambda _: self._kill_service(self.primary),
            "kill_standby": lambda _: self._kill_service(next(name for name in SERVICES if name != self.primary)),
            "stop_primary": lambda _: self._stop_primary(),
            "kill_viewer": lambda _: self._kill("viewer", soak.start_viewer),
            "slow_viewer": lambda _: self._disturb("slow"),
            "liar": lambda _: self._disturb("liar"),
            "cpu_stolen": lambda _: self._disturb("busy", os.cpu_count() or 1),
            "restart_stage": lambda _: self._restart("stage", soak.start_stage),
            "restart_router": lambda _: self._restart("router", lambda: soak.rig.start_router(wait=False)),
            "clock_back": self._set_clock_back,
            "disk_full": lambda _: self._fill_disk(),
            **dict.fromkeys((*READING, *DELIVERY, "stage_clock"), self._disturb_samples),
        }

    def begin(self, fault: PlannedFault) -> None:
        """Begin a fault; `end` is called when it is over."""
        self._undo = self._kinds[fault.kind](fault)

    def possible(self, fault: PlannedFault) -> bool:
        """Whether the fault may happen now: the one service that is ready is not ended before the other one is ready.

        A service is ready if its own status says that it has handled the samples of the last seconds.
        """
        if fault.kind not in ("kill_primary", "kill_standby", "stop_primary"):
            return True
        monitor = self._monitor
        behind = round(_BEHIND_S / self._soak.task.dt_s)
        ready = {
            self._soak.service_of(str(status["instance"]))
            for status in monitor.recent(_BEHIND_S)
            if status.get("synced", True) and monitor.track.newest - int(status["seq"]) < behind
        }
        return ready >= set(SERVICES)

    def end(self) -> None:
        """Undo what `begin` did, if it can be undone."""
        if self._undo is not None:
            self._undo()
        self._undo = None

    def tick(self) -> None:
        """Start the processes again that are due to be."""
        now = time.monotonic()
        due = [work for at, work in self._later if at <= now]
        self._later = [(at, work) for at, work in self._later if at > now]
        for work in due:
            work()

    def finish(self) -> None:
        """Undo everything, at the end of a run or when it is interrupted."""
        self.end()
        for _, work in self._later:
            work()
        self._later = []

    # ---- the samples and parameters of the stage

    def _tell_stage(self, fault: str, **more: Any) -> None:
        self._monitor.put(fault_key(STAGE, AXIS), {"fault": fault, **more})

    def _disturb_samples(self, fault: PlannedFault) -> None:
        task = self._soak.task
        name, value = fault.for_stage(task.low_um, task.high_um)
        self._tell_stage(name, duration_s=max(fault.duration_s, task.dt_s), value=value)

    # ---- processes

    def _kill(self, name: str, again: Callable[[], None] | None = None) -> None:
        """Kill a process; ``again`` starts it again a second later."""
        child = self._soak.children[name]
        self.killed.add(child.pid)
        child.kill()
        if again is not None:
            self._later.append((time.monotonic() + _RESTART_S, again))

    def _kill_service(self, name: str) -> None:
        # A supervisor starts it again, as the standby of the service that has taken over.
        self._kill(name, lambda: self._soak.start_service(name, standby=True))

    def _stop_primary(self) -> Undo:
        child = self._soak.children[self.primary]
        child.send(signal.SIGSTOP)
        return lambda: child.send(signal.SIGCONT)

    def _restart(self, name: str, start: Callable[[], object]) -> Undo:
        self._kill(name)
        return start

    def _disturb(self, what: str, processes: int = 1) -> Undo:
        children = []
        for _ in range(processes):
            self._disturbers += 1
            children.append(self._soak.start_disturber(f"{what}{self._disturbers}", what))

        def end_them() -> None:
            for child in children:
                child.send(signal.SIGTERM)

        return end_them

    # ---- the machine

    def _set_clock_back(self, fault: PlannedFault) -> Undo:
        write_offset(self._soak.wall_clock, fault.value)
        return lambda: write_offset(self._soak.wall_clock, 0.0)

    def _fill_disk(self) -> Undo:
        """No file of the services may grow: lower the system's limit on their file size."""
        if sys.platform != "linux":
            self.notes.append("disk_full: this system cannot limit the files of another process; left out")
            return None
        pids = [self._soak.children[name].pid for name in SERVICES]
        before = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in pids}
        for pid, limits in before.items():
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (_DISK_FULL_BYTES, limits[1]))

        def give_room() -> None:
            for pid, limits in before.items():
                if Path(f"/proc/{pid}").exists():
                    resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)

        return give_room
