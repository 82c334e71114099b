"""What a service needs before it starts: models identified on a simulated stage, and a configuration file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.lab.testbed.processes import Child, Children, free_port
from dehyst.service.identification.identifying import identify_one
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage

#: Length of the identification signal, s, and size of the window of the models with one.
IDENTIFY_S: Final = 10.0
WINDOW: Final = 500


@dataclass(frozen=True, slots=True)
class IdentifiedStage:
    """Models by name, and the (n,) voltages, V, and readings, µm, that they were identified from."""

    models: dict[str, InverseModel]
    u_V: FloatArray
    y_um: FloatArray

    @property
    def low_um(self) -> float:
        """Lowest reading, µm."""
        return float(self.y_um.min())

    @property
    def high_um(self) -> float:
        """Highest reading, µm."""
        return float(self.y_um.max())


def identify_stage(
    config: StageConfig, file: Path, stage: str, axis: str, names: Sequence[str], required: str,
    progress: Callable[[str], None] = lambda _: None,
) -> IdentifiedStage:  # fmt: skip
    """Drive the stage with the chapter's training signal (2.37) and write the models ``names`` to ``file``.

    Other models than ``required`` are left out if they do not fit the stage. ``progress`` : called with each name.
    Raises InputError if ``required`` does not fit.
    """
    u_V = training_input(config.dt_s, IDENTIFY_S)[1].clip(config.u_min_V, config.u_max_V)
    simulated = Stage(config)
    y_um, _ = simulated.run(simulated.initial_state(), u_V)
    models: dict[str, InverseModel] = {}
    for name in names:
        progress(name)
        try:
            models[name] = identify_one(name, u_V, y_um, config.dt_s, WINDOW)
        except (InputError, NumericsError) as error:
            if name == required:
                raise InputError(f"stage {config.name!r}: cannot be identified: {error}") from error
    found = IdentifiedStage(models, u_V, y_um)
    meta = BundleMeta(
        stage, axis, config.dt_s, config.name, y_min_um=found.low_um, y_max_um=found.high_um,
        u_min_V=float(u_V.min()), u_max_V=float(u_V.max()),
    )  # fmt: skip
    write_bundle(file, models, meta)
    return found


def write_service_config(
    path: Path, stage: str, axis: Mapping[str, Any], *, listen: Sequence[str] = (), connect: Sequence[str] = ()
) -> None:
    """Write the configuration of a service with one axis. A value of ``axis`` that is a mapping becomes a table."""
    lines = [f"stage = {_toml(stage)}", f"listen = {_toml(listen)}"]
    if connect:
        lines.append(f"connect = {_toml(connect)}")
    lines += ["", "[[axis]]", *(f"{k} = {_toml(v)}" for k, v in axis.items() if not isinstance(v, Mapping))]
    for name, values in axis.items():
        if isinstance(values, Mapping):
            lines += [f"[axis.{name}]", *(f"{k} = {_toml(v)}" for k, v in values.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    if isinstance(value, Path):
        return json.dumps(str(value.resolve()))
    return json.dumps(list(value) if isinstance(value, tuple) else value)


# --- The processes of an experiment by name: they meet at one endpoint on loopback and end with the experiment.

#: The command line interface as a module.
_CLI: Final = ("-m", "dehyst.lab.cli")
#: What a process prints when it is ready, and how long that may take, s.
READY: Final = "ready"
READY_S: Final = 60.0
#: Samples in a message of a stage, as the driver of a converter delivers them.
SAMPLES_PER_MESSAGE: Final = 5


class Rig(Children):
    """Processes on loopback; use as a context manager.

    Attributes
    ----------
    endpoint : where the first process (router or service) listens and the others connect.
    children : by name, the newest process of that name.
    """

    def __init__(self, logs: Path) -> None:
        super().__init__(logs)
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.children: dict[str, Child] = {}
        self._ready: dict[str, str] = {}
        self._starts: dict[str, int] = {}

    def start(self, name: str, arguments: list[str], *, ready: str = READY, wait: bool = True) -> Child:
        """Start ``python ARGUMENTS`` under ``name``; with ``wait`` return when it has printed ``ready``.

        Raises ServiceError if it does not get ready within ``READY_S``.
        """
        self._starts[name] = self._starts.get(name, 0) + 1
        child = super().start(f"{name}-{self._starts[name]}", arguments)
        self.children[name], self._ready[name] = child, ready
        if wait:
            self.wait_ready(name)
        return child

    def wait_ready(self, *names: str) -> None:
        """Wait until the processes of these names are ready. Raises ServiceError."""
        for name in names:
            self.children[name].wait_line(self._ready[name], READY_S)

    def start_router(self, *, wait: bool = True) -> Child:
        """The router to which all others connect."""
        return self.start("router", [*_CLI, "router", "--listen", self.endpoint], wait=wait)

    def start_service(
        self, config: Path, *options: str, name: str = "serve", wall_clock: Path | None = None, wait: bool = True
    ) -> Child:
        """A service. ``wall_clock``: the file that shifts its wall clock, see `lab.testbed.shifted_clock`."""
        program = _CLI if wall_clock is None else ("-m", "dehyst.lab.testbed.shifted_clock", str(wall_clock))
        return self.start(name, [*program, "serve", "--config", str(config), "--json", *options], ready="{", wait=wait)

    def start_stage(self, stage: str, axis: str, *options: str, name: str = "stage", wait: bool = True) -> Child:
        """A simulated stage of that name and axis; ``options`` say how it is reached."""
        named = ["--name", stage, "--axis", axis, "--batch", str(SAMPLES_PER_MESSAGE)]
        return self.start(name, [*_CLI, "stage", *named, *options], wait=wait)

    def start_viewer(
        self, rrd: Path, stage: str, axis: str, range_um: float, *options: str, name: str = "view", wait: bool = True
    ) -> Child:
        """The viewer's stream into the file ``rrd``, which each start overwrites."""
        shown = ["--stage", stage, "--axis", axis, "--range-um", str(range_um), "--rrd", str(rrd), "--json", *options]
        return self.start(name, [*_CLI, "view", "--endpoint", self.endpoint, *shown], ready="viewing", wait=wait)

    def start_echo(self, endpoint: str = "", *, wait: bool = True) -> Child:
        """A bare echo: it listens at ``endpoint``, or connects to the rig's own endpoint."""
        how = ["listen", endpoint] if endpoint else ["connect", self.endpoint]
        return self.start("echo", ["-m", "dehyst.lab.testbed.processes", *how], wait=wait)
