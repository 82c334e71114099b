"""One soak: identify the stage, run the plan, judge the observations, draw, and write the files."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.types import FloatArray
from lab.soak.controller import AXIS, SERVED, STAGE, ControlTask, SoakReference
from lab.soak.fault_plan import FAULT_KINDS, PlannedFault, SoakPlan
from lab.soak.live import Say, run_live, withheld
from lab.soak.rig import identify, stage_config
from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.invariants import TRACKING_PCT, judge, recorded
from lab.soak.verdict.observations import (
    FAST,
    REAL_TIME,
    RESTART_GAP,
    Counters,
    FaultRecord,
    Intervals,
    Observations,
    SampleTracker,
    assess_recovery,
    flatten_status,
    judge_sensor_fault,
    stage_gain,
    troubles_since,
)
from lab.soak.verdict.outcome import SECONDS, report, soak_summary, write_seconds, write_summary
from lab.testbed.identified_stage import SAMPLES_PER_MESSAGE
from service.answers.guard import Limits
from service.client.client import PendingCommands
from service.config.settings import AxisConfig
from service.protocol.query import FeedforwardQuery
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.server.axis_loading import load_axis
from service.stage_node.faults import CHANGE, Fault, Injector
from service.storage.output import clear_output
from sim.stage.config import StageConfig
from sim.stage.stage import Stage

# --- A soak in one process: stage, axis and controller in turns, with the faults of samples, stage and reference.

_PROGRESS_S = 5.0


def run_fast(
    out: Path, stage: StageConfig, control: ControlTask, plan: SoakPlan, observed: Observations, interim: InterimJudge,
    stopped: Callable[[], bool], say: Callable[[str], None],
) -> dict[str, int]:  # fmt: skip
    """Run the plan and record it in ``observed``; returns the counts of samples. Times are those of the stage."""
    limits = Limits(control.u_min_V, control.u_max_V, control.slew_V_per_s)
    config = AxisConfig(AXIS, out / "model.npz", limits, served=SERVED, snapshot_every=control.block)
    turn = _Turns(Stage(stage), load_axis(STAGE, config), control)
    observed.follow(turn.track.seconds)
    waiting = list(plan.faults)
    under_way: list[tuple[float, FaultRecord]] = []
    begin, reported_s = time.monotonic(), 0.0
    while turn.now_s < plan.duration_s and not stopped():
        while waiting and waiting[0].at_s <= turn.now_s:
            fault = waiting.pop(0)
            record = FaultRecord(fault.kind, turn.now_s, value=fault.value, begin_seq=turn.k)
            turn.begin_fault(fault)
            observed.faults.append(record)
            under_way.append((fault.end_s, record))
        for end_s, record in list(under_way):
            if end_s <= turn.now_s:
                record.end(turn.now_s)
                under_way.remove((end_s, record))
                if FAULT_KINDS[record.kind].sensor:
                    take_events(turn, observed)
                    gain = stage_gain(observed.faults, record.begin_s)
                    named = troubles_since(observed.events, record.begin_seq)
                    judge_sensor_fault(record, turn.track, named, turn.k - 1, gain)
        turn.step()
        if turn.second_is_over():
            observed.counters.append((turn.now_s, "service", Counters(flatten_status(turn.status()))))
            take_events(turn, observed)
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
    observed.end(turn.now_s, turn.track.seconds)
    observed.notes.append("In one process: latency, memory, recordings and take-overs are not part of this run.")
    return _samples(turn)


def take_events(turn: _Turns, observed: Observations) -> None:
    """The events since the last call; in a service the axis loop publishes them."""
    observed.events.extend({"t_s": turn.now_s, **event} for event in turn.axis.take_events())


def _samples(turn: _Turns) -> dict[str, int]:
    status = turn.status()
    samples = {name: int(status["samples"][name]) for name in ("received", "lost", "late", "restarts")}
    learnt = turn.axis.gates.get("learnt", 0)
    return {"read": turn.k, **samples, "learnt": learnt, "withheld_by_faults": _withheld(turn)}


def _withheld(turn: _Turns) -> int:
    return turn.injector.counts["gap"] + turn.injector.counts["losses"]


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
            value = {"saturate": 0.5, "other_stage": 1.0}.get(fault.kind, 0.0) * (c.low_um + c.high_um) or fault.value
            kind = "clock" if fault.kind == "stage_clock" else fault.kind
            self.injector.add(Fault(kind, max(fault.duration_s, c.dt_s), value))

    def step(self) -> None:
        """Run one block of samples."""
        size = self._control.block
        while self._asked <= self.k + self._control.lead:
            self._ask()
        u_V = self._commands.pop(self.k)
        y_um, sound_um = np.empty(size), np.empty(size)
        for i, value in enumerate(u_V.tolist()):
            sound_um[i] = self._stage.step(self._state, value)[0]
            y_um[i] = self.injector.reading(self.k + i, sound_um[i])
        seq = np.arange(self.k, self.k + size, dtype=np.int64)
        self.k += size
        for first in range(0, size, SAMPLES_PER_MESSAGE):
            part = slice(first, first + SAMPLES_PER_MESSAGE)
            t_s = seq[part].astype(np.float64) * self._control.dt_s
            rows = (seq[part], t_s, u_V[part], y_um[part])
            self.track.take_sound(SampleBatch(*rows[:3], sound_um[part]))
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


#: Files and folders of a run. Those of an older run are removed first; other files stay.
OURS = ("soak.json", "report.md", "plan.json", SECONDS, "error.png", "latency.png", "memory.png",
        "soak.rrd", "model.npz", "a", "b", "logs")  # fmt: skip
#: Limit of the error for a stage from a file, as a multiple of the error before the first fault.
OWN_STAGE_RATIO = 2.0
#: Age of records that may also be lost, s: they wait to be written when the disk is full, or to be sent when the
#: router dies. The seconds of a soak are named by their beginning.
WAITING_S = 1.0
#: Longest gap between two seconds with samples, s.
_BEFORE_S = 30.0


@dataclass(frozen=True, slots=True)
class Done:
    """A finished soak: the content of ``soak.json``, and whether the run was ended early."""

    found: dict[str, Any]
    interrupted: bool


def run(
    out: Path, plan: SoakPlan, *, fast: bool, stage_file: Path | None, stopped: Callable[[], bool], say: Say
) -> Done:
    """Run the plan and write the results into ``out``. ``stage_file``: a stage in place of the default one.

    Raises InputError on a folder or a stage that cannot be used, ServiceError if a process does not start.
    """
    clear_output(out, OURS)
    (out / "logs").mkdir()
    stage = stage_config(stage_file, plan.seed)
    say(f"[1/3] identifying stage {stage.name!r} from 10 s of the chapter's signal")
    control = identify(stage, out / "model.npz", plan.seed)
    where = "in one process, as fast as it goes" if fast else "in real time, in processes over zenoh"
    say(f"[2/3] {plan.duration_s:g} s with {len(plan.faults)} faults, {where}")
    if plan.left_out:
        say(f"      no time for: {', '.join(plan.left_out)}")
    step_V, mode = control.slew_V_per_s * control.dt_s, FAST if fast else REAL_TIME
    observed = Observations(0.0, control.range_um, step_V, mode, planned=len(plan.faults))
    # For a stage from a file the limit is known only when the first fault begins; it is judged at the end.
    interim = InterimJudge(observed, out / "soak.json", say, TRACKING_PCT if stage_file is None else None)
    missing: int | None = None
    if fast:
        samples = run_fast(out, stage, control, plan, observed, interim, stopped, say)
    else:
        monitor = run_live(out, stage, control, plan, observed, interim, stopped, say)
        missing, samples = _kept(out, observed, monitor.track.seen, monitor.track.received)
        samples |= {"withheld_by_faults": withheld(monitor.stage)}
        samples |= {"without_their_voltage_in_time": sum(s.held for s in observed.seconds)}
    say("[3/3] judging and drawing")
    assess_recovery(observed)
    invariants = judge(observed, missing, **_tracking_limit(observed, stage_file))
    found = soak_summary(observed, invariants, samples)
    observed.notes.extend(_machine(observed))
    interrupted = observed.duration_s < plan.duration_s - 1.0
    write_summary(out / "soak.json", found)
    write_seconds(out / SECONDS, observed)
    pictures = _draw(out, observed)
    text = report(found, observed, plan, pictures, interrupted)
    (out / "report.md").write_text(text, encoding="utf-8")
    happened = [
        {"kind": f.kind, "begin_s": f.begin_s, "end_s": f.end_s, "recovered_s": f.recovered_s, "silent_s": f.silent_s,
         "told": f.reported_by, "value": f.value, "error_pct": f.error_pct, "named_s": f.named_s,
         "breaches": f.breaches, "unjudged": f.unjudged}
        for f in observed.faults
    ]  # fmt: skip
    kept = {"seed": plan.seed, "duration_s": plan.duration_s, "left_out": plan.left_out, "faults": happened}
    (out / "plan.json").write_text(json.dumps({**kept, "events": observed.events}, indent=1) + "\n", encoding="utf-8")
    return Done(found, interrupted)


def _tracking_limit(observed: Observations, stage_file: Path | None) -> dict[str, float]:
    if stage_file is None:
        return {}
    first = observed.faults[0].begin_s if observed.faults else observed.duration_s
    calm = [s for s in observed.seconds if s.judged and 2.0 <= s.t_s < first]
    if not calm:
        return {}
    # A second in which the stage held a voltage says something about the machine, not about the model.
    calm = [s for s in calm if not s.held] or calm
    mae_um = sum(s.error_sum_um for s in calm) / sum(s.judged for s in calm)
    return {"tracking_pct": OWN_STAGE_RATIO * 100.0 * mae_um / observed.range_um}


def _machine(observed: Observations) -> list[str]:
    """A sentence on how busy the machine was."""
    if not observed.loop_delays or not observed.other_load:
        return []
    late_ms = [1e3 * late_s for _, late_s in observed.loop_delays]
    share = [100.0 * share for _, share in observed.other_load]
    (usual, often), (late, later) = (_median_and_tenth(values) for values in (share, late_ms))
    return [
        f"the machine: others than the soak had {usual:.0f} % of the cores in the median second, {often:.0f} % in one "
        f"of ten; a bare loop was late by up to {late:.1f} ms and {later:.1f} ms"
    ]


def _median_and_tenth(values: list[float]) -> tuple[float, float]:
    ordered = sorted(values)
    return ordered[len(ordered) // 2], ordered[len(ordered) * 9 // 10]


def _kept(out: Path, observed: Observations, seen: Intervals, received: int) -> tuple[int, dict[str, int]]:
    """Number of samples that the monitor saw and no service recorded though it could, and all counts of samples."""
    # A standby records too, in a folder of its own.
    folders = [
        folder
        for name in ("a", "b")
        for where in (out / name, *sorted((out / name).glob("taken-*")))
        for folder in (where / "recording", where / "recording-standby")
    ]
    found, rows = recorded(folders)
    nowhere = Intervals()
    for start, stop in seen.minus(found):
        nowhere.add(start, stop)
    missing = sum(stop - start for start, stop in nowhere.minus(unrecordable(observed)))
    return missing, {
        "seen": len(seen),
        "received_by_monitor": received,
        "recorded": len(found),
        "rows_recorded": rows,
        "in_no_recording": len(nowhere),
        "in_no_recording_and_no_fault_on": missing,
    }


def unrecordable(observed: Observations) -> Intervals:
    """Samples that the services could not record though the monitor saw them: while no file may grow, and while the
    router is gone. The services count both cases themselves."""
    excused = Intervals()
    for fault in observed.faults:
        begin, end = fault.window_s
        if fault.kind not in ("disk_full", "restart_router"):
            continue
        # Begin earlier: the samples of a second begin where the second before ended.
        around = observed.seconds_between(begin - _BEFORE_S, end)
        for last, second in itertools.pairwise(around):
            if begin - WAITING_S - 1.0 <= second.t_s <= end and second.samples:
                # Some sample numbers may be missing, also at the beginning of a second.
                follows = 0 < second.seq - last.seq < RESTART_GAP
                excused.add(last.seq + 1 if follows else second.seq - second.samples + 1, second.seq + 1)
    return excused


def _draw(out: Path, observed: Observations) -> list[str]:
    from lab.soak.verdict.outcome import draw_error, draw_latency, draw_memory

    drawn = []
    for name, draw, there in (
        ("error.png", draw_error, bool(observed.seconds)),
        ("latency.png", draw_latency, bool(observed.query_seconds)),
        ("memory.png", draw_memory, bool(observed.memory)),
    ):
        if there:
            draw(out / name, observed)
            drawn.append(name)
    return drawn
