"""What a fault does to the processes when it begins and when it ends."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from lab.soak.controller import AXIS, STAGE, dwell_key
from lab.soak.fault_plan import PlannedFault
from lab.soak.rig import SERVICES, SoakRig
from lab.soak.verdict.observations import Monitor
from lab.testbed.shifted_clock import write_offset
from service.protocol.keys import Keys
from service.stage_node.faults import DELIVERY, READING, fault_key

#: Bytes that a process may still add to a file while the disk is full.
_DISK_FULL_BYTES: Final = 4096
#: A service can take over if its status, and the newest sample in it, are not older than this, s.
_BEHIND_S: Final = 3.0
#: Faults whose name in the stage's protocol differs.
_STAGE_NAMES: Final = {"stage_clock": "clock"}
#: A process that was killed is started again after this time, s.
_RESTART_S: Final = 1.0

Undo = Callable[[], None]


class FaultActions:
    """Begins and ends faults.

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
        self._undo: dict[int, Undo] = {}
        self._disturbers = 0
        self._begin: dict[str, Callable[[PlannedFault], Undo | None]] = {
            "gain": lambda fault: self._change_stage("gain_drift.gain", fault.value),
            "payload": lambda fault: self._change_stage("resonance.payload_ratio", fault.value),
            "dwell": self._dwell,
            "kill_primary": lambda _: self._kill_service(self.primary),
            "kill_standby": lambda _: self._kill_service(next(name for name in SERVICES if name != self.primary)),
            "stop_primary": lambda _: self._stop_primary(),
            "kill_viewer": lambda _: self._kill_viewer(),
            "slow_viewer": lambda _: self._disturb("slow"),
            "bad_queries": lambda fault: self._disturb("malformed", str(round(1000 * fault.at_s))),
            "cpu_stolen": lambda _: self._occupy_cores(),
            "restart_stage": lambda _: self._restart("stage", self._soak.start_stage),
            "restart_router": lambda _: self._restart("router", lambda: self._soak.rig.start_router(wait=False)),
            "clock_back": self._set_clock_back,
            "disk_full": lambda _: self._fill_disk(),
            **dict.fromkeys((*READING, *DELIVERY, *_STAGE_NAMES), self._disturb_samples),
        }

    def begin(self, index: int, fault: PlannedFault) -> None:
        """Begin a fault; `end` is called with the same index when it is over."""
        undo = self._begin[fault.kind](fault)
        if undo is not None:
            self._undo[index] = undo

    def possible(self, fault: PlannedFault) -> bool:
        """Whether the fault may happen now: the one service that is ready is not ended before the other one is ready.

        A service is ready if its own status says that it has handled the samples of the last seconds.
        """
        if fault.kind not in ("kill_primary", "kill_standby", "stop_primary"):
            return True
        monitor = self._monitor
        behind = round(_BEHIND_S / self._soak.task.dt_s)
        ready = {
            self._soak.service_of(instance)
            for instance, (t_s, status) in list(monitor.statuses.items())
            if monitor.now() - t_s < _BEHIND_S
            and status.get("synced", True)
            and monitor.track.newest - int(status["seq"]) < behind
        }
        return ready >= set(SERVICES)

    def end(self, index: int) -> None:
        """Undo what `begin` did, if it can be undone."""
        undo = self._undo.pop(index, None)
        if undo is not None:
            undo()

    def tick(self) -> None:
        """Start the processes again that are due to be."""
        due = [work for at, work in self._later if at <= time.monotonic()]
        self._later = [(at, work) for at, work in self._later if at > time.monotonic()]
        for work in due:
            work()

    def finish(self) -> None:
        """Undo everything, at the end of a run or when it is interrupted."""
        for index in list(self._undo):
            self.end(index)
        for _, work in self._later:
            work()
        self._later = []

    # ---- the samples and parameters of the stage, and the reference

    def _disturb_samples(self, fault: PlannedFault) -> None:
        task, value = self._soak.task, fault.value
        if fault.kind == "saturate":
            value = 0.5 * (task.low_um + task.high_um)
        name = _STAGE_NAMES.get(fault.kind, fault.kind)
        order = {"fault": name, "duration_s": max(fault.duration_s, task.dt_s), "value": value}
        self._monitor.put(fault_key(STAGE, AXIS), order)

    def _change_stage(self, name: str, value: float) -> None:
        self._monitor.put(fault_key(STAGE, AXIS), {"fault": "change", "values": {name: value}})

    def _dwell(self, fault: PlannedFault) -> None:
        dt_s = self._soak.task.dt_s
        first = self._monitor.track.newest + round(0.3 / dt_s)
        relative = first - int(self._monitor.stage.get("first", 0))
        self._monitor.put(dwell_key(), {"first": relative, "ticks": round(fault.duration_s / dt_s)})

    # ---- processes

    def _kill(self, name: str) -> None:
        child = self._soak.children[name]
        self.killed.add(child.pid)
        child.kill()

    def _start_later(self, start: Callable[[], None]) -> None:
        self._later.append((time.monotonic() + _RESTART_S, start))

    def _kill_service(self, name: str) -> None:
        self._kill(name)
        # A supervisor starts it again, as the standby of the service that has taken over.
        self._start_later(lambda: self._soak.start_service(name, standby=True))

    def _stop_primary(self) -> Undo:
        child = self._soak.children[self.primary]
        child.send(signal.SIGSTOP)
        return lambda: child.send(signal.SIGCONT)

    def _kill_viewer(self) -> None:
        self._kill("viewer")
        self._start_later(self._soak.start_viewer)

    def _restart(self, name: str, start: Callable[[], object]) -> Undo:
        self._kill(name)

        def start_again() -> None:
            start()

        return start_again

    def _disturb(self, what: str, *arguments: str) -> Undo:
        self._disturbers += 1
        return self._soak.start_disturber(what, self._disturbers, Keys(STAGE, AXIS).base, *arguments)

    def _occupy_cores(self) -> Undo:
        ends = [self._disturb("busy") for _ in range(os.cpu_count() or 1)]

        def end_all() -> None:
            for end in ends:
                end()

        return end_all

    # ---- the machine

    def _set_clock_back(self, fault: PlannedFault) -> Undo:
        write_offset(self._soak.wall_clock, fault.value)
        return lambda: write_offset(self._soak.wall_clock, 0.0)

    def _fill_disk(self) -> Undo | None:
        """No file of the services may grow: lower the system's limit on their file size."""
        if sys.platform != "linux":
            self.notes.append("disk_full: this system cannot limit the files of another process; left out")
            return None
        limited: list[tuple[int, tuple[int, int]]] = []
        for name in SERVICES:
            pid = self._soak.children[name].pid
            try:
                before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (_DISK_FULL_BYTES, before[1]))
                limited.append((pid, before))
            except (OSError, ValueError) as error:
                self.notes.append(f"disk_full: not for {name}: {error}")

        def undo() -> None:
            for pid, before in limited:
                if Path(f"/proc/{pid}").exists():
                    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)

        return undo
