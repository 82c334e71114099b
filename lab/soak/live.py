"""A soak in real time: the processes, the plan of faults, and those who watch."""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from lab.soak.faults.actions import Actions
from lab.soak.faults.plan import Planned, Schedule, SoakPlan
from lab.soak.processes.control import Control
from lab.soak.processes.machine import Others, taken_s
from lab.soak.processes.world import World
from lab.soak.verdict.interim import Interim
from lab.soak.verdict.ledger import Happened, Ledger, Row, flat, probe_of
from lab.soak.verdict.monitor import Monitor
from lab.soak.verdict.settling import WELL_PCT
from service.protocol.errors import ServiceError
from sim.stage.config import StageConfig

Say = Callable[[str], None]
_TICK_S = 0.02
_PROGRESS_S = 5.0
_FIRST_SAMPLES_S = 20.0
#: So long memory and processor of every process are kept each second.
_DENSE_S = 3600
#: Processes that are to live all the time but where a fault ends them.
LASTING = ("router", "a", "b", "stage", "controller", "prober", "echo", "viewer", "bare")


def run_live(
    out: Path, stage: StageConfig, control: Control, plan: SoakPlan, ledger: Ledger, interim: Interim,
    stopped: Callable[[], bool], say: Say,
) -> Monitor:  # fmt: skip
    """Run the plan and fill the ledger; ``stopped`` ends it early. The models are in ``out``.

    Raises ServiceError where the processes do not come up.
    """
    with World(out, stage, control, out / "model.npz") as world:
        say("      starting router, services, stage, controller, prober, echo, viewer")
        world.start()
        monitor = Monitor(world.endpoint, control, time.monotonic())
        try:
            _wait_for_samples(monitor)
            ledger.seconds, ledger.events = monitor.track.seconds, monitor.events
            watch = _Watch(world, monitor, ledger, interim, say)
            try:
                watch.run(plan, stopped)
            finally:
                watch.close()
        finally:
            say("  stopping all")
            world.stop()
            monitor.close()
    ledger.seconds = monitor.track.seconds[:-1] or monitor.track.seconds
    return monitor


def _wait_for_samples(monitor: Monitor) -> None:
    until = time.monotonic() + _FIRST_SAMPLES_S
    while monitor.track.received < 100:
        if time.monotonic() > until:
            raise ServiceError("soak: the stage sends no samples: see the logs of stage and controller")
        time.sleep(0.05)


class _Watch:
    """The loop of a run, and the thread that looks at processes and statuses once a second."""

    def __init__(self, world: World, monitor: Monitor, ledger: Ledger, interim: Interim, say: Say) -> None:
        self._world, self._monitor, self._ledger, self._say = world, monitor, ledger, say
        self._interim = interim
        self._actions = Actions(world, monitor)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._observe, name="soak-observe")
        self._told_s = 0.0
        self._others = Others()

    def run(self, plan: SoakPlan, stopped: Callable[[], bool]) -> None:
        monitor, ledger = self._monitor, self._ledger
        monitor.begin()
        self._thread.start()
        schedule = Schedule(plan, self._actions.possible)
        under_way: tuple[int, float, Happened] | None = None
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
        ledger.duration_s = monitor.now()

    def _begin(self, index: int, fault: Planned) -> tuple[int, float, Happened]:
        """Its number, when it is to end, and what is written down of it."""
        happened = Happened(fault.kind, self._monitor.now(), value=fault.value)
        self._actions.begin(index, fault)
        self._ledger.faults.append(happened)
        return index, self._monitor.now() + fault.duration_s, happened

    def _end(self, under_way: tuple[int, float, Happened], schedule: Schedule) -> None:
        index, _, happened = under_way
        self._actions.end(index)
        happened.end_s = self._monitor.now()
        schedule.over(index, happened.end_s)

    def close(self) -> None:
        """Take back what is under way, and end the thread."""
        self._actions.finish()
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._ledger.notes += self._actions.notes

    def _observe(self) -> None:
        missing: dict[int, str] = {}
        seconds = 0
        while not self._closing.wait(1.0):
            for told in self._monitor.ask():
                name = self._world.by_pid(str(told["instance"]))
                if name and told.get("role", "primary") == "primary":
                    self._actions.primary = name
            for instance, (t_s, told) in list(self._monitor.statuses.items()):
                if self._monitor.now() - t_s < 1.5:
                    self._ledger.counters.append((t_s, instance, Row(flat(told))))
            self._take_probes()
            self._take_controller()
            self._take_bare()
            self._look_at_others()
            # In a run of days a point every ten seconds shows as much.
            seconds += 1
            if seconds > _DENSE_S and seconds % 10:
                continue
            for name, child in list(self._world.children.items()):
                if name not in LASTING:
                    continue
                if not child.running:
                    if child.pid not in self._actions.killed and child.pid not in missing:
                        missing[child.pid] = name
                        self._ledger.ended.append((self._monitor.now(), name))
                    continue
                try:
                    process = psutil.Process(child.pid)
                    now = self._monitor.now()
                    memory, cpu = process.memory_info().rss / 1024.0, sum(process.cpu_times()[:2])
                except psutil.Error:
                    continue
                self._ledger.memory.setdefault(name, []).append((now, memory, child.pid))
                self._ledger.cpu.setdefault(name, []).append((now, cpu, child.pid))

    def _take_probes(self) -> None:
        for line in self._world.children["prober"].take_lines():
            if not line.startswith('{"t_s"'):
                continue
            told = json.loads(line)
            self._ledger.probes.append(probe_of(told, told["t_s"] - self._monitor.start_s))

    def _take_controller(self) -> None:
        for line in self._world.children["controller"].take_lines():
            if line.startswith('{"blocks"'):
                told = json.loads(line)
                self._ledger.unsafe_blocks = max(self._ledger.unsafe_blocks, int(told["unsafe"]))

    def _take_bare(self) -> None:
        for line in self._world.children["bare"].take_lines():
            if line.startswith('{"t_s"'):
                told = json.loads(line)
                self._ledger.bare.append((told["t_s"] - self._monitor.start_s, told["late_s"]))

    def _look_at_others(self) -> None:
        names = {child.pid: name for name, child in list(self._world.children.items())}
        own_s = taken_s([os.getpid(), *names])
        # What is to take the processor away is not the soak's own.
        own_s = {pid: taken for pid, taken in own_s.items() if not names.get(pid, "").startswith("busy")}
        share = self._others.share(own_s)
        if share is not None:
            self._ledger.others.append((self._monitor.now(), share))

    def _samples(self) -> dict[str, int]:
        return self._monitor.samples() | {"withheld_by_faults": withheld(self._monitor.stage)}

    def _progress(self, plan: SoakPlan) -> None:
        now = self._monitor.now()
        if now - self._told_s < _PROGRESS_S:
            return
        self._told_s = now
        second, _ = self._monitor.latest()
        mae = math.nan if second is None else 100.0 * second.mae_um / self._ledger.range_um
        filled = round(20.0 * min(1.0, now / plan.duration_s))
        last = self._ledger.faults[-1].kind if self._ledger.faults else "none yet"
        well = "" if not mae > WELL_PCT else " (!)"
        self._say(
            f"  [{'#' * filled:<20}] {now:6.0f} of {plan.duration_s:g} s  error {mae:.3f} % of range{well}, "
            f"{len(self._ledger.faults)} of {len(plan.faults)} faults, last {last}, {self._actions.primary} serves"
        )


def withheld(stage: dict[str, Any]) -> int:
    """How many samples the stage did not send because it was told so."""
    return int(stage.get("faults", {}).get("gap", 0))
