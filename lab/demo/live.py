"""The run in real time: stage, service, controller, viewer stream and a bare paced loop as processes over zenoh."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from lab.demo.fast import Progress
from lab.demo.plan import AXIS, MODELS, STAGE, TEACHER, UNITS, Plan
from lab.demo.result import DemoRun
from lab.testbed.identified_stage import READY_S, Rig
from lab.testbed.processes import Child
from service.client.client import Client
from service.protocol import samples as wire
from service.protocol.errors import ServiceError
from service.protocol.keys import Keys
from service.runtime.session import SURELY, open_client, wait_followed
from service.storage.recorder import Recorder

#: A process may end so much later than planned, s.
_OVERTIME_S: Final = 30.0


def record_identification(plan: Plan, recorder: Recorder, logs: Path, progress: Callable[[int], None]) -> None:
    """Drive a stage process with the chapter's training signal (2.37) and record the samples that it publishes.

    Raises ServiceError if samples are missing.
    """
    u_V = plan.identification_voltage()
    keys = Keys(STAGE, AXIS)
    received = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal received
        batch = wire.decode_samples(sample.payload.to_bytes())
        recorder.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, "identification")
        received += len(batch)

    with Rig(logs) as rig:
        options = ["--listen", rig.endpoint, *_stage_options(plan, len(u_V), changing=False)]
        stage = rig.start_stage(STAGE, AXIS, *options, name="stage-identification")
        with open_client(rig.endpoint, READY_S) as session:
            subscriber = session.declare_subscriber(keys.sample, take)
            commands = session.declare_publisher(keys.command, congestion_control=SURELY)
            # The subscription must have reached the stage before its clock starts.
            time.sleep(0.3)
            if not wait_followed(commands, READY_S):
                raise ServiceError(
                    f"identification: no stage takes commands within {READY_S:g} s: {stage.output_tail()}"
                )
            for first in range(0, len(u_V), 1000):
                commands.put(wire.encode_command(first, u_V[first : first + 1000]))
            until = time.monotonic() + plan.identify_s + _OVERTIME_S
            while received < len(u_V) and stage.running and time.monotonic() < until:
                progress(received)
                time.sleep(0.2)
            if stage.wait(_OVERTIME_S) != 0 or received < len(u_V):
                raise ServiceError(
                    f"identification: got {received} of {len(u_V)} samples; stage: {stage.output_tail()}"
                )
            subscriber.undeclare()  # type: ignore[no-untyped-call]
            commands.undeclare()  # type: ignore[no-untyped-call]


def run_live(plan: Plan, config: Path, rig: Rig, rrd: Path, view: list[str], progress: Progress) -> DemoRun:
    """Run the plan in real time on the processes of ``rig``; ``config`` is that of the service.

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
        stage = rig.start_stage(STAGE, AXIS, *where, *_stage_options(plan, plan.ticks, changing=True))
        loop = rig.start_paced_loop(plan.dt_s, plan.ticks, wait=False)
        program = ["-m", "lab.demo.controller", str(plan_file), rig.endpoint, str(result)]
        controller = rig.start("controller", program, wait=False)
        _follow(controller, server, plan, progress)
        if stage.wait(_OVERTIME_S) != 0:
            raise ServiceError(f"the stage failed: {stage.output_tail()}")
        loop.wait(_OVERTIME_S)
        _wait_until_handled(rig.endpoint, plan)
        server.stop()
        viewer.stop(60.0)
        return _collect(result, server, stage, loop)


def _stage_options(plan: Plan, ticks: int, *, changing: bool) -> list[str]:
    options = ["--rate", f"{1.0 / plan.dt_s:g}", "--seed", str(plan.seed), "--duration", repr(ticks * plan.dt_s)]
    options += ["--file", plan.stage_file] if plan.stage_file else []
    for t_s, values in plan.stage(changing=changing).changes:
        options += ["--change", f"{t_s!r}:" + ",".join(f"{name}={value!r}" for name, value in values.items())]
    return options


def _follow(controller: Child, server: Child, plan: Plan, progress: Progress) -> None:
    """Report the controller's progress until it ends. Raises ServiceError if it or the service fails."""
    until = time.monotonic() + plan.ticks * plan.dt_s + READY_S + _OVERTIME_S
    read = 0
    while controller.running and time.monotonic() < until:
        if not server.running and controller.running:
            raise ServiceError(f"{server.name} ended before its time: {server.output_tail()}")
        for line in controller.lines[read:]:
            read += 1
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


def _collect(result: Path, server: Child, stage: Child, loop: Child) -> DemoRun:
    with np.load(result) as kept:
        y_um, u_V, std_V = ({name: kept[f"{kind}/{name}"] for name in MODELS} for kind in ("y_um", "u_V", "std_V"))
        query_s, late = kept["query_s"], int(kept["late"])
    result.unlink()
    summary = stage.last_json()
    units = summary["units"]
    served = server.last_json()["axes"][AXIS]["samples"]
    samples = {"sent": units[AXIS]["published"], "received": served["received"], "learnt": served["learnt"]}
    ticks = {
        "count": summary["tick"],
        "late": max(unit["commands"]["missing"] for unit in units.values()),
        "stage_late": summary["late"],
        "bare_late": loop.last_json()["late"],
    }
    return DemoRun(y_um, u_V, std_V, query_s=query_s, late_queries=late, samples=samples, ticks=ticks)
