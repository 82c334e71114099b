"""Everything that a soak runs, as processes on loopback: how they are started, ended and started again."""

from __future__ import annotations

import json
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from lab.soak.processes.clocked import write_offset
from lab.soak.processes.control import AXIS, SERVED, STAGE, Control
from lab.soak.processes.setup import write_service, write_stage
from lab.testbed.processes import Child, Children, free_port
from service.protocol.errors import ServiceError
from sim.stage.config import StageConfig

CLI = ["-m", "lab.cli"]
#: As a converter's driver hands them over.
SAMPLES_A_MESSAGE = 5
READY, READY_S = "ready", 60.0
#: Each life of the stage counts from a number of its own, below the one before: every sample has a number that no
#: other has, and each restart is one that a service must notice.
LIVES, LIFE = 1000, 1_000_000_000
SERVICES = ("a", "b")


class World:
    """The processes by name: router, a and b (the services), stage, controller, prober, echo, viewer,
    and a bare loop that measures how late the machine is.

    Parameters
    ----------
    out : folder of the run; logs, configurations and recordings go below it.
    stage : the simulated stage. control : what the controller does. model : file of the identified models.
    standby : whether the second service is a hot standby of the first; without one there is only the first.
    """

    def __init__(self, out: Path, stage: StageConfig, control: Control, model: Path, standby: bool = True) -> None:
        self.out = out
        self.control = control
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.logs = out / "logs"
        self.clock = out / "logs" / "clock.bin"
        self.services = SERVICES if standby else SERVICES[:1]
        self.children: dict[str, Child] = {}
        self._held = Children(self.logs)
        self._stage = stage
        self._life = 0
        self._starts: dict[str, int] = {}
        self._control_file = self.logs / "control.json"
        control.write(self._control_file)
        write_offset(self.clock, 0.0)
        for name in self.services:
            write_service(self.logs / f"{name}.toml", control, model, self.endpoint, out / name)

    def __enter__(self) -> World:
        return self

    def __exit__(self, *exc: Any) -> None:
        self._held.__exit__(None, None, None)

    def start(self) -> None:
        """Start all of them. Raises ServiceError where one does not get ready."""
        self.start_router()
        # All at once, then wait for each: most of a start is imports.
        for i, name in enumerate(self.services):
            self.start_service(name, standby=i > 0, wait=False)
        self.start_one("echo", ["-m", "lab.soak.processes.extras", "echo", self.endpoint], wait=False)
        self.start_one("bare", ["-m", "lab.soak.processes.bare"], wait=False)
        self.start_viewer(wait=False)
        self.start_stage(wait=False)
        for name, begins in (
            *((name, "{") for name in self.services),
            ("echo", READY),
            ("bare", READY),
            ("viewer", "viewing"),
        ):
            self.children[name].wait_line(begins, READY_S)
        for name in ("controller", "prober"):
            self.start_one(name, ["-m", f"lab.soak.{name}", str(self._control_file), self.endpoint], wait=False)
        for name in ("stage", "controller", "prober"):
            self.children[name].wait_line(READY, READY_S)

    def start_one(self, name: str, arguments: list[str], ready: str = READY, wait: bool = True) -> Child:
        """Start a process under ``name``, and wait for its ready line."""
        self._starts[name] = self._starts.get(name, 0) + 1
        child = self._held.start(f"{name}-{self._starts[name]}", arguments)
        self.children[name] = child
        if wait:
            child.wait_line(ready, READY_S)
        return child

    def start_router(self, wait: bool = True) -> None:
        """The router that all others connect to."""
        self.start_one("router", [*CLI, "router", "--listen", self.endpoint], wait=wait)

    def start_service(self, name: str, *, standby: bool, wait: bool = True) -> None:
        """A serving process, its wall clock at hand."""
        arguments = [
            "-m",
            "lab.soak.processes.clocked",
            str(self.clock),
            "serve",
            "--config",
            str(self.logs / f"{name}.toml"),
        ]
        self.start_one(name, [*arguments, "--json", *(["--standby"] if standby else [])], "{", wait)

    def start_viewer(self, wait: bool = True) -> None:
        """The viewer's stream into a file, which begins anew with each start."""
        where = ["--endpoint", self.endpoint, "--stage", STAGE, "--axis", AXIS, "--model", SERVED]
        rrd = ["--rrd", str(self.out / "soak.rrd"), "--range-um", str(self.control.range_um), "--json"]
        self.start_one("viewer", [*CLI, "view", *where, *rrd], "viewing", wait)

    def start_stage(self, wait: bool = True) -> None:
        """The stage in its next life: rested, its noise another one, its numbers below those of the life before."""
        config = replace(self._stage, seed=self._stage.seed + self._life)
        path = self.logs / "stage.toml.json"
        write_stage(config, path)
        first = (LIVES - self._life) * LIFE
        self._life += 1
        where = ["--endpoint", self.endpoint, "--name", STAGE, "--axis", AXIS, "--batch", str(SAMPLES_A_MESSAGE)]
        arguments = [*CLI, "stage", "--file", str(path), *where, "--inject", "--first", str(first)]
        arguments += ["--slew", repr(self.control.slew_V_per_s)]
        self.start_one("stage", arguments, wait=wait)

    def by_pid(self, instance: str) -> str:
        """The name of the service whose instance this is; the process's number is part of it. "" where it is none."""
        for name in self.services:
            if instance.startswith(f"i{self.children[name].pid}-"):
                return name
        return ""

    def stop(self) -> dict[str, Any]:
        """End all in order: first what asks, then the stage, then, once it has settled, what serves. Last words."""
        said: dict[str, Any] = {}
        for names in (
            ("prober", "controller"),
            ("stage",),
            ("viewer", "echo", "bare", *reversed(self.services)),
            ("router",),
        ):
            for name in names:
                self.children[name].send(signal.SIGINT)
            said |= {name: self._stop_one(name) for name in names}
            if names == ("stage",):
                # The last samples are handled before whoever handles them is ended.
                time.sleep(1.0)
        return said

    def _stop_one(self, name: str) -> dict[str, Any] | None:
        child = self.children.get(name)
        if child is None:
            return None
        child.stop(30.0)
        try:
            return child.last_json()
        except (ServiceError, json.JSONDecodeError):
            return None
