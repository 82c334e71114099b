"""A soak in one process: stage, axis and controller in lockstep, with the faults of samples, stage and reference."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.lab.loop import Asker, turns
from dehyst.lab.soak.controller import AXIS, SERVED, STAGE, ControlTask, SoakReference
from dehyst.lab.soak.fault_plan import CHANGES, FAULT_KINDS, PlannedFault, SoakPlan
from dehyst.lab.soak.judge import judge_sensor_fault, stage_gain
from dehyst.lab.soak.live import progress_line
from dehyst.lab.soak.observed import Counted, FaultRecord, Observations, SampleTracker, troubles_since
from dehyst.lab.testbed.identified_stage import SAMPLES_PER_MESSAGE
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.stage_node.faults import CHANGE, Fault, Injector
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage

_PROGRESS_S: Final = 5.0


def run_fast(
    out: Path, stage: StageConfig, control: ControlTask, plan: SoakPlan, observed: Observations,
    stopped: Callable[[], bool], say: Callable[[str], None],
) -> dict[str, int]:  # fmt: skip
    """Run the plan and record it in ``observed``; returns the counts of samples. Times are those of the stage."""
    limits = Limits(control.u_min_V, control.u_max_V, control.slew_V_per_s)
    config = AxisConfig(AXIS, out / "model.npz", limits, served=SERVED, snapshot_every=control.block)
    axis = load_axis(STAGE, config)
    plant = _Plant(Stage(stage), axis, control)
    ask = Asker(axis)
    waiting = list(plan.faults)
    under_way: list[tuple[float, FaultRecord]] = []
    begin_s = told_s = time.monotonic()
    for run, asked in turns(round(plan.duration_s / control.dt_s / control.block), control.lead // control.block):
        now_s = plant.now_s
        if stopped():
            break
        while waiting and waiting[0].at_s <= now_s:
            fault = waiting.pop(0)
            record = FaultRecord(fault.kind, now_s, value=fault.value, begin_seq=plant.k)
            plant.begin_fault(fault)
            observed.faults.append(record)
            under_way.append((fault.end_s, record))
        for end_s, record in list(under_way):
            if end_s <= now_s:
                record.end_s = now_s
                under_way.remove((end_s, record))
                if FAULT_KINDS[record.kind].sensor:
                    observed.events.extend({"t_s": now_s, **event} for event in axis.take_events())
                    named = troubles_since(observed.events, record.begin_seq)
                    gain = stage_gain(observed.faults, record.begin_s)
                    judge_sensor_fault(record, plant.track, named, plant.k - 1, gain)
        if run is not None:
            plant.run(run)
            if int(plant.now_s) > int(now_s):
                observed.counters.append(Counted.of(plant.now_s, "service", plant.status()))
                observed.events.extend({"t_s": plant.now_s, **event} for event in axis.take_events())
        if asked is not None:
            motion = plant.reference.rows(asked * control.block, control.block)
            plant.command(asked, motion[0], ask(asked * control.block, tuple(motion)).u_V)
        if time.monotonic() - told_s >= _PROGRESS_S:
            told_s = time.monotonic()
            speed = f"{plant.now_s / (told_s - begin_s):.1f} times as fast as real time"
            say(progress_line(observed, plan, plant.now_s, plant.track.seconds[-2:-1], speed))
    observed.end(plant.now_s, plant.track.seconds)
    observed.notes.append("In one process: latency, memory, recordings and take-overs are not part of this run.")
    counted = plant.status()["samples"]
    return {
        "read": plant.k,
        **{name: int(counted[name]) for name in ("received", "lost", "late", "restarts")},
        "learnt": axis.gates.get("learnt", 0),
        "withheld_by_faults": plant.injector.counts["gap"] + plant.injector.counts["losses"],
    }


class _Plant:
    """The stage with what faults do to it, its samples and its reference; its samples go into the axis."""

    def __init__(self, stage: Stage, axis: Axis, control: ControlTask) -> None:
        self.k = 0
        self.track = SampleTracker(control, lambda: self.now_s)
        self.injector = Injector(control.dt_s, self._change)
        self.reference = SoakReference(control.dt_s, control.low_um, control.high_um, control.seed)
        self._stage, self._state, self._axis, self._control = stage, stage.initial_state(), axis, control
        self._commands: dict[int, FloatArray] = {}

    @property
    def now_s(self) -> float:
        """Time of the stage, s."""
        return self.k * self._control.dt_s

    def begin_fault(self, fault: PlannedFault) -> None:
        """Begin a fault."""
        c = self._control
        if fault.kind in CHANGES:
            self.injector.add(Fault(CHANGE, values=((CHANGES[fault.kind], fault.value),)))
        elif fault.kind == "dwell":
            self.reference.dwells.append((self.k + round(0.3 / c.dt_s), round(fault.duration_s / c.dt_s)))
        else:
            name, value = fault.for_stage(c.low_um, c.high_um)
            self.injector.add(Fault(name, max(fault.duration_s, c.dt_s), value))

    def command(self, block: int, y_um: FloatArray, u_V: FloatArray) -> None:
        """Take the (n,) voltages of a block for its reference."""
        self._commands[block] = u_V
        self.track.want(block * self._control.block, y_um)
        self.track.command(block * self._control.block, u_V)

    def run(self, block: int) -> None:
        """Run a block with its voltages, and deliver its samples."""
        u_V, dt_s = self._commands.pop(block), self._control.dt_s
        y_um, sound_um = np.empty(u_V.size), np.empty(u_V.size)
        for i, value in enumerate(u_V.tolist()):
            sound_um[i] = self._stage.step(self._state, value)[0]
            y_um[i] = self.injector.reading(self.k + i, sound_um[i])
        seq = np.arange(self.k, self.k + u_V.size, dtype=np.int64)
        self.k += u_V.size
        for first in range(0, u_V.size, SAMPLES_PER_MESSAGE):
            part = slice(first, first + SAMPLES_PER_MESSAGE)
            rows = (seq[part], seq[part].astype(np.float64) * dt_s, u_V[part], y_um[part])
            self.track.take_sound(SampleBatch(*rows[:3], sound_um[part]))
            for message in self.injector.deliver(rows):
                batch = SampleBatch(*message)
                self._axis.handle(batch)
                self.track.take(batch)

    def status(self) -> dict[str, Any]:
        """The part of the service's status that the invariants use."""
        axis = self._axis
        counters = {} if axis.learner is None else axis.learner.counters()
        return {
            "samples": {**axis.sequence.counters(), "gates": axis.gates}, "learner": counters, "seq": axis.handled_seq
        }  # fmt: skip

    def _change(self, values: dict[str, float]) -> None:
        self._state = self._stage.with_changes(self._state, values)
