"""A soak in one process: stage, axis and controller in turns, with the faults of samples, stage and reference."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from lab.soak.fault_plan import PlannedFault, SoakPlan
from lab.soak.task import AXIS, SERVED, STAGE, ControlTask, SoakReference
from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.observations import Counters, FaultRecord, Observations, SampleTracker, flatten_status
from lab.testbed.rig import SAMPLES_PER_MESSAGE
from service.answers.guard import Limits
from service.client.pending import PendingCommands
from service.config.settings import AxisConfig
from service.protocol.query import FeedforwardQuery
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.server.axis_loading import load_axis
from service.stage_node.faults import CHANGE, Fault, Injector
from sim.stage.config import StageConfig
from sim.stage.stage import Stage

_PROGRESS_S = 5.0


def run_fast(
    out: Path, stage: StageConfig, control: ControlTask, plan: SoakPlan, observed: Observations, interim: InterimJudge,
    stopped: Callable[[], bool], say: Callable[[str], None],
) -> dict[str, int]:  # fmt: skip
    """Run the plan and record it in ``observed``; returns the counts of samples. Times are those of the stage."""
    limits = Limits(control.u_min_V, control.u_max_V, control.slew_V_per_s)
    config = AxisConfig(AXIS, out / "model.npz", limits, served=SERVED, snapshot_every=control.block)
    turn = _Turns(Stage(stage), load_axis(STAGE, config), control)
    observed.seconds = turn.track.seconds
    waiting = list(plan.faults)
    under_way: list[tuple[float, FaultRecord]] = []
    begin, reported_s = time.monotonic(), 0.0
    while turn.now_s < plan.duration_s and not stopped():
        while waiting and waiting[0].at_s <= turn.now_s:
            fault = waiting.pop(0)
            record = FaultRecord(fault.kind, turn.now_s, value=fault.value)
            turn.begin_fault(fault)
            observed.faults.append(record)
            under_way.append((fault.end_s, record))
        for end_s, record in list(under_way):
            if end_s <= turn.now_s:
                record.end_s = turn.now_s
                under_way.remove((end_s, record))
        turn.step()
        if turn.second_is_over():
            observed.counters.append((turn.now_s, "service", Counters(flatten_status(turn.status()))))
            # In a service the axis loop publishes them.
            observed.events += [{"t_s": turn.now_s, **event} for event in turn.axis.take_events()]
            interim.due(turn.now_s, lambda: _samples(turn))
        if time.monotonic() - reported_s >= _PROGRESS_S:
            reported_s = time.monotonic()
            done = turn.now_s / plan.duration_s
            mae = [s.mae_um for s in turn.track.seconds[-2:-1]]
            error = f"error {100.0 * mae[0] / control.range_um:.3f} % of range, " if mae else ""
            speed = turn.now_s / max(reported_s - begin, 1e-3)
            say(
                f"  [{'#' * round(20 * min(1.0, done)):<20}] {turn.now_s:6.0f} of {plan.duration_s:g} s  {error}"
                f"{len(observed.faults)} of {len(plan.faults)} faults, {speed:.1f} times as fast as real time"
            )
    observed.duration_s = turn.now_s
    observed.seconds = turn.track.seconds[:-1] or turn.track.seconds
    observed.notes.append("In one process: latency, memory, recordings and take-overs are not part of this run.")
    return _samples(turn)


def _samples(turn: _Turns) -> dict[str, int]:
    status = turn.status()
    samples = {name: int(status["samples"][name]) for name in ("received", "lost", "late", "restarts")}
    learnt = turn.axis.gates.get("learnt", 0)
    return {"read": turn.k, **samples, "learnt": learnt, "withheld_by_faults": turn.injector.counts["gap"]}


class _Turns:
    """Stage, axis and controller, one block of samples at a time; the controller asks ``lead`` samples ahead."""

    def __init__(self, stage: Stage, axis: Axis, control: ControlTask) -> None:
        self.axis = axis
        self.k = 0
        self.track = SampleTracker(control, lambda: self.now_s)
        self.injector = Injector(control.dt_s, self._change)
        self._stage, self._state = stage, stage.initial_state()
        self._control = control
        self._reference = SoakReference(control.dt_s, control.low_um, control.high_um, control.seed)
        self._commands: dict[int, FloatArray] = {}
        self._asked = 0
        self._commanded = PendingCommands()
        self._last_V = math.nan
        self._second = 0

    @property
    def now_s(self) -> float:
        """Time of the stage, s."""
        return self.k * self._control.dt_s

    def second_is_over(self) -> bool:
        """True once per second."""
        if int(self.now_s) == self._second:
            return False
        self._second = int(self.now_s)
        return True

    def begin_fault(self, fault: PlannedFault) -> None:
        """Begin a fault."""
        c = self._control
        changes = {"gain": "gain_drift.gain", "payload": "resonance.payload_ratio"}
        if fault.kind in changes:
            self.injector.add(Fault(CHANGE, values=((changes[fault.kind], fault.value),)))
        elif fault.kind == "dwell":
            self._reference.dwells.append((self.k + round(0.3 / c.dt_s), round(fault.duration_s / c.dt_s)))
        else:
            value = 0.5 * (c.low_um + c.high_um) if fault.kind == "saturate" else fault.value
            kind = "clock" if fault.kind == "stage_clock" else fault.kind
            self.injector.add(Fault(kind, max(fault.duration_s, c.dt_s), value))

    def step(self) -> None:
        """Run one block of samples."""
        size = self._control.block
        while self._asked <= self.k + self._control.lead:
            self._ask()
        u_V = self._commands.pop(self.k)
        y_um = np.empty(size)
        for i, value in enumerate(u_V.tolist()):
            y_um[i] = self.injector.reading(self.k + i, self._stage.step(self._state, value)[0])
        seq = np.arange(self.k, self.k + size, dtype=np.int64)
        self.k += size
        for first in range(0, size, SAMPLES_PER_MESSAGE):
            part = slice(first, first + SAMPLES_PER_MESSAGE)
            rows = (seq[part], seq[part].astype(np.float64) * self._control.dt_s, u_V[part], y_um[part])
            for message in self.injector.deliver(rows):
                batch = SampleBatch(*message)
                self.axis.handle(batch)
                self.track.take(batch)

    def status(self) -> dict[str, Any]:
        """The part of the service's status that the invariants use."""
        axis = self.axis
        counters = {} if axis.learner is None else axis.learner.counters()
        samples = {**axis.sequence.counters(), "dropped": 0, "gates": axis.gates}
        return {"samples": samples, "learner": counters, "seq": axis.handled_seq}

    def _ask(self) -> None:
        size = self._control.block
        motion = self._reference.rows(self._asked, size)
        pending = self._commanded.before(self._asked)
        reply = self.axis.answer(
            FeedforwardQuery(motion[0], motion[1], motion[2], u_before_V=self._last_V, pending=pending)
        )
        self._commanded.take(self._asked, motion[0], reply)
        self._last_V = float(reply.u_V[-1])
        self._commands[self._asked] = reply.u_V
        self.track.want(self._asked, motion[0])
        self.track.command(self._asked, reply.u_V)
        self._asked += size

    def _change(self, values: dict[str, float]) -> None:
        self._state = self._stage.with_changes(self._state, values)
