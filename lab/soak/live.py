"""A soak in real time: start the processes, run the plan of faults, and record what is observed."""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
import zenoh

from lab.soak.controller import AXIS, SERVED, STAGE, ControlTask, dwell_key
from lab.soak.fault_plan import FAULT_KINDS, PlannedFault, Schedule, SoakPlan
from lab.soak.machine_load import OtherLoad, processor_times_s
from lab.soak.rig import SERVICES, SoakRig
from lab.soak.stalls import StallWatch
from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.observations import (
    WELL_PCT,
    Counters,
    FaultRecord,
    Monitor,
    Observations,
    flatten_status,
    judge_sensor_fault,
    query_second,
    stage_gain,
)
from lab.testbed.shifted_clock import write_offset
from service.operating.remote import operate
from service.protocol.errors import ServiceError
from service.protocol.keys import Keys
from service.protocol.query import Trajectory, decode_reply, encode_query
from service.stage_node.faults import DELIVERY, READING, fault_key
from sim.stage.config import StageConfig

# --- What a fault does to the processes when it begins and when it ends.


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


@dataclass(frozen=True, slots=True)
class FrozenAnswer:
    """A query with everything that an answer depends on, and the answer of a frozen model, bit by bit."""

    query: bytes
    instance: str
    bits: bytes

    @classmethod
    def ask(cls, session: zenoh.Session, task: ControlTask) -> FrozenAnswer | None:
        """Ask for a slow motion through the range; None if nobody answers."""
        y_um = np.linspace(task.low_um, task.high_um, 50)
        v_um_per_s, still = np.full(50, task.range_um), np.zeros(50)
        first = _answer(session, encode_query(y_um, v_um_per_s, still, model=SERVED))
        if first is None:
            return None
        query = encode_query(y_um, v_um_per_s, still, first.memory, SERVED)
        found = _answer(session, query)
        return None if found is None else cls(query, found.model, found.u_V.tobytes())

    def difference(self, session: zenoh.Session) -> str:
        """How the present answer to the same query differs, in words; "" if it does not, or nobody answers."""
        found = _answer(session, self.query)
        if found is None or found.u_V.tobytes() == self.bits:
            return ""
        return f"the same query moved by {np.abs(found.u_V - np.frombuffer(self.bits)).max():.2g} V"


def _answer(session: zenoh.Session, query: bytes) -> Trajectory | None:
    for reply in session.get(Keys(STAGE, AXIS).feedforward, payload=query, timeout=2.0):
        if reply.ok is not None:
            return decode_reply(reply.ok.payload.to_bytes())
    return None


class FaultActions:
    """Begins and ends faults.

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
            "forged_state": lambda fault: self._strange(fault, "forge", str(self._soak.model)),
            "rogue_claim": lambda fault: self._strange(fault, "claim"),
            "folder_removed": self._take_folders_away,
            "freeze_restart": self._freeze_and_kill,
            **dict.fromkeys((*READING, *DELIVERY, *_STAGE_NAMES), self._disturb_samples),
        }

    def begin(self, index: int, fault: PlannedFault) -> None:
        """Begin a fault; `end` is called with the same index when it is over."""
        self.breaches, self.unjudged = [], []
        undo = self._begin[fault.kind](fault)
        if undo is not None:
            self._undo[index] = undo

    def note_primary(self, name: str) -> None:
        """The service ``name`` answers now."""
        self.primary = name

    def possible(self, fault: PlannedFault) -> bool:
        """Whether the fault may happen now: the one service that is ready is not ended before the other one is ready.

        A service is ready if its own status says that it has handled the samples of the last seconds.
        """
        if fault.kind not in ("kill_primary", "kill_standby", "stop_primary", "freeze_restart", "forged_state"):
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

        def start_again() -> None:
            start()

        return start_again

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
            deposed = [e["event"] for e in self._events_since(fault) if e["event"] in ("stood_down", "took_over")]
            if deposed:
                self.breaches.append(f"a stranger moved a service: {', '.join(deposed)}")

        return end

    def _serving(self) -> tuple[str, int] | None:
        """(instance, epoch) of who serves, by its last status; None if there was none lately."""
        for instance, (t_s, status) in list(self._monitor.statuses.items()):
            if self._monitor.now() - t_s < _BEHIND_S and status.get("role") == "primary":
                return instance, int(status["epoch"])
        return None

    def _events_since(self, fault: PlannedFault) -> list[dict[str, Any]]:
        begin_s = self._monitor.now() - fault.duration_s
        return [event for event in list(self._monitor.events[-200:]) if event["t_s"] >= begin_s]

    # ---- an operator

    def _freeze_and_kill(self, fault: PlannedFault) -> Undo:
        """Freeze, kill who serves at once, and move the readings: frozen is frozen, to the bit, until *thaw*."""
        session, keys, name = self._monitor.session, Keys(STAGE, AXIS), self.primary
        answer = operate(session, keys, "freeze", "soak")
        self._kill_service(name)
        if not answer["durable"]:
            self.breaches.append("freeze was answered and is not durable")
        frozen: list[FrozenAnswer] = []

        def after_takeover() -> None:
            frozen.extend(found for found in [FrozenAnswer.ask(session, self._soak.task)] if found is not None)
            offset = {"fault": "offset", "duration_s": 3.0, "value": _STEP_UM}
            self._monitor.put(fault_key(STAGE, AXIS), offset)

        def again() -> None:
            if frozen and (difference := frozen[0].difference(session)):
                self.breaches.append(f"frozen is not frozen: {difference}")

        now = time.monotonic()
        self._later += [(now + 3.0, after_takeover), (now + 5.0, again)]

        def end() -> None:
            again()
            if not frozen:
                self.unjudged.append("frozen to the bit: nobody answered after the take-over")
            for status in self._present():
                if not status["frozen"] and status.get("synced", True):
                    self.breaches.append(f"{status['instance']} is not frozen: the verb was lost")
            operate(session, keys, "thaw", "soak")

        return end

    def _present(self) -> list[dict[str, Any]]:
        """The statuses of the last seconds."""
        statuses = list(self._monitor.statuses.values())
        return [status for t_s, status in statuses if self._monitor.now() - t_s < _FRESH_S]

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
            now = next((s for s in self._present() if self._soak.service_of(str(s["instance"])) == name), None)
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


Say = Callable[[str], None]
_TICK_S: Final = 0.02
_PROGRESS_S: Final = 5.0
_FIRST_SAMPLES_S: Final = 20.0
#: Memory and processor time of the processes are recorded every second for so long, then every tenth second.
_DENSE_S: Final = 3600
#: Processes that must live for the whole run, except when a fault ends them.
LASTING: Final = ("router", *SERVICES, "stage", "controller", "prober", "echo", "viewer", "bare")


def run_live(
    out: Path, stage: StageConfig, task: ControlTask, plan: SoakPlan, observed: Observations, interim: InterimJudge,
    stopped: Callable[[], bool], say: Say,
) -> Monitor:  # fmt: skip
    """Run the plan and record it in ``observed``; ``stopped`` ends it early. The models are in ``out``.

    Raises ServiceError if the processes do not start.
    """
    with SoakRig(out, stage, task, out / "model.npz") as soak:
        say("      starting router, services, stage, controller, prober, echo, viewer")
        soak.start()
        monitor = Monitor(soak.rig.endpoint, task, time.monotonic())
        try:
            _wait_for_samples(monitor)
            observed.follow(monitor.track.seconds, monitor.events)
            watch = _Watch(soak, monitor, observed, interim, say)
            stalls = StallWatch(soak.rig.logs, watch.reported_silence_s, watch.between, monitor.now)
            try:
                with stalls:
                    duration_s = watch.run(plan, stopped)
            finally:
                watch.close()
                observed.notes += [stalls.note()] if stalls.note() else []
        finally:
            say("  stopping all")
            soak.stop()
            monitor.close()
    observed.end(duration_s, monitor.track.seconds)
    return monitor


def _wait_for_samples(monitor: Monitor) -> None:
    until = time.monotonic() + _FIRST_SAMPLES_S
    while monitor.track.received < 100:
        if time.monotonic() > until:
            raise ServiceError("soak: the stage sends no samples: see the logs of stage and controller")
        time.sleep(0.05)


class _Watch:
    """The loop of a run, and a thread that reads processes, statuses and measuring clients once a second."""

    def __init__(
        self, soak: SoakRig, monitor: Monitor, observed: Observations, interim: InterimJudge, say: Say
    ) -> None:
        self._soak, self._monitor, self._observed, self._say = soak, monitor, observed, say
        self._interim = interim
        self._actions = FaultActions(soak, monitor)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._observe, name="soak-observe")
        self._progress_s = 0.0
        self._other_load = OtherLoad()

    def run(self, plan: SoakPlan, stopped: Callable[[], bool]) -> float:
        """Run the plan until its end or until ``stopped``; returns how long that was, s."""
        monitor = self._monitor
        monitor.begin()
        self._thread.start()
        schedule = Schedule(plan, self._actions.possible)
        under_way: tuple[int, float, FaultRecord] | None = None
        while monitor.now() < plan.duration_s and not stopped():
            if under_way is None:
                due = schedule.due(monitor.now())
                if due is not None:
                    under_way = self._begin(*due)
            elif under_way[1] <= monitor.now():
                self._end(under_way, schedule)
                under_way = None
            self._actions.tick()
            self._progress(plan)
            self._interim.due(monitor.now(), self._samples)
            time.sleep(_TICK_S)
        if under_way is not None:
            self._end(under_way, schedule)
        self._actions.notes.extend(schedule.left_out())
        return monitor.now()

    def reported_silence_s(self) -> float:
        """The silence that the prober has reported at last, s; 0 for none. From the thread of the stalls."""
        line = self._soak.children["prober"].last_line()
        if not line.startswith('{"silence_s"'):
            return 0.0
        return float(json.loads(line)["silence_s"])

    def between(self) -> dict[str, int]:
        """The processes between the prober and an answer, by name."""
        children = dict(self._soak.children)
        return {name: children[name].pid for name in ("router", "prober", *SERVICES) if children[name].running}

    def _begin(self, index: int, fault: PlannedFault) -> tuple[int, float, FaultRecord]:
        """Begin a fault; returns its number in the plan, when it is to end, and its record."""
        record = FaultRecord(fault.kind, self._monitor.now(), value=fault.value, begin_seq=self._monitor.track.newest)
        self._actions.begin(index, fault)
        self._observed.faults.append(record)
        return index, self._monitor.now() + fault.duration_s, record

    def _end(self, under_way: tuple[int, float, FaultRecord], schedule: Schedule) -> None:
        index, _, record = under_way
        self._actions.end(index)
        now_s = self._monitor.now()
        record.end(now_s)
        schedule.over(index, now_s)
        record.breaches += self._actions.breaches
        record.unjudged += self._actions.unjudged
        if FAULT_KINDS[record.kind].sensor:
            monitor = self._monitor
            gain = stage_gain(self._observed.faults, record.begin_s)
            judge_sensor_fault(record, monitor.track, monitor.named(record.begin_seq), monitor.track.newest, gain)

    def close(self) -> None:
        """Undo the faults that are under way, and end the thread."""
        self._actions.finish()
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._observed.notes.extend(self._actions.notes)

    def _observe(self) -> None:
        missing: set[int] = set()
        seconds = 0
        while not self._closing.wait(1.0):
            self._read_statuses()
            self._read_prober()
            self._read_controller()
            self._read_paced_loop()
            self._measure_other_load()
            seconds += 1
            if seconds <= _DENSE_S or seconds % 10 == 0:
                self._look_at_processes(missing)

    def _read_statuses(self) -> None:
        for status in self._monitor.ask():
            name = self._soak.service_of(str(status["instance"]))
            if name and status.get("role", "primary") == "primary":
                self._actions.note_primary(name)
        for instance, (t_s, status) in list(self._monitor.statuses.items()):
            if self._monitor.now() - t_s < 1.5:
                self._observed.counters.append((t_s, instance, Counters(flatten_status(status))))

    def _look_at_processes(self, missing: set[int]) -> None:
        """Memory and processor time of each process; one that ended without a fault is added to ``missing``."""
        for name, child in list(self._soak.children.items()):
            if name not in LASTING:
                continue
            if not child.running:
                if child.pid not in self._actions.killed and child.pid not in missing:
                    missing.add(child.pid)
                    self._observed.ended.append((self._monitor.now(), name))
                continue
            try:
                process = psutil.Process(child.pid)
                now = self._monitor.now()
                memory, cpu = process.memory_info().rss / 1024.0, sum(process.cpu_times()[:2])
            except psutil.Error:
                continue
            self._observed.memory.setdefault(name, []).append((now, memory, child.pid))
            self._observed.cpu.setdefault(name, []).append((now, cpu, child.pid))

    def _lines(self, name: str, first_key: str) -> Iterator[dict[str, Any]]:
        """The JSON lines, beginning with ``first_key``, that a process has printed since the last call."""
        for line in self._soak.children[name].take_lines():
            if line.startswith(f'{{"{first_key}"'):
                yield json.loads(line)

    def _read_prober(self) -> None:
        for line in self._lines("prober", "t_s"):
            self._observed.query_seconds.append(query_second(line, line["t_s"] - self._monitor.start_s))

    def _read_controller(self) -> None:
        for line in self._lines("controller", "blocks"):
            self._observed.note_unsafe_blocks(int(line["unsafe"]))

    def _read_paced_loop(self) -> None:
        for line in self._lines("bare", "t_s"):
            self._observed.loop_delays.append((line["t_s"] - self._monitor.start_s, line["late_s"]))

    def _measure_other_load(self) -> None:
        names = {child.pid: name for name, child in list(self._soak.children.items())}
        own_s = processor_times_s([os.getpid(), *names])
        # A busy core is a fault: its load counts as that of others.
        own_s = {pid: taken for pid, taken in own_s.items() if not names.get(pid, "").startswith("busy")}
        share = self._other_load.share(own_s)
        if share is not None:
            self._observed.other_load.append((self._monitor.now(), share))

    def _samples(self) -> dict[str, int]:
        return self._monitor.samples() | {"withheld_by_faults": withheld(self._monitor.stage)}

    def _progress(self, plan: SoakPlan) -> None:
        now = self._monitor.now()
        if now - self._progress_s < _PROGRESS_S:
            return
        self._progress_s = now
        second, _ = self._monitor.latest()
        mae = math.nan if second is None else 100.0 * second.mae_um / self._observed.range_um
        filled = round(20.0 * min(1.0, now / plan.duration_s))
        last = self._observed.faults[-1].kind if self._observed.faults else "none yet"
        mark = " (!)" if mae > WELL_PCT else ""
        self._say(
            f"  [{'#' * filled:<20}] {now:6.0f} of {plan.duration_s:g} s  error {mae:.3f} % of range{mark}, "
            f"{len(self._observed.faults)} of {len(plan.faults)} faults, last {last}, {self._actions.primary} serves"
        )


def withheld(stage: dict[str, Any]) -> int:
    """Number of samples that the stage withheld because of a fault, from its status."""
    faults = stage.get("faults", {})
    return int(faults.get("gap", 0)) + int(faults.get("losses", 0))
