"""What is done to the processes when a fault begins, and when it ends."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

from lab.soak.faults.plan import Planned
from lab.soak.processes.clocked import write_offset
from lab.soak.processes.control import AXIS, STAGE
from lab.soak.processes.controller import control_key
from lab.soak.processes.world import World
from lab.soak.verdict.monitor import Monitor
from service.stage_node.faults import DELIVERY, READING, fault_key

#: Bytes that a process may still add to a file while the disk is full.
_LITTLE = 4096
#: A status older than this, or of a sample older than this, is not that of a service that could take over, s.
_BEHIND_S = 3.0
#: What each fault of the stage is called there.
_STAGE_NAMES = {"stage_clock": "clock"}


class Actions:
    """Begins and ends faults. ``primary`` names the service that answers now; ``notes`` says what could not be done."""

    def __init__(self, world: World, monitor: Monitor) -> None:
        self.world = world
        self.monitor = monitor
        self.notes: list[str] = []
        #: Numbers of the processes that were ended on purpose.
        self.killed: set[int] = set()
        self.primary = world.services[0]
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._undo: dict[int, Callable[[], None]] = {}
        self._extras = 0

    def begin(self, index: int, fault: Planned) -> None:
        """Let the fault happen; `end` is called with the same index when its time is over."""
        kind = fault.kind
        if kind in READING or kind in DELIVERY or kind in _STAGE_NAMES:
            self._stage(fault)
        else:
            undo = getattr(self, f"_{kind}")(fault)
            if undo is not None:
                self._undo[index] = undo

    def possible(self, fault: Planned) -> bool:
        """Whether the fault may happen now: nobody ends the one service that is left while the other is not yet there.

        There is who has handled the samples of the last seconds, by a status of its own.
        """
        if fault.kind not in ("kill_primary", "kill_standby", "stop_primary"):
            return True
        monitor = self.monitor
        behind = round(_BEHIND_S / self.world.control.dt_s)
        ready = {
            self.world.by_pid(instance)
            for instance, (t_s, told) in list(monitor.statuses.items())
            if monitor.now() - t_s < _BEHIND_S
            and told.get("synced", True)
            and monitor.track.newest - int(told["seq"]) < behind
        }
        return ready >= set(self.world.services)

    def end(self, index: int) -> None:
        """Take back what `begin` did, where there is something to be taken back."""
        undo = self._undo.pop(index, None)
        if undo is not None:
            undo()

    def tick(self) -> None:
        """What is due by now: processes that are started again a little later."""
        due = [work for at, work in self._later if at <= time.monotonic()]
        self._later = [(at, work) for at, work in self._later if at > time.monotonic()]
        for work in due:
            work()

    def finish(self) -> None:
        """Take everything back, at the end of a run or in the middle of one."""
        for index in list(self._undo):
            self.end(index)
        for _, work in self._later:
            work()
        self._later = []

    # ---- the stage's samples and parameters

    def _stage(self, fault: Planned) -> None:
        c = self.world.control
        value = fault.value
        if fault.kind == "saturate":
            value = 0.5 * (c.low_um + c.high_um)
        name = _STAGE_NAMES.get(fault.kind, fault.kind)
        told = {"fault": name, "duration_s": max(fault.duration_s, c.dt_s), "value": value}
        self.monitor.put(fault_key(STAGE, AXIS), told)

    def _change(self, name: str, value: float) -> None:
        self.monitor.put(fault_key(STAGE, AXIS), {"fault": "change", "values": {name: value}})

    def _gain(self, fault: Planned) -> None:
        self._change("gain_drift.gain", fault.value)

    def _payload(self, fault: Planned) -> None:
        self._change("resonance.payload_ratio", fault.value)

    def _dwell(self, fault: Planned) -> None:
        dt_s = self.world.control.dt_s
        first = self.monitor.track.newest + round(0.3 / dt_s)
        relative = first - int(self.monitor.stage.get("first", 0))
        self.monitor.put(control_key(), {"first": relative, "ticks": round(fault.duration_s / dt_s)})

    # ---- processes

    def _kill(self, name: str) -> None:
        child = self.world.children[name]
        self.killed.add(child.pid)
        child.kill()

    def _kill_service(self, name: str) -> None:
        self._kill(name)
        # Whoever looks after a service starts it again: as the standby of the one that has taken over.
        standby = len(self.world.services) > 1
        self._later.append(
            (time.monotonic() + 1.0, lambda: self.world.start_service(name, standby=standby, wait=False))
        )

    def _kill_primary(self, _: Planned) -> None:
        self._kill_service(self.primary)

    def _kill_standby(self, _: Planned) -> None:
        others = [name for name in self.world.services if name != self.primary]
        if not others:
            self.notes.append("kill_standby: there is no standby in this run")
            return
        self._kill_service(others[0])

    def _stop_primary(self, _: Planned) -> Callable[[], None]:
        child = self.world.children[self.primary]
        child.send(signal.SIGSTOP)
        return lambda: child.send(signal.SIGCONT)

    def _kill_viewer(self, _: Planned) -> None:
        self._kill("viewer")
        self._later.append((time.monotonic() + 1.0, lambda: self.world.start_viewer(wait=False)))

    def _extra(self, what: str, *arguments: str) -> Callable[[], None]:
        self._extras += 1
        child = self.world.start_one(
            f"{what}{self._extras}", ["-m", "lab.soak.processes.extras", what, self.world.endpoint, *arguments]
        )
        # It is ended in the middle of whatever it does; its last words are read when the run ends.
        return lambda: child.send(signal.SIGTERM)

    def _slow_viewer(self, _: Planned) -> Callable[[], None]:
        return self._extra("slow")

    def _bad_queries(self, fault: Planned) -> Callable[[], None]:
        return self._extra("rubbish", str(round(1000 * fault.at_s)))

    def _cpu_stolen(self, _: Planned) -> Callable[[], None]:
        ends = [self._extra("busy") for _ in range(os.cpu_count() or 1)]

        def end_all() -> None:
            for end in ends:
                end()

        return end_all

    def _restart_stage(self, _: Planned) -> Callable[[], None]:
        self._kill("stage")
        return lambda: self.world.start_stage(wait=False)

    def _restart_router(self, _: Planned) -> Callable[[], None]:
        self._kill("router")
        return lambda: self.world.start_router(wait=False)

    # ---- the machine

    def _clock_back(self, fault: Planned) -> Callable[[], None]:
        write_offset(self.world.clock, fault.value)
        return lambda: write_offset(self.world.clock, 0.0)

    def _disk_full(self, _: Planned) -> Callable[[], None] | None:
        """No file of the services may grow: the limit that the system sets on a file's size, lowered from outside."""
        if not hasattr(resource, "prlimit"):
            self.notes.append("disk_full: this system cannot limit the files of another process; left out")
            return None
        undone: list[tuple[int, tuple[int, int]]] = []
        for name in self.world.services:
            pid = self.world.children[name].pid
            try:
                before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (_LITTLE, before[1]))
                undone.append((pid, before))
            except (OSError, ValueError) as error:
                self.notes.append(f"disk_full: not for {name}: {error}")

        def undo() -> None:
            for pid, before in undone:
                if Path(f"/proc/{pid}").exists():
                    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)

        return undo
