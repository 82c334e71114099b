"""What each fault of a soak does when it begins and when it ends, and what must hold in a fault of its own kind."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from lab.soak.controller import AXIS, SERVED, STAGE, dwell_key
from lab.soak.fault_plan import PlannedFault
from lab.soak.observed import Monitor
from lab.soak.rig import SERVICES, SoakRig
from lab.testbed.shifted_clock import write_offset
from service.operating.remote import operate
from service.protocol.keys import Keys
from service.protocol.query import Trajectory, decode_reply, encode_query
from service.stage_node.faults import DELIVERY, READING, fault_key

#: Bytes that a process may still add to a file while the disk is full.
_DISK_FULL_BYTES: Final = 4096
#: A service can take over if its status, and the newest sample in it, are not older than this, s.
_BEHIND_S: Final = 3.0
#: Faults whose name in the stage's protocol differs.
_STAGE_NAMES: Final = {"stage_clock": "clock"}
#: A process that was killed is started again after this time, s.
_RESTART_S: Final = 1.0

#: Time for a stranger's process to end, s; age of a status that counts as present, s; step of the readings while
#: frozen, µm; time within which the folder of the checkpoints must be there again, s.
_END_S: Final = 10.0
_FRESH_S: Final = 1.6
_STEP_UM: Final = 20.0
_ANEW_S: Final = 13.0

Undo = Callable[[], None]


def _nothing() -> None: ...


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
        self._undo: Undo = _nothing
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
            "forged_state": lambda fault: self._strange(fault, "forge", str(self._soak.model)),
            "rogue_claim": lambda fault: self._strange(fault, "claim"),
            "folder_removed": self._take_folders_away,
            "freeze_restart": self._freeze_and_kill,
            **dict.fromkeys((*READING, *DELIVERY, *_STAGE_NAMES), self._disturb_samples),
        }

    def begin(self, fault: PlannedFault) -> None:
        """Begin a fault; `end` is called when it is over."""
        self.breaches, self.unjudged = [], []
        self._undo = self._begin[fault.kind](fault) or _nothing

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
        undo, self._undo = self._undo, _nothing
        undo()

    def tick(self) -> None:
        """Start the processes again that are due to be."""
        due = [work for at, work in self._later if at <= time.monotonic()]
        self._later = [(at, work) for at, work in self._later if at > time.monotonic()]
        for work in due:
            work()

    def finish(self) -> None:
        """Undo everything, at the end of a run or when it is interrupted."""
        self.end()
        for _, work in self._later:
            work()
        self._later = []

    # ---- the samples and parameters of the stage, and the reference

    def _disturb_samples(self, fault: PlannedFault) -> None:
        task, value = self._soak.task, fault.value
        if fault.kind == "saturate":
            value = 0.5 * (task.low_um + task.high_um)
        elif fault.kind == "other_stage":
            value = task.low_um + task.high_um
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
        return lambda: (start(), None)[1]

    def _disturb(self, what: str, *arguments: str) -> Undo:
        self._disturbers += 1
        return self._soak.start_disturber(what, self._disturbers, Keys(STAGE, AXIS).base, *arguments)

    def _strange(self, fault: PlannedFault, what: str, *arguments: str) -> Undo:
        """A stranger tries to move a service: who serves goes on serving, and it is told nothing."""
        served = self._serving()
        child = self._soak.start_stranger(what, round(1000 * fault.at_s), *arguments)

        def end() -> None:
            child.send(signal.SIGTERM)
            child.wait(_END_S)
            told = child.last_json()
            if told["states"]:
                self.breaches.append(f"a stranger was given the state {told['states']} times")
            if not told["tried"]:
                self.unjudged.append("the stranger came to nothing")
            now = self._serving()
            if served and now and served[:2] != now[:2]:
                self.breaches.append(f"{now[0]} serves as number {now[1]}, before {served[0]} as number {served[1]}")
            since_s = self._monitor.now() - fault.duration_s
            events = [str(e["event"]) for e in self._monitor.events[-200:] if e["t_s"] >= since_s]
            deposed = [event for event in events if event in ("stood_down", "took_over")]
            if deposed:
                self.breaches.append(f"a stranger moved a service: {', '.join(deposed)}")

        return end

    def _serving(self) -> tuple[str, int] | None:
        """(instance, epoch) of who serves, by its last status; None if there was none lately."""
        serving = (s for s in self._monitor.recent(_BEHIND_S) if s.get("role") == "primary")
        return next(((str(s["instance"]), int(s["epoch"])) for s in serving), None)

    # ---- an operator

    def _freeze_and_kill(self, fault: PlannedFault) -> Undo:
        """Freeze, kill who serves at once, and move the readings: frozen is frozen, to the bit, until *thaw*."""
        session, keys, name = self._monitor.session, Keys(STAGE, AXIS), self.primary
        answer = operate(session, keys, "freeze", "soak")
        self._kill_service(name)
        if not answer["durable"]:
            self.breaches.append("freeze was answered and is not durable")
        task = self._soak.task
        y_um, still = np.linspace(task.low_um, task.high_um, 50), np.zeros(50)
        motion = y_um, np.full(50, task.range_um), still
        frozen: list[tuple[bytes, Trajectory]] = []

        def after_takeover() -> None:
            # A query with everything that an answer depends on, the memory included.
            first = _answer(session, encode_query(*motion, model=SERVED))
            if first is not None:
                query = encode_query(*motion, first.memory, SERVED)
                frozen.extend((query, found) for found in [_answer(session, query)] if found is not None)
            offset = {"fault": "offset", "duration_s": 3.0, "value": _STEP_UM}
            self._monitor.put(fault_key(STAGE, AXIS), offset)

        def again() -> None:
            for query, before in frozen:
                found = _answer(session, query)
                if found is not None and found.u_V.tobytes() != before.u_V.tobytes():
                    moved_V = float(np.abs(found.u_V - before.u_V).max())
                    self.breaches.append(f"frozen is not frozen: the same query moved by {moved_V:.2g} V")

        now = time.monotonic()
        self._later += [(now + 3.0, after_takeover), (now + 5.0, again)]

        def end() -> None:
            again()
            if not frozen:
                self.unjudged.append("frozen to the bit: nobody answered after the take-over")
            for status in self._monitor.recent(_FRESH_S):
                if not status["frozen"] and status.get("synced", True):
                    self.breaches.append(f"{status['instance']} is not frozen: the verb was lost")
            operate(session, keys, "thaw", "soak")

        return end

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

    def _take_folders_away(self, fault: PlannedFault) -> Undo:
        """Take the folders of who serves away: it must be told, and they must be made anew."""
        name = self.primary
        taken = self._soak.take_folders_away(name, self._monitor.now())

        def told() -> None:
            now = next(
                (s for s in self._monitor.recent(_FRESH_S) if self._soak.service_of(str(s["instance"])) == name), None
            )
            recorder = None if now is None else now["recorder"]
            if recorder is None:
                self.unjudged.append("degraded: no status")
            elif not recorder["degraded"]:
                self.breaches.append("the folder of the recording vanished, and the status does not say degraded")
            if not any(folder.is_dir() for folder in taken if folder.name.startswith("recording")):
                self.breaches.append("the folder of the recording was not made anew")

        def made_anew() -> None:
            if not any(folder.is_dir() for folder in taken if folder.name.startswith("checkpoints")):
                self.notes.append(f"folder_removed: the checkpoints of {name} were not made anew within {_ANEW_S:g} s")

        self._later.append((time.monotonic() + _ANEW_S, made_anew))
        return told

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
