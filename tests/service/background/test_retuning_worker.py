"""What the re-tuning costs those who answer: its process has the lowest priority, the learner only copies."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.tuning import retuning as retune
from dehyst.adaptive.tuning.config import RetuneConfig
from dehyst.adaptive.types import FloatArray, Hyperparameters, WindowData
from dehyst.service.answers.guard import Limits
from dehyst.service.background.retuner import Retuner
from dehyst.service.background.retuning_worker import pack, start_job
from dehyst.service.background.settings import RetuningConfig
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.sim.signals.voltages import multitone, training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.service.living import eventually

DT_S, BLOCK = 1e-3, 20
NARROW = Hyperparameters(1e5, (0.12, 0.12))


def window_data(n: int, seed: int = 1) -> WindowData:
    """A smooth target of two inputs, V, with kernels far too narrow for it."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.0, 1.0, (n, 2))
    target_V = 0.1 * np.sin(3.0 * X[:, 0]) + 0.05 * np.tanh(4.0 * X[:, 1]) + 0.7 + 0.004 * rng.normal(size=n)
    return WindowData(X, target_V, np.arange(n, 0, -1.0) - 1.0, NARROW)


def order(search: RetuneConfig) -> dict[str, Any]:
    return {"kind": "propose", "search": asdict(search)}


# ---- the process


def test_the_working_process_has_the_lowest_priority_and_one_thread() -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    job = start_job(order(RetuneConfig(starts=8, rows=300)), pack("before", window_data(300)), 120.0)
    try:
        process = psutil.Process(eventually(lambda: job._process).pid)
        eventually(lambda: process.nice() == 19)
        environment = process.environ()
        # Elsewhere than on Linux, or where it does not share by sessions, there is nothing to tell.
        group = Path(f"/proc/{process.pid}/autogroup")
        session = group.read_text().strip() if group.exists() else ""
        eventually(lambda: not session or group.read_text().strip().endswith("nice 19"))
    finally:
        job.cancel()
    assert os.getpriority(os.PRIO_PROCESS, 0) == own < 19
    for library in ("OPENBLAS", "OMP", "MKL", "NUMBA"):
        assert environment[f"{library}_NUM_THREADS"] == "1"


# ---- the thread that learns


@pytest.fixture(scope="module")
def recorded() -> tuple[FloatArray, FloatArray, int]:
    """(u_V, y_um, number of samples to identify by) on the rich stage at 1 kHz: training signal, then tones."""
    stage = Stage(preset("rich", seed=4))
    tones = multitone(6.0, DT_S, seed=4)[1]
    tones[:500] *= np.linspace(0.0, 1.0, 500)
    u_V = np.concatenate([training_input(DT_S, 6.0)[1], tones])
    return u_V, np.asarray(stage.run(stage.initial_state(), u_V)[0]), 6000


@pytest.fixture(scope="module")
def axis(recorded: tuple[FloatArray, FloatArray, int]) -> Axis:
    """An axis with a full window of 500 and nothing beside the learner, which is the cheapest there is."""
    u_V, y_um, n = recorded
    model = identify_lssvm(u_V[:n], y_um[:n], DT_S, config=IdentifyConfig(tune=False, n=500))[0]
    config = AxisConfig("x", Path("x.npz"), Limits(-2.0, 10.0, 4000.0), compete=())
    return load_axis("demo", config, bundle=Bundle({"lssvm_adaptive": model}, BundleMeta("demo", "x", DT_S)))


class Working:
    """Stands in for a job: the first proposes at once, the trial is never done."""

    made = 0

    def __init__(self, given: dict[str, Any], arrays: dict[str, FloatArray], timeout_s: float) -> None:
        Working.made += 1
        self.result = {"changed": True, "gamma": 50.0, "widths": [2.0] * 5} if given["kind"] == "propose" else None

    def cancel(self) -> None: ...


@pytest.fixture
def retuner(monkeypatch: pytest.MonkeyPatch) -> Iterator[Retuner]:
    Working.made = 0
    monkeypatch.setattr("dehyst.service.background.retuner.start_job", Working)
    made = Retuner(RetuningConfig(period_s=0.0, fresh=100))
    yield made
    made.close()


def test_the_thread_that_learns_only_copies(
    axis: Axis, recorded: tuple[FloatArray, FloatArray, int], retuner: Retuner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """200 steps from the proposal through the wait for fresh samples into the trial: a few copies of the window."""

    def forbidden(*_: Any, **__: Any) -> Any:
        raise AssertionError("computed in the thread that learns")

    for name in ("propose", "compare"):
        monkeypatch.setattr(retune, name, forbidden)
    learner: Any = axis.learner
    copy, copies = learner.window_data, []

    def counted() -> WindowData:
        copies.append(learner.seq)
        data: WindowData = copy()
        return data

    monkeypatch.setattr(learner, "window_data", counted)
    u_V, y_um, n = recorded
    states = []
    for block in range(250):
        k = np.arange(block * BLOCK, (block + 1) * BLOCK)
        axis.handle(SampleBatch(k, k * DT_S, u_V[n + k], y_um[n + k]))
        if block == 50:
            retuner.request({})
        if block >= 50:
            retuner.step(axis)
            states.append(retuner.status()["state"])
    # All of its states were gone through: what follows is no measurement of doing nothing.
    assert list(dict.fromkeys(states)) == ["waiting for fresh samples", "trying"]
    assert retuner.status()["proposed"] == 1
    assert (Working.made, retuner.status()["started"]) == (2, 1)
    # The window is looked at every quarter of a second of samples at most, and not at all while others work.
    waited = states.count("waiting for fresh samples") * BLOCK
    assert 2 <= len(copies) <= 2 + waited // 250
    assert min(np.diff(copies)) >= 250
    assert copies[-1] == 1000 + (states.index("trying") + 1) * BLOCK - 1
