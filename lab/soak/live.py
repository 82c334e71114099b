"""A soak in real time: start the processes, run the plan of faults, and record what is observed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from dehyst.lab.soak.actions import FaultActions
from dehyst.lab.soak.controller import ControlTask
from dehyst.lab.soak.fault_plan import FAULT_KINDS, PlannedFault, Schedule, SoakPlan
from dehyst.lab.soak.judge import judge_sensor_fault, stage_gain
from dehyst.lab.soak.observed import Counted, FaultRecord, Monitor, Observations, QuerySecond
from dehyst.lab.soak.rig import SERVICES, SoakRig
from dehyst.lab.testbed.identified_stage import Rig
from dehyst.service.protocol.errors import ServiceError
from dehyst.sim.stage.config import StageConfig

Say = Callable[[str], None]
_TICK_S: Final = 0.02
_PROGRESS_S: Final = 5.0
_FIRST_SAMPLES_S: Final = 20.0
#: A status that is older, s, was counted before.
_FRESH_S: Final = 1.5
#: Processes that must live for the whole run, except when a fault ends them.
LASTING: Final = ("router", *SERVICES, "stage", "controller", "prober", "viewer")


def run_live(
    out: Path, stage: StageConfig, task: ControlTask, plan: SoakPlan, observed: Observations,
    stopped: Callable[[], bool], say: Say,
) -> Monitor:  # fmt: skip
    """Run the plan and record it in ``observed``; ``stopped`` ends it early. The models are in ``out``.

    Raises ServiceError if the processes do not start.
    """
    with Rig(out / "logs") as rig:
        soak = SoakRig(rig, out, stage, task, out / "model.npz")
        say("      starting router, services, stage, controller, prober, viewer")
        soak.start()
        monitor = Monitor(soak.rig.endpoint, task, time.monotonic())
        observed.events = monitor.events
        try:
            until = time.monotonic() + _FIRST_SAMPLES_S
            while monitor.track.received < 100:
                if time.monotonic() > until:
                    raise ServiceError("soak: the stage sends no samples: see the logs of stage and controller")
                time.sleep(0.05)
            watch = _Watch(soak, monitor, observed, say)
            try:
                duration_s = watch.run(plan, stopped)
            finally:
                watch.close()
        finally:
            say("  stopping all")
            soak.stop()
            monitor.close()
    observed.end(duration_s, monitor.track.seconds)
    return monitor


class _Watch:
    """The loop of a run. Once a second it reads processes, statuses and measuring clients."""

    def __init__(self, soak: SoakRig, monitor: Monitor, observed: Observations, say: Say) -> None:
        self._soak, self._monitor, self._observed, self._say = soak, monitor, observed, say
        self._actions = FaultActions(soak, monitor)
        self._missing: set[int] = set()

    def run(self, plan: SoakPlan, stopped: Callable[[], bool]) -> float:
        """Run the plan until its end or until ``stopped``; returns how long that was, s."""
        monitor, actions = self._monitor, self._actions
        monitor.begin()
        schedule = Schedule(plan, actions.possible)
        under_way: tuple[PlannedFault, float, FaultRecord] | None = None
        seen_s = told_s = 0.0
        while monitor.now() < plan.duration_s and not stopped():
            if under_way is None:
                fault = schedule.due(monitor.now())
                if fault is not None:
                    record = FaultRecord(fault.kind, monitor.now(), value=fault.value, begin_seq=monitor.track.newest)
                    actions.begin(fault)
                    self._observed.faults.append(record)
                    under_way = fault, monitor.now() + fault.duration_s, record
            elif under_way[1] <= monitor.now():
                schedule.over(under_way[0], self._end(under_way[2]))
                under_way = None
            actions.tick()
            if monitor.now() - seen_s >= 1.0:
                seen_s = monitor.now()
                self._observe()
            if monitor.now() - told_s >= _PROGRESS_S:
                told_s = monitor.now()
                self._progress(plan)
            time.sleep(_TICK_S)
        if under_way is not None:
            self._end(under_way[2])
        actions.notes.extend(schedule.left_out())
        return monitor.now()

    def _end(self, record: FaultRecord) -> float:
        """End a fault; returns when, s."""
        self._actions.end()
        record.end_s = self._monitor.now()
        if FAULT_KINDS[record.kind].sensor:
            track, gain = self._monitor.track, stage_gain(self._observed.faults, record.begin_s)
            judge_sensor_fault(record, track, self._monitor.troubles(record.begin_seq), track.newest, gain)
        return record.end_s

    def close(self) -> None:
        """Undo the fault that is under way."""
        self._actions.finish()
        self._observed.notes.extend(self._actions.notes)

    def _observe(self) -> None:
        observed, monitor = self._observed, self._monitor
        for status in monitor.ask():
            name = self._soak.service_of(str(status["instance"]))
            if name and status.get("role", "primary") == "primary":
                self._actions.primary = name
        for instance, (t_s, status) in list(monitor.statuses.items()):
            if monitor.now() - t_s < _FRESH_S:
                observed.counters.append(Counted.of(t_s, instance, status))
        for line in self._lines("prober", "t_s"):
            observed.probes.append(QuerySecond.of(line, line["t_s"] - monitor.start_s))
        for line in self._lines("controller", "blocks"):
            observed.unsafe_blocks = max(observed.unsafe_blocks, int(line["unsafe"]))
        for name, child in [(name, self._soak.children[name]) for name in LASTING]:
            if not child.running and child.pid not in self._actions.killed | self._missing:
                self._missing.add(child.pid)
                observed.ended.append((monitor.now(), name))

    def _lines(self, name: str, first_key: str) -> Iterator[dict[str, Any]]:
        """The JSON lines, beginning with ``first_key``, that a process has printed since the last call."""
        for line in self._soak.children[name].take_lines():
            if line.startswith(f'{{"{first_key}"'):
                yield json.loads(line)

    def _progress(self, plan: SoakPlan) -> None:
        observed, now_s = self._observed, self._monitor.now()
        last = observed.faults[-1].kind if observed.faults else "none yet"
        detail = f"last {last}, {self._actions.primary} serves"
        self._say(progress_line(observed, plan, now_s, self._monitor.track.seconds[-2:-1], detail))


def progress_line(observed: Observations, plan: SoakPlan, now_s: float, seconds: list[Any], detail: str) -> str:
    """A line with the time, the error of the last of ``seconds``, and the number of faults so far."""
    error = "".join(f"error {100.0 * s.mae_um / observed.range_um:.3f} % of range, " for s in seconds[-1:])
    return (
        f"  [{'#' * round(20.0 * min(1.0, now_s / plan.duration_s)):<20}] {now_s:6.0f} of {plan.duration_s:g} s  "
        f"{error}{len(observed.faults)} of {len(plan.faults)} faults, {detail}"
    )
