"""What several tests of the service need: small honest models, a free port, and a real serving process."""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import InverseModel
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearParameters
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.service.living import Process

DT_S = 1e-3
GAIN_UM_PER_V, OFFSET_UM = 11.0, 1.0


class Clock:
    """Stands in for the module `time` of a loop: time passes in sleeps alone, whatever the load of the machine."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


def make_models(dt_s: float = DT_S) -> dict[str, InverseModel]:
    """A line, and an LSSVM with plays whose kernel part is small: both good enough to steer a stage of 11 µm/V."""
    features = FeatureMap(
        dt_s, 0.0, 90.0, 1e3, 1e5, thresholds_um=(1.0, 5.0), arc_lengths_um=(3.0,), time_constants_s=(0.1,),
        kernel_plays=(0,), asymmetric=True,
    )  # fmt: skip
    rng = np.random.default_rng(5)
    support = rng.uniform(-1.0, 1.0, (20, features.kernel_size))
    half_V = 45.0 / GAIN_UM_PER_V
    beta = np.zeros(features.basis_size)
    beta[:2] = (45.0 - OFFSET_UM) / GAIN_UM_PER_V, half_V
    beta[2:] = 1e-3 * np.arange(1, beta.size - 1)
    lssvm = LssvmInverse(
        "lssvm_adaptive", features, beta, support, 0.01 * rng.normal(size=20), np.ones(features.kernel_size), 1e4,
        domain=np.array([0.0, 90.0, -2e4, 2e4, -1e7, 1e7]), noise_variance=1e-6, kernel_variance=1e-4,
    )  # fmt: skip
    line = LinearInverse(LinearParameters(GAIN_UM_PER_V, OFFSET_UM), dt_s, Domain(0.0, 90.0, 1e4), 0.05)
    return {"linear": line, "lssvm_adaptive": lssvm}


@pytest.fixture
def models() -> dict[str, InverseModel]:
    return make_models()


def unused_port() -> int:
    """A port that nobody listens at; zenoh wants to be told one."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def free_port() -> int:
    return unused_port()


def write_config(folder: Path, port: int, axes: tuple[str, ...] = ("x",), extra: str = "") -> Path:
    """Model files and a configuration of a service in ``folder``; ``{axis}`` in ``extra`` is the axis' name."""
    text = f'stage = "demo"\nlisten = ["tcp/127.0.0.1:{port}"]\n'
    for axis in axes:
        write_bundle(folder / f"{axis}.npz", make_models(), BundleMeta("demo", axis, DT_S, y_min_um=0.0, y_max_um=90.0))
        text += (
            f'[[axis]]\nname = "{axis}"\nmodel = "{axis}.npz"\nu_min_V = 0.0\nu_max_V = 10.0\nslew_V_per_s = 2000.0\n'
        )
        text += extra.replace("{axis}", axis) + "\n"
    path = folder / "serve.toml"
    path.write_text(text, encoding="utf-8")
    return path


class ServeProcess(Process):
    """``dehyst serve`` as a process, ready when constructed."""

    def __init__(self, config: Path, port: int) -> None:
        self.endpoint = f"tcp/127.0.0.1:{port}"
        super().__init__("serve", "--config", str(config))

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, dict[str, Any], str]:
        """(exit status, last line of its output, what it complained of)."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, json.loads(out.splitlines()[-1]), err


@pytest.fixture(scope="module")
def shared_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServeProcess]:
    """One serving process with the axes x and y, for all the tests of a file that only query it and send samples."""
    port = unused_port()
    process = ServeProcess(write_config(tmp_path_factory.mktemp("service"), port, ("x", "y")), port)
    yield process
    process.kill()


@pytest.fixture
def serve(tmp_path: Path, free_port: int) -> Iterator[Callable[..., ServeProcess]]:
    """Starts serving processes; all are ended at the end of the test."""
    started: list[ServeProcess] = []

    def start(axes: tuple[str, ...] = ("x",), extra: str = "") -> ServeProcess:
        process = ServeProcess(write_config(tmp_path, free_port, axes, extra), free_port)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
