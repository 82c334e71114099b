"""The run in real time: stage, service, controller, viewer stream and a bare paced loop as processes over zenoh."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lab.demo.fast import Progress
from lab.demo.plan import AXIS, MODELS, STAGE, TEACHER, UNITS, Plan
from lab.demo.result import Run
from lab.testbed.processes import Child, Children, free_port
from service.client.client import Client
from service.protocol import samples as wire
from service.protocol.errors import ServiceError
from service.protocol.keys import Keys
from service.runtime.delivery import SURELY, wait_followed
from service.runtime.session import open_client
from service.storage.recorder import Recorder

CLI = ["-m", "lab.cli"]
#: As a converter's driver hands them over; five twins would otherwise send five thousand messages a second.
SAMPLES_A_MESSAGE = 5
_READY_S, _OVERTIME_S = 60.0, 30.0


def record_identification(plan: Plan, recorder: Recorder, logs: Path, progress: Callable[[int], None]) -> None:
    """Drive a stage process with the chapter's signal (2.37) and record what it publishes.

    Raises ServiceError if not every sample came.
    """
    u_V = plan.identification_voltage()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    keys = Keys(STAGE, AXIS)
    received = 0

    def take(sample: object) -> None:
        nonlocal received
        batch = wire.decode_samples(sample.payload.to_bytes())  # type: ignore[attr-defined]
        recorder.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, "identification")
        received += len(batch)

    with Children(logs) as children:
        stage = children.start("stage-identification", _stage(plan, ["--listen", endpoint], len(u_V), changing=False))
        stage.wait_line("ready", _READY_S)
        with open_client(endpoint, _READY_S) as session:
            subscriber = session.declare_subscriber(keys.sample, take)
            commands = session.declare_publisher(keys.command, congestion_control=SURELY)
            # The subscription must have reached the stage before its clock starts.
            time.sleep(0.3)
            if not wait_followed(commands, _READY_S):
                raise ServiceError(f"identification: no stage takes commands within {_READY_S:g} s: {stage.words()}")
            for first in range(0, len(u_V), 1000):
                commands.put(wire.encode_command(first, u_V[first : first + 1000]))
            until = time.monotonic() + plan.identify_s + _OVERTIME_S
            while received < len(u_V) and stage.running and time.monotonic() < until:
                progress(received)
                time.sleep(0.2)
            if stage.wait(_OVERTIME_S) != 0 or received < len(u_V):
                raise ServiceError(f"identification: got {received} of {len(u_V)} samples; stage: {stage.words()}")
            for entity in (subscriber, commands):
                entity.undeclare()  # type: ignore[no-untyped-call]


def run_live(
    plan: Plan, config: Path, endpoint: str, rrd: Path, view: list[str], logs: Path, progress: Progress
) -> Run:
    """Run the plan in real time on processes; ``config`` is that of the service. Raises ServiceError if one fails."""
    twins = [name for name in MODELS if name != TEACHER]
    plan_file, result = logs / "plan.json", logs / "run.npz"
    with Children(logs) as children:
        plan_file.write_text(json.dumps(asdict(plan)))
        server = children.start("serve", [*CLI, "serve", "--config", str(config), "--json"])
        server.wait_line("{", _READY_S)
        where_shown = ["--stage", STAGE, "--axis", AXIS, "--range-um", str(plan.range_um)]
        where_shown += [f"--twin={UNITS[name]}={name}" for name in twins]
        viewer = children.start(
            "view",
            [*CLI, "view", "--endpoint", endpoint, "--rrd", str(rrd), "--json", *view, *where_shown],
        )
        viewer.wait_line("viewing", _READY_S)
        where = ["--endpoint", endpoint, "--twins", ",".join(UNITS[name] for name in twins)]
        stage = children.start("stage", _stage(plan, where, plan.ticks, changing=True))
        stage.wait_line("ready", _READY_S)
        bare = children.start("bare-loop", ["-m", "lab.demo.bare_loop", str(plan.dt_s), str(plan.ticks)])
        controller = children.start("controller", ["-m", "lab.demo.controller", str(plan_file), endpoint, str(result)])
        _follow(controller, [server, stage], plan, progress)
        if stage.wait(_OVERTIME_S) != 0:
            raise ServiceError(f"the stage failed: {stage.words()}")
        bare.wait(_OVERTIME_S)
        _settle(endpoint, plan)
        server.stop()
        viewer.stop(60.0)
        return _collect(result, server, stage, bare)


def _stage(plan: Plan, where: list[str], ticks: int, *, changing: bool) -> list[str]:
    arguments = [*CLI, "stage", "--name", STAGE, "--axis", AXIS, "--rate", f"{1.0 / plan.dt_s:g}", *where]
    arguments += ["--file", plan.stage_file] if plan.stage_file else []
    arguments += ["--seed", str(plan.seed), "--duration", repr(ticks * plan.dt_s)]
    arguments += ["--batch", str(SAMPLES_A_MESSAGE)]
    for t_s, values in plan.stage(changing=changing).changes:
        arguments += ["--change", f"{t_s!r}:" + ",".join(f"{name}={value!r}" for name, value in values.items())]
    return arguments


def _follow(controller: Child, needed: list[Child], plan: Plan, progress: Progress) -> None:
    until = time.monotonic() + plan.ticks * plan.dt_s + _READY_S + _OVERTIME_S
    told = 0
    while controller.running and time.monotonic() < until:
        for child in needed:
            if not child.running and controller.running and child is needed[0]:
                raise ServiceError(f"{child.name} ended before its time: {child.words()}")
        for line in controller.lines[told:]:
            told += 1
            said = json.loads(line)
            if "error" in said:
                raise ServiceError(f"controller: {said['error']}")
            if "done_ticks" in said:
                progress(said["done_ticks"], said["error_um"])
        time.sleep(0.1)
    if controller.wait(1.0) != 0:
        raise ServiceError(f"the controller failed: {controller.words()}")


def _settle(endpoint: str, plan: Plan) -> None:
    """Until the service has handled the last sample, or a few seconds are over: then its counts tell what it missed."""
    until = time.monotonic() + 5.0
    with Client.connect(endpoint, STAGE, AXIS, wait_s=1.0) as client:
        while client.status()["seq"] < plan.ticks - 1 and time.monotonic() < until:
            time.sleep(0.05)


def _collect(result: Path, server: Child, stage: Child, bare: Child) -> Run:
    with np.load(result) as kept:
        y_um, u_V, std_V = ({name: kept[f"{kind}/{name}"] for name in MODELS} for kind in ("y_um", "u_V", "std_V"))
        query_s, late = kept["query_s"], int(kept["late"])
    result.unlink()
    units = stage.last_json()["units"]
    served = server.last_json()["axes"][AXIS]["samples"]
    samples = {
        "sent": units[AXIS]["published"],
        "received": served["received"],
        "learnt": served["learnt"],
    }
    summary = stage.last_json()
    missing = max(unit["commands"]["missing"] for unit in units.values())
    ticks = {
        "count": summary["tick"],
        "late": missing,
        "stage_late": summary["late"],
        "bare_late": bare.last_json()["late"],
    }
    return Run(y_um, u_V, std_V, query_s=query_s, late_queries=late, samples=samples, ticks=ticks)
