"""What each fault of a soak does when it begins and when it ends, and what must hold in a fault of its own kind."""

from __future__ import annotations

import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import zenoh

from dehyst.lab.soak.controller import AXIS, SERVED, STAGE, dwell_key
from dehyst.lab.soak.fault_plan import CHANGES, PlannedFault
from dehyst.lab.soak.observed import Monitor
from dehyst.lab.soak.rig import SERVICES, SoakRig
from dehyst.lab.testbed.shifted_clock import write_offset
from dehyst.service.operating.remote import operate
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.query import Trajectory, decode_reply, encode_query
from dehyst.service.stage_node.faults import DELIVERY, READING, fault_key

#: Bytes that a process may still add to a file while the disk is full.
_DISK_FULL_BYTES: Final = 4096
#: A service can take over if its status, and the newest sample in it, are not older than this, s.
_BEHIND_S: Final = 3.0
#: A process that was killed is started again after this time, s.
_RESTART_S: Final = 1.0

#: Time for a stranger's process to end, s; age of a status that counts as present, s; step of the readings while
#: frozen, µm.
_END_S: Final = 10.0
_FRESH_S: Final = 1.6
_STEP_UM: Final = 20.0

#: A fault under way: it yields how long it waits, s, before its next step. The step after `_UNTIL_END` ends it.
Course = Iterator[float]
_UNTIL_END: Final = math.inf


def _answer(session: zenoh.Session, query: bytes) -> Trajectory | None:
    for reply in session.get(Keys(STAGE, AXIS).feedforward, payload=query, timeout=2.0):
        if reply.ok is not None:
            return decode_reply(reply.ok.payload.to_bytes())
    return None


class FaultActions:
    """Begins and ends faults, one at a time.

    Attributes
    ----------
    primary : name of the service that answers now. killed : ids of the processes that were ended on purpose.
    notes : what could not be done. breaches, unjudged : of the fault under way, what had to hold and did not, and what
    could not be judged, in words; `end` leaves them complete.
    """

    def __init__(self, soak: SoakRig, monitor: Monitor) -> None:
        self.notes: list[str] = []
        self.breaches: list[str] = []
        self.unjudged: list[str] = []
        self.killed: set[int] = set()
        self.primary = SERVICES[0]
        self._soak = soak
        self._monitor = monitor
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._course: Course = iter(())
        self._next_s = _UNTIL_END
        self._disturbers = 0
        #: What begins each kind: it returns None if nothing is to be undone.
        self._kinds: dict[str, Callable[[PlannedFault], Course | None]] = {
            **dict.fromkeys(
                CHANGES, lambda fault: self._tell_stage("change", values={CHANGES[fault.kind]: fault.value})
            ),
            "dwell": self._dwell,
            "kill_primary": lambda _: self._kill_service(self.primary),
            "kill_standby": lambda _: self._kill_service(next(name for name in SERVICES if name != self.primary)),
            "stop_primary": lambda _: self._stop_primary(),
            "kill_viewer": lambda _: self._kill("viewer", soak.start_viewer),
            "slow_viewer": lambda _: self._disturb("slow"),
            "bad_queries": lambda fault: self._disturb("malformed", seed=round(1000 * fault.at_s)),
            "cpu_stolen": lambda _: self._disturb("busy", os.cpu_count() or 1),
            "restart_stage": lambda _: self._restart("stage", soak.start_stage),
            "restart_router": lambda _: self._restart("router", lambda: soak.rig.start_router(wait=False)),
            "clock_back": self._set_clock_back,
            "disk_full": lambda _: self._fill_disk(),
            "forged_state": lambda fault: self._strange(fault, "forge", str(soak.model)),
            "rogue_claim": lambda fault: self._strange(fault, "claim"),
            "folder_removed": lambda _: self._take_folders_away(),
            "freeze_restart": lambda _: self._freeze_and_kill(),
            **dict.fromkeys((*READING, *DELIVERY, "stage_clock"), self._disturb_samples),
        }

    def begin(self, fault: PlannedFault) -> None:
        """Begin a fault; `end` is called when it is over."""
        self.breaches, self.unjudged = [], []
        self._course = self._kinds[fault.kind](fault) or iter(())
        self._advance()

    def _advance(self) -> None:
        self._next_s = time.monotonic() + next(self._course, _UNTIL_END)

    def possible(self, fault: PlannedFault) -> bool:
        """Whether the fault may happen now: the one service that is ready is not ended before the other one is ready.

        A service is ready if its own status says that it has handled the samples of the last seconds.
        """
        if fault.kind not in ("kill_primary", "kill_standby", "stop_primary", "freeze_restart", "forged_state"):
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
        for _ in self._course:
            pass

    def tick(self) -> None:
        """Go on with the fault under way, and start the processes again that are due to be."""
        now = time.monotonic()
        if now >= self._next_s:
            self._advance()
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

    # ---- the samples and parameters of the stage, and the reference

    def _tell_stage(self, fault: str, **more: Any) -> None:
        self._monitor.put(fault_key(STAGE, AXIS), {"fault": fault, **more})

    def _disturb_samples(self, fault: PlannedFault) -> None:
        task = self._soak.task
        name, value = fault.for_stage(task.low_um, task.high_um)
        self._tell_stage(name, duration_s=max(fault.duration_s, task.dt_s), value=value)

    def _dwell(self, fault: PlannedFault) -> None:
        dt_s = self._soak.task.dt_s
        first = self._monitor.track.newest + round(0.3 / dt_s) - int(self._monitor.stage.get("first", 0))
        self._monitor.put(dwell_key(), {"first": first, "ticks": round(fault.duration_s / dt_s)})

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

    def _stop_primary(self) -> Course:
        child = self._soak.children[self.primary]
        child.send(signal.SIGSTOP)
        yield _UNTIL_END
        child.send(signal.SIGCONT)

    def _restart(self, name: str, start: Callable[[], object]) -> Course:
        self._kill(name)
        yield _UNTIL_END
        start()

    def _disturb(self, what: str, processes: int = 1, seed: int = 0) -> Course:
        base = Keys(STAGE, AXIS).base
        children = []
        for _ in range(processes):
            self._disturbers += 1
            children.append(self._soak.start_helper("disturbers", f"{what}{self._disturbers}", what, base, str(seed)))
        yield _UNTIL_END
        for child in children:
            child.send(signal.SIGTERM)

    def _strange(self, fault: PlannedFault, what: str, *arguments: str) -> Course:
        """A stranger tries to move a service: who serves goes on serving, and it is told nothing."""
        served = self._serving()
        self._disturbers += 1
        seed = str(round(1000 * fault.at_s))
        child = self._soak.start_helper("strangers", f"{what}{self._disturbers}", what, seed, *arguments)
        yield _UNTIL_END
        child.send(signal.SIGTERM)
        child.wait(_END_S)
        told, now = child.last_json(), self._serving()
        if told["states"]:
            self.breaches.append(f"a stranger was given the state {told['states']} times")
        if not told["tried"]:
            self.unjudged.append("the stranger came to nothing")
        if served and now and served != now:
            self.breaches.append(f"{now[0]} serves as number {now[1]}, before {served[0]} as number {served[1]}")
        since_s = self._monitor.now() - fault.duration_s
        events = [str(e["event"]) for e in self._monitor.events[-200:] if e["t_s"] >= since_s]
        if deposed := [event for event in events if event in ("stood_down", "took_over")]:
            self.breaches.append(f"a stranger moved a service: {', '.join(deposed)}")

    def _serving(self) -> tuple[str, int] | None:
        """(instance, epoch) of who serves, by its last status; None if there was none lately."""
        serving = (s for s in self._monitor.recent(_BEHIND_S) if s.get("role") == "primary")
        return next(((str(s["instance"]), int(s["epoch"])) for s in serving), None)

    # ---- an operator

    def _freeze_and_kill(self) -> Course:
        """Freeze, kill who serves at once, and move the readings: frozen is frozen, to the bit, until *thaw*."""
        session, keys, name, task = self._monitor.session, Keys(STAGE, AXIS), self.primary, self._soak.task
        answer = operate(session, keys, "freeze", "soak")
        self._kill_service(name)
        if not answer["durable"]:
            self.breaches.append("freeze was answered and is not durable")
        yield 3.0
        motion = np.linspace(task.low_um, task.high_um, 50), np.full(50, task.range_um), np.zeros(50)
        first = _answer(session, encode_query(*motion, model=SERVED))
        # A query with everything that an answer depends on, the memory included.
        query = b"" if first is None else encode_query(*motion, first.memory, SERVED)
        before = _answer(session, query) if query else None
        self._tell_stage("offset", duration_s=3.0, value=_STEP_UM)
        for wait_s in (2.0, _UNTIL_END):
            yield wait_s
            found = None if before is None else _answer(session, query)
            if before is not None and found is not None and found.u_V.tobytes() != before.u_V.tobytes():
                moved_V = float(np.abs(found.u_V - before.u_V).max())
                self.breaches.append(f"frozen is not frozen: the same query moved by {moved_V:.2g} V")
        if before is None:
            self.unjudged.append("frozen to the bit: nobody answered after the take-over")
        for status in self._monitor.recent(_FRESH_S):
            if not status["frozen"] and status.get("synced", True):
                self.breaches.append(f"{status['instance']} is not frozen: the verb was lost")
        operate(session, keys, "thaw", "soak")

    # ---- the machine

    def _set_clock_back(self, fault: PlannedFault) -> Course:
        write_offset(self._soak.wall_clock, fault.value)
        yield _UNTIL_END
        write_offset(self._soak.wall_clock, 0.0)

    def _take_folders_away(self) -> Course:
        """Take the folders of who serves away: it must be told, and that of the recording must be made anew."""
        name = self.primary
        recordings = self._soak.take_folders_away(name, self._monitor.now())
        yield _UNTIL_END
        statuses = self._monitor.recent(_FRESH_S)
        recorder = next((s["recorder"] for s in statuses if self._soak.service_of(str(s["instance"])) == name), None)
        if recorder is None:
            self.unjudged.append("degraded: no status")
        elif not recorder["degraded"]:
            self.breaches.append("the folder of the recording vanished, and the status does not say degraded")
        if not any(folder.is_dir() for folder in recordings):
            self.breaches.append("the folder of the recording was not made anew")

    def _fill_disk(self) -> Course:
        """No file of the services may grow: lower the system's limit on their file size."""
        if sys.platform != "linux":
            self.notes.append("disk_full: this system cannot limit the files of another process; left out")
            return
        pids = [self._soak.children[name].pid for name in SERVICES]
        before = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in pids}
        for pid, limits in before.items():
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (_DISK_FULL_BYTES, limits[1]))
        yield _UNTIL_END
        for pid, limits in before.items():
            if Path(f"/proc/{pid}").exists():
                resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
