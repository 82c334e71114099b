"""One demonstration: record, identify, run, score, draw, and write the files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import zenoh

from dehyst.lab.demo.controller import KEPT, FollowedModels
from dehyst.lab.demo.plan import (
    AXIS,
    LOCK_STEP_S,
    MODELS,
    SNAPSHOT_EVERY,
    STAGE,
    TEACHER,
    UNITS,
    Plan,
    make_plan,
)
from dehyst.lab.demo.raster import ALONE, REPETITION, draw_raster, run_raster
from dehyst.lab.demo.result import DemoRun, draw_loops, draw_tracking
from dehyst.lab.loop import Twins, samples, turns
from dehyst.lab.testbed.identified_stage import READY_S, Rig, identify_stage, write_service_config
from dehyst.lab.testbed.processes import Child
from dehyst.service.client.client import Client
from dehyst.service.client.follower import Follower
from dehyst.service.config.settings import read_config
from dehyst.service.identification.identifying import NAMES
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.model import encode_model
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.storage.output import clear_output
from dehyst.service.storage.recorder import Recorder, RecorderConfig
from dehyst.sim.stage.stage import Stage

# --- In real time or slower: stage, service, controller and viewer stream as processes over zenoh.


#: A process may end so much later than planned, s.
_OVERTIME_S: Final = 30.0


def run_live(plan: Plan, config: Path, rig: Rig, rrd: Path, view: list[str], progress: Progress) -> DemoRun:
    """Run the plan on the processes of ``rig``, in real time or slower; ``config`` is that of the service.

    Raises ServiceError if a process fails.
    """
    twins = {name: UNITS[name] for name in MODELS if name != TEACHER}
    plan_file, result = rig.logs / "plan.json", rig.logs / "run.npz"
    plan_file.write_text(json.dumps(asdict(plan)))
    with rig:
        server = rig.start_service(config)
        shown = [f"--twin={unit}={name}" for name, unit in twins.items()]
        viewer = rig.start_viewer(rrd, STAGE, AXIS, plan.range_um, *view, *shown)
        where = ["--endpoint", rig.endpoint, "--twins", ",".join(twins.values())]
        stage = rig.start_stage(STAGE, AXIS, *where, *_stage_options(plan))
        program = ["-m", "dehyst.lab.demo.controller", str(plan_file), rig.endpoint, str(result)]
        controller = rig.start("controller", program, wait=False)
        _follow(controller, server, progress)
        if stage.wait(_OVERTIME_S) != 0:
            raise ServiceError(f"the stage failed: {stage.output_tail()}")
        _wait_until_handled(rig.endpoint, plan)
        server.stop()
        viewer.stop(60.0)
        return _collect(result, server, stage)


def _stage_options(plan: Plan) -> list[str]:
    options = ["--rate", f"{1.0 / plan.dt_s:g}", "--seed", str(plan.seed), "--duration", repr(plan.ticks * plan.dt_s)]
    options += ["--batch", str(plan.block)]
    options += [] if plan.strict else ["--lock-step", repr(LOCK_STEP_S)]
    for t_s, values in plan.stage(changing=True).changes:
        options += ["--change", f"{t_s!r}:" + ",".join(f"{name}={value!r}" for name, value in values.items())]
    return options


def _follow(controller: Child, server: Child, progress: Progress) -> None:
    """Report the controller's progress until it ends. Raises ServiceError if it or the service fails."""
    limit_s = READY_S + _OVERTIME_S  # until the next report, of a second of the stage's time
    until, read = time.monotonic() + limit_s, 0
    while controller.running and time.monotonic() < until:
        if not server.running and controller.running:
            raise ServiceError(f"{server.name} ended before its time: {server.output_tail()}")
        for line in controller.lines[read:]:
            read, until = read + 1, time.monotonic() + limit_s
            message = json.loads(line)
            if "error" in message:
                raise ServiceError(f"controller: {message['error']}")
            if "done_ticks" in message:
                progress(message["done_ticks"], message["error_um"])
        time.sleep(0.1)
    if controller.wait(1.0) != 0:
        raise ServiceError(f"the controller failed: {controller.output_tail()}")


def _wait_until_handled(endpoint: str, plan: Plan) -> None:
    """Wait, for at most 5 s, until the service has handled the last sample: its counts are then complete."""
    until = time.monotonic() + 5.0
    with Client.connect(endpoint, STAGE, AXIS, wait_s=1.0) as client:
        while client.status()["seq"] < plan.ticks - 1 and time.monotonic() < until:
            time.sleep(0.05)


def _collect(result: Path, server: Child, stage: Child) -> DemoRun:
    with np.load(result) as kept:
        y_um = {name: kept[f"y_um/{name}"] for name in MODELS}
        query_s, followed = kept["query_s"], json.loads(str(kept["followed"]))
    result.unlink()
    summary = stage.last_json()
    units = summary["units"]
    served = server.last_json()["axes"][AXIS]["samples"]
    samples = {"sent": units[AXIS]["published"], "received": served["received"], "learnt": served["learnt"]}
    ticks = {
        "count": summary["tick"],
        "late": max(unit["commands"]["missing"] for unit in units.values()),
    }
    stage_s = summary["tick"] * summary["dt_s"]
    pace = {"stage_s": stage_s, "ran_s": summary["ran_s"], "waited_s": summary["waited_s"]}
    return DemoRun(y_um, query_s, samples, ticks, followed, pace)


# --- In one process, as fast as possible: the same models, queries and answers, without a network.


#: Called with the number of ticks done and, by model, the mean absolute error of the last second, µm.
Progress = Callable[[int, dict[str, float]], None]


class _Loopback:
    """The part of a session that a follower needs: what is published here is delivered at once."""

    def __init__(self) -> None:
        self._deliver: Callable[[Any], None] | None = None

    def declare_subscriber(self, key: str, deliver: Callable[[Any], None]) -> Any:
        """Deliver to ``deliver`` from now on."""
        self._deliver = deliver
        return SimpleNamespace(undeclare=lambda: None)

    def put(self, payload: bytes) -> None:
        """Publish."""
        if self._deliver is not None:
            self._deliver(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


def run_fast(plan: Plan, axis: Axis, recorder: Recorder, progress: Progress) -> DemoRun:
    """Run the plan on twin stages, by followers that get their models as in real time, message by message.

    The teacher's samples go into ``axis``.
    """
    n, size, ahead = plan.ticks, plan.block, plan.lead // plan.block
    twins, wanted_um = Twins(Stage(plan.stage(changing=True)), tuple(MODELS), n), plan.reference()[0]
    loopback, streams = _Loopback(), DeltaStreams(axis)
    streams.publish(TEACHER, loopback.put, lambda: True)
    streams.tick(0.0)
    session = cast(zenoh.Session, loopback)
    followers = {}
    for name in MODELS:
        model, seq, memory = axis.model(name)
        payload = encode_model(name, model, seq, memory, axis.safety(name))
        key = "delta" if name == TEACHER else None
        followers[name] = Follower(session, key, name, payload.__bytes__, axis.limits, keep=KEPT)
    models = FollowedModels(plan, followers)
    for run, asked in turns(n // size, ahead):
        if run is not None:
            part = slice(run * size, (run + 1) * size)
            twins.run(part)
            batch = samples(part.start, plan.dt_s, twins.u_V[TEACHER][part], twins.y_um[TEACHER][part])
            recorder.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, axis.handle(batch))
            streams.tick(part.stop * plan.dt_s)
            if part.stop % 1000 == 0:
                last = slice(part.stop - 1000, part.stop)
                errors = {k: float(np.mean(np.abs(wanted_um[last] - y_um[last]))) for k, y_um in twins.y_um.items()}
                progress(part.stop, errors)
        if asked is not None:
            for name, begin, u_V in models.constant(asked * size):
                twins.u_V[name][begin : begin + u_V.size] = u_V
            begin, u_V = models.block(asked, asked, asked + 1)
            twins.u_V[TEACHER][begin : begin + u_V.size] = u_V
    counts = {"sent": n, "received": axis.handled_seq + 1, "learnt": axis.gates.get("learnt", 0)}
    ticks = {"count": n, "late": 0}
    return DemoRun(twins.y_um, np.asarray(models.durations_s), counts, ticks, models.counts())


Say = Callable[[str], None]
#: Files and folders of a run. Those of an older run are removed first; other files stay.
OURS = (
    "summary.json",
    "tracking.png",
    "loops.png",
    "raster.png",
    "demo.rrd",
    "recording",
    "identification",
    "model.npz",
    "logs",
)


@dataclass(frozen=True, slots=True)
class Done:
    """A finished demonstration."""

    plan: Plan
    run: DemoRun
    summary: dict[str, Any]


def run(
    out: Path,
    *,
    fast: bool,
    duration_s: float,
    seed: int,
    view: list[str],
    say: Say,
    strict: bool = False,
) -> Done:
    """Run everything and write the results into ``out``. ``strict`` : the stage's clock waits for no voltage.

    Raises InputError on a folder that cannot be used, ServiceError if a process fails.
    """
    clear_output(out, OURS)
    logs = out / "logs"
    logs.mkdir()
    plan = make_plan(duration_s, seed, strict)
    say("[1/3] identifying five inverse models from 10 s of the chapter's training signal on a rested stage")
    _identify(plan, out / "identification", out / "model.npz", say)
    live = "in real time" if strict else f"in real time, waiting up to {LOCK_STEP_S:g} s for each other"
    kind = "as fast as possible, in one process" if fast else f"in processes over zenoh, {live}"
    say(f"[2/3] {plan.run_s:g} s of a reference that no model has seen, {kind}")
    say(f"      after {plan.run_s / 2:g} s the stage changes: {plan.change_text}")
    rig = Rig(logs)
    config = _configure(plan, out, logs / "serve.toml", rig.endpoint)
    next_s = 5.0

    def progress(ticks: int, error_um: dict[str, float]) -> None:
        nonlocal next_s
        done_s = ticks * plan.dt_s
        if done_s + 1e-9 >= next_s:
            next_s = (done_s // 5.0 + 1.0) * 5.0
            parts = ", ".join(f"{name} {100.0 * value / plan.range_um:.3f}" for name, value in error_um.items())
            bar = f"[{'#' * round(20.0 * min(1.0, done_s / plan.run_s)):<20}] {done_s:4.0f} of {plan.run_s:g} s"
            say(f"  {bar}  mean |error| of the last second, % of range: {parts}")

    if fast:
        axis = load_axis(STAGE, read_config(config).axes[0])
        with Recorder(RecorderConfig(out / "recording")) as recorder:
            done = run_fast(plan, axis, recorder, progress)
    else:
        done = run_live(plan, config, rig, out / "demo.rrd", view, progress)
    say("[3/3] a raster on a rested stage, and the pictures")
    raster = run_raster(plan, {way: load_axis(STAGE, read_config(config).axes[0]) for way in (ALONE, REPETITION)})
    wanted_um = plan.reference()[0]
    summary = done.summary(plan, wanted_um) | {"mode": "fast" if fast else "real_time", "raster": raster.summary()}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    draw_tracking(out / "tracking.png", plan, wanted_um, done.y_um)
    draw_loops(out / "loops.png", plan, wanted_um, done.y_um)
    draw_raster(out / "raster.png", plan, raster)
    return Done(plan, done, summary)


def _identify(plan: Plan, folder: Path, model: Path, say: Say) -> None:
    """Identify the models on a rested stage; the recording that they come from goes into ``folder``."""
    stage = plan.stage(changing=False)
    found = identify_stage(stage, model, STAGE, AXIS, NAMES, TEACHER, lambda name: say(f"  {MODELS[name]} ..."))
    seq = np.arange(found.u_V.size)
    with Recorder(RecorderConfig(folder)) as recorder:
        recorder.put(seq, seq * plan.dt_s, found.u_V, found.y_um, "identification")


def _configure(plan: Plan, out: Path, path: Path, endpoint: str) -> Path:
    """Write the configuration of the service to ``path``."""
    stage = plan.stage(changing=True)
    axis = {
        "name": AXIS,
        "model": out / "model.npz",
        "u_min_V": stage.u_min_V,
        "u_max_V": stage.u_max_V,
        "slew_V_per_s": 4000.0,
        "learn": TEACHER,
        "snapshot_every": SNAPSHOT_EVERY,
        "delta_hz": 1.0 / (plan.block * plan.dt_s),
        "recorder": out / "recording",
        # Background tuning ends at a time that depends on the machine; a fast run must give the same numbers.
        "retuning": {"period_s": 0.0},
    }
    write_service_config(path, STAGE, axis, listen=[endpoint])
    return path
