"""What a latency benchmark runs: a service that learns, a stage that replays samples, and a bare echo as processes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.sample_feed import AXIS, STAGE
from dehyst.adaptive.types import FloatArray
from dehyst.lab.testbed.identified_stage import WINDOW, Rig, identify_stage, write_service_config
from dehyst.lab.testbed.processes import Child, free_port
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

#: Range of the reference, µm.
LOW_UM, HIGH_UM = 4.0, 80.0
#: How long to wait for a service, s.
CONNECT_S: Final = 90.0
#: Voltage limits of the simulated stage, V.
_DRIVE_V: Final = (-2.0, 10.0)


@dataclass(frozen=True, slots=True)
class LatencySetup:
    """Files of a benchmark, and the processes that use them.

    Attributes
    ----------
    rig : the processes; the service listens at ``rig.endpoint``.
    config : configuration of the service. samples : what the stage sends over and over.
    rate_hz, batch : samples a second and a message. motion : (n,) each, a reference in µm, µm/s and µm/s².
    """

    rig: Rig
    config: Path
    samples: Path
    rate_hz: float
    batch: int
    motion: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def endpoint(self) -> str:
        """Where the service listens."""
        return self.rig.endpoint

    def start_service(self) -> Child:
        """Start the service and return it when it is ready. Raises ServiceError if it does not start."""
        return self.rig.start_service(self.config)

    def start_feed(self, first: int = 0) -> Child:
        """Start the stage and return it when the service receives it. Its sample numbers begin at ``first``, a multiple
        of the batch."""
        order = [self.endpoint, str(self.samples), str(self.rate_hz), str(self.batch), str(first // self.batch)]
        return self.rig.start("feed", ["-m", "benchmarks.sample_feed", *order])


def prepare(
    rig: Rig, folder: Path, rate_hz: float, batch: int, every_sample: bool, axis: Mapping[str, Any] | None = None
) -> LatencySetup:
    """Identify models and write the files. ``axis``: further settings of the axis' configuration."""
    dt_s = 1.0 / rate_hz
    stage_config = replace(preset("rich", seed=3), dt_s=dt_s)
    model = folder / "model.npz"
    found = identify_stage(stage_config, model, STAGE, AXIS, ("linear", "lssvm_adaptive"), "lssvm_adaptive")
    motion = demo_reference(30.0, dt_s, (LOW_UM, HIGH_UM), 7)
    columns = (motion.y_um, motion.v_um_per_s, motion.a_um_per_s2)
    # The samples of a stage that the linear model drives along the reference.
    linear = found.models["linear"]
    drive = linear.feedforward(*columns, linear.rest_memory(0.0)).u_V.clip(*_DRIVE_V)
    stage = Stage(stage_config)
    y_um, _ = stage.run(stage.initial_state(), drive)
    samples, config = folder / "samples.npz", folder / "serve.toml"
    np.savez(samples, u_V=drive, y_um=y_um)
    learner = {"window": WINDOW} | ({"learn_every": 1, "filter_every": 1} if every_sample else {})
    limits = {"u_min_V": -2.0, "u_max_V": 10.0, "slew_V_per_s": 40000.0}
    settings = {"name": AXIS, "model": model, **limits, **(axis or {}), "learner": learner}
    write_service_config(config, STAGE, settings, listen=[rig.endpoint])
    return LatencySetup(rig, config, samples, rate_hz, batch, columns)


@dataclass(frozen=True, slots=True)
class RunningSetup:
    """A setup whose processes run: ``service``, ``feed`` (the stage), and a bare echo that listens at ``echo_at``."""

    setup: LatencySetup
    service: Child
    feed: Child
    echo_at: str


@contextmanager
def running_setup(rate_hz: float, batch: int, every_sample: bool) -> Iterator[RunningSetup]:
    """Start the processes, and stop them at the end of the block. The stage already sends."""
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        setup = prepare(rig, Path(folder), rate_hz, batch, every_sample)
        echo_at = f"tcp/127.0.0.1:{free_port()}"
        service = setup.start_service()
        rig.start_echo(echo_at)
        yield RunningSetup(setup, service, setup.start_feed(), echo_at)
