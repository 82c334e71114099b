"""What a latency benchmark measures in: a service that learns, a stage that sends, a bare echo, each a process."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from benchmarks.latency_processes import AXIS, STAGE
from service.demo.processes import Child, Children, free_port
from service.identifying import identify_one
from service.modelfile import BundleMeta, write_bundle
from sim.presets import preset
from sim.reference import demo_reference
from sim.signals import training_input
from sim.stage import Stage

LOW_UM, HIGH_UM = 4.0, 80.0
WINDOW = 500
READY_S = 90.0


@dataclass(frozen=True, slots=True)
class World:
    """The processes, and where they are reached.

    Attributes
    ----------
    service, feed : processes. echo_at, serve_at : endpoints. config : of the service; samples : what the stage sends
    over and over, ``rate_hz`` of them a second and ``batch`` a message. motion : (n,) of each, a reference in µm, µm/s
    and µm/s² to ask for.
    """

    service: Child
    feed: Child
    echo_at: str
    serve_at: str
    config: Path
    samples: Path
    rate_hz: float
    batch: int
    motion: tuple[FloatArray, FloatArray, FloatArray]


@contextmanager
def world(rate_hz: float, batch: int, every_sample: bool) -> Iterator[World]:
    """Make it, and end it; the stage sends already, the model has a window of ``WINDOW``."""
    dt_s = 1.0 / rate_hz
    stage = Stage(replace(preset("rich", seed=3), dt_s=dt_s))
    u_V = training_input(dt_s, 10.0)[1]
    y_um, _ = stage.run(stage.initial_state(), u_V)
    # Beyond 1 kHz the identification sees every sample too: some tens of thousands, of which it picks its support.
    names = ("linear", "lssvm_adaptive")
    models = {name: identify_one(name, u_V, y_um, dt_s, WINDOW) for name in names}
    meta = BundleMeta(STAGE, AXIS, dt_s, y_min_um=float(y_um.min()), y_max_um=float(y_um.max()))
    motion = demo_reference(30.0, dt_s, (LOW_UM, HIGH_UM), 7)
    with tempfile.TemporaryDirectory() as folder, Children(Path(folder)) as children:
        path = Path(folder)
        config, samples = path / "serve.toml", path / "samples.npz"
        write_bundle(path / "model.npz", models, meta)
        # The samples of a stage that is driven by what the linear model makes of the reference.
        line = models["linear"]
        drive = line.feedforward(motion.y_um, motion.v_um_per_s, motion.a_um_per_s2, line.rest_memory(0.0)).u_V.clip(
            -2.0, 10.0
        )
        read_um, _ = stage.run(stage.initial_state(), drive)
        np.savez(samples, u_V=drive, y_um=read_um)
        serve_at, echo_at = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        text = (
            f'stage = "{STAGE}"\nlisten = ["{serve_at}"]\n[[axis]]\nname = "{AXIS}"\nmodel = "model.npz"\n'
            "u_min_V = -2.0\nu_max_V = 10.0\nslew_V_per_s = 40000.0\n[axis.learner]\n"
            f"window = {WINDOW}\n" + ("learn_every = 1\nfilter_every = 1\n" if every_sample else "")
        )
        config.write_text(text, encoding="utf-8")
        service = children.start("serve", ["-m", "service.cli", "serve", "--config", str(config), "--json"])
        service.wait_line("{", READY_S)
        processes = "benchmarks.latency_processes"
        children.start("echo", ["-m", processes, "echo", echo_at]).wait_line("ready", READY_S)
        feed = children.start("feed", ["-m", processes, "feed", serve_at, str(samples), str(rate_hz), str(batch)])
        feed.wait_line("ready", READY_S)
        columns = (motion.y_um, motion.v_um_per_s, motion.a_um_per_s2)
        yield World(service, feed, echo_at, serve_at, config, samples, rate_hz, batch, columns)
