"""A soak in real time: start the processes, run the plan of faults, and record what is observed."""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import psutil

from lab.soak.controller import ControlTask
from lab.soak.fault_actions import FaultActions
from lab.soak.fault_plan import PlannedFault, Schedule, SoakPlan
from lab.soak.machine_load import OtherLoad, processor_times_s
from lab.soak.rig import SERVICES, SoakRig
from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.observations import (
    WELL_PCT,
    Counters,
    FaultRecord,
    Monitor,
    Observations,
    flatten_status,
    query_second,
)
from service.protocol.errors import ServiceError
from sim.stage.config import StageConfig

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
            observed.seconds, observed.events = monitor.track.seconds, monitor.events
            watch = _Watch(soak, monitor, observed, interim, say)
            try:
                watch.run(plan, stopped)
            finally:
                watch.close()
        finally:
            say("  stopping all")
            soak.stop()
            monitor.close()
    observed.seconds = monitor.track.seconds[:-1] or monitor.track.seconds
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

    def run(self, plan: SoakPlan, stopped: Callable[[], bool]) -> None:
        """Run the plan until its end or until ``stopped``."""
        monitor, observed = self._monitor, self._observed
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
        self._actions.notes += schedule.left_out()
        observed.duration_s = monitor.now()

    def _begin(self, index: int, fault: PlannedFault) -> tuple[int, float, FaultRecord]:
        """Begin a fault; returns its number in the plan, when it is to end, and its record."""
        record = FaultRecord(fault.kind, self._monitor.now(), value=fault.value)
        self._actions.begin(index, fault)
        self._observed.faults.append(record)
        return index, self._monitor.now() + fault.duration_s, record

    def _end(self, under_way: tuple[int, float, FaultRecord], schedule: Schedule) -> None:
        index, _, record = under_way
        self._actions.end(index)
        record.end_s = self._monitor.now()
        schedule.over(index, record.end_s)

    def close(self) -> None:
        """Undo the faults that are under way, and end the thread."""
        self._actions.finish()
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._observed.notes += self._actions.notes

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
                self._actions.primary = name
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
            self._observed.unsafe_blocks = max(self._observed.unsafe_blocks, int(line["unsafe"]))

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
    return int(stage.get("faults", {}).get("gap", 0))
