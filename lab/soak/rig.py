"""The processes of a soak: an identified stage, two services, controller and measuring clients, and their restarts."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

from dehyst.lab.soak.controller import AXIS, SERVED, STAGE, ControlTask
from dehyst.lab.testbed.identified_stage import Rig, identify_stage, write_service_config
from dehyst.lab.testbed.processes import Child
from dehyst.lab.testbed.shifted_clock import write_offset
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.file import save_stage

#: Models of the service: the baseline that fits any stage, the fallback, and the model that is served.
MODELS: Final = ("linear", "mpi", SERVED)
#: Margins of the reference to the ends of the identified range, as shares of it.
LOW_SHARE, HIGH_SHARE = 0.05, 0.10
#: Slew limit: share of the voltage range in a millisecond.
SLEW_SHARE_PER_MS: Final = 1.0 / 3.0
#: Each restart of the stage numbers its samples from a value of its own, below that of the start before: every sample
#: number is unique, and the service must notice each restart.
_STARTS, _NUMBERS_PER_START = 1000, 1_000_000_000
SERVICES: Final = ("a", "b")
#: Between the last sample and the end of the services, so that they handle what is under way, s.
_DRAIN_S: Final = 1.0


def identify(config: StageConfig, path: Path, seed: int) -> ControlTask:
    """Identify the stage, write the models to ``path``, and return a task within the range that was found.

    Raises InputError if the stage cannot be identified.
    """
    found = identify_stage(config, path, STAGE, AXIS, MODELS, SERVED)
    span = found.high_um - found.low_um
    return ControlTask(
        dt_s=config.dt_s,
        low_um=found.low_um + LOW_SHARE * span,
        high_um=found.high_um - HIGH_SHARE * span,
        seed=seed,
        u_min_V=config.u_min_V,
        u_max_V=config.u_max_V,
        slew_V_per_s=1000.0 * SLEW_SHARE_PER_MS * (config.u_max_V - config.u_min_V),
    )


class SoakRig:
    """The processes by name: router, a and b (the services), stage, controller, prober, viewer.

    Parameters
    ----------
    rig : starts the processes. out : folder of the run; configurations and recordings go below it.
    stage : the simulated stage. task : of the controller. model : file of the identified models.
    """

    def __init__(self, rig: Rig, out: Path, stage: StageConfig, task: ControlTask, model: Path) -> None:
        self.task = task
        self.rig = rig
        self.wall_clock = self.rig.logs / "clock.bin"
        self.model = model
        self._out, self._stage = out, stage
        self._stage_starts = 0
        self._task_file = self.rig.logs / "control.json"
        task.write(self._task_file)
        write_offset(self.wall_clock, 0.0)
        for name in SERVICES:
            axis = {
                "name": AXIS,
                "model": model,
                "u_min_V": task.u_min_V,
                "u_max_V": task.u_max_V,
                "slew_V_per_s": task.slew_V_per_s,
                "snapshot_every": task.block,
                "recorder": out / name / "recording",
                "checkpoints": out / name / "checkpoints",
            }
            write_service_config(self._service_file(name), STAGE, axis, connect=[self.rig.endpoint])

    @property
    def children(self) -> dict[str, Child]:
        """By name, the newest process of that name."""
        return self.rig.children

    def start(self) -> None:
        """Start all processes. Raises ServiceError if one does not get ready."""
        self.rig.start_router()
        # Start all, then wait for each: most of the time goes into imports.
        for name in SERVICES:
            self.start_service(name, standby=name != SERVICES[0])
        self.start_viewer()
        self.start_stage()
        self.rig.wait_ready(*SERVICES, "viewer")
        for name in ("controller", "prober"):
            program = ["-m", f"dehyst.lab.soak.{name}", str(self._task_file), self.rig.endpoint]
            self.rig.start(name, program, wait=False)
        self.rig.wait_ready("stage", "controller", "prober")

    def _service_file(self, name: str) -> Path:
        return self.rig.logs / f"{name}.toml"

    def start_service(self, name: str, *, standby: bool) -> None:
        """Start a service with a wall clock that can be shifted; do not wait for it."""
        options = ["--standby"] if standby else []
        self.rig.start_service(self._service_file(name), *options, name=name, wall_clock=self.wall_clock, wait=False)

    def start_viewer(self) -> None:
        """Start the viewer's stream into a file; do not wait for it."""
        options = ["--model", SERVED]
        self.rig.start_viewer(
            self._out / "soak.rrd", STAGE, AXIS, self.task.range_um, *options, name="viewer", wait=False
        )

    def start_stage(self) -> None:
        """Start the stage at rest, with new noise and new sample numbers; do not wait for it."""
        config = replace(self._stage, seed=self._stage.seed + self._stage_starts)
        path = self.rig.logs / "stage.toml.json"
        save_stage(config, path)
        first = (_STARTS - self._stage_starts) * _NUMBERS_PER_START
        self._stage_starts += 1
        options = ["--file", str(path), "--endpoint", self.rig.endpoint, "--inject", "--first", str(first)]
        self.rig.start_stage(STAGE, AXIS, *options, "--slew", repr(self.task.slew_V_per_s), wait=False)

    def start_disturber(self, name: str, what: str) -> Child:
        """Start a process of `lab.soak.disturbers` and wait until it is ready."""
        return self.rig.start(name, ["-m", "dehyst.lab.soak.disturbers", what, self.rig.endpoint])

    def service_of(self, instance: str) -> str:
        """Name of the service with this instance id, which contains its process id; "" if there is none."""
        for name in SERVICES:
            if instance.startswith(f"i{self.children[name].pid}-"):
                return name
        return ""

    def stop(self) -> None:
        """Stop clients first, then the stage, then, when the last samples are handled, the services and the router."""
        services = ("viewer", *reversed(SERVICES))
        for names in (("prober", "controller"), ("stage",), services, ("router",)):
            for name in names:
                self.children[name].send(signal.SIGINT)
            for name in names:
                self.children[name].stop(30.0)
            if names == ("stage",):
                time.sleep(_DRAIN_S)
