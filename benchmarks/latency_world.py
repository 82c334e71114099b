"""What a latency benchmark measures in: a service that learns, a stage that sends, a bare echo, each a process."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from adaptive.types import FloatArray
from benchmarks.latency_processes import AXIS, STAGE
from lab.testbed.processes import Child, Children, free_port
from service.identification.identifying import identify_one
from service.storage.model_file import BundleMeta, write_bundle
from sim.signals.signals import training_input
from sim.signals.unseen_reference import demo_reference
from sim.stage.presets import preset
from sim.stage.stage import Stage

LOW_UM, HIGH_UM = 4.0, 80.0
WINDOW = 500
READY_S = 90.0


@dataclass(frozen=True, slots=True)
class Prepared:
    """Files in ``folder``, and where the service will be reached.

    Attributes
    ----------
    config : of the service; samples : what the stage sends over and over, ``rate_hz`` of them a second and ``batch`` a
    message. motion : (n,) of each, a reference in µm, µm/s and µm/s² to ask for.
    """

    serve_at: str
    config: Path
    samples: Path
    rate_hz: float
    batch: int
    motion: tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class World(Prepared):
    """The processes too: ``service``, ``feed`` (the stage), and a bare echo at the endpoint ``echo_at``."""

    service: Child
    feed: Child
    echo_at: str


def prepare(folder: Path, rate_hz: float, batch: int, every_sample: bool, keeps: str = "") -> Prepared:
    """Identify models and write the files; the model that learns has a window of ``WINDOW``.

    ``keeps``: further lines of the axis' configuration.
    """
    dt_s = 1.0 / rate_hz
    stage = Stage(replace(preset("rich", seed=3), dt_s=dt_s))
    u_V = training_input(dt_s, 10.0)[1]
    y_um, _ = stage.run(stage.initial_state(), u_V)
    # Beyond 1 kHz the identification sees every sample too: some tens of thousands, of which it picks its support.
    names = ("linear", "lssvm_adaptive")
    models = {name: identify_one(name, u_V, y_um, dt_s, WINDOW) for name in names}
    meta = BundleMeta(STAGE, AXIS, dt_s, y_min_um=float(y_um.min()), y_max_um=float(y_um.max()))
    motion = demo_reference(30.0, dt_s, (LOW_UM, HIGH_UM), 7)
    config, samples = folder / "serve.toml", folder / "samples.npz"
    write_bundle(folder / "model.npz", models, meta)
    # The samples of a stage that is driven by what the linear model makes of the reference.
    line = models["linear"]
    drive = line.feedforward(motion.y_um, motion.v_um_per_s, motion.a_um_per_s2, line.rest_memory(0.0)).u_V.clip(
        -2.0, 10.0
    )
    read_um, _ = stage.run(stage.initial_state(), drive)
    np.savez(samples, u_V=drive, y_um=read_um)
    serve_at = f"tcp/127.0.0.1:{free_port()}"
    text = (
        f'stage = "{STAGE}"\nlisten = ["{serve_at}"]\n[[axis]]\nname = "{AXIS}"\nmodel = "model.npz"\n'
        f"u_min_V = -2.0\nu_max_V = 10.0\nslew_V_per_s = 40000.0\n{keeps}[axis.learner]\n"
        f"window = {WINDOW}\n" + ("learn_every = 1\nfilter_every = 1\n" if every_sample else "")
    )
    config.write_text(text, encoding="utf-8")
    columns = (motion.y_um, motion.v_um_per_s, motion.a_um_per_s2)
    return Prepared(serve_at, config, samples, rate_hz, batch, columns)


def start_service(children: Children, files: Prepared) -> Child:
    """Start it, and return it once it is ready. Raises ServiceError where it does not come up."""
    service = children.start("serve", ["-m", "lab.cli", "serve", "--config", str(files.config), "--json"])
    service.wait_line("{", READY_S)
    return service


def start_feed(children: Children, files: Prepared, first: int = 0) -> Child:
    """Start the stage, whose samples count from ``first`` on, a multiple of the batch; return it once it is heard."""
    order = [files.serve_at, str(files.samples), str(files.rate_hz), str(files.batch), str(first // files.batch)]
    feed = children.start("feed", ["-m", "benchmarks.latency_processes", "feed", *order])
    feed.wait_line("ready", READY_S)
    return feed


@contextmanager
def world(rate_hz: float, batch: int, every_sample: bool) -> Iterator[World]:
    """Make it, and end it; the stage sends already."""
    with tempfile.TemporaryDirectory() as folder, Children(Path(folder)) as children:
        files = prepare(Path(folder), rate_hz, batch, every_sample)
        echo_at = f"tcp/127.0.0.1:{free_port()}"
        service = start_service(children, files)
        children.start("echo", ["-m", "benchmarks.latency_processes", "echo", echo_at]).wait_line("ready", READY_S)
        feed = start_feed(children, files)
        parts = {field.name: getattr(files, field.name) for field in fields(files)}
        yield World(**parts, service=service, feed=feed, echo_at=echo_at)
