"""One piece of re-tuning in a process of its own, and a window's samples as the arrays that travel there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from adaptive.types import FloatArray, Hyperparameters, WindowData
from service.background.job import BackgroundJob


def pack(name: str, data: WindowData) -> dict[str, FloatArray]:
    """A window's data as arrays under ``NAME.``."""
    hyper = np.array([data.hyper.gamma, *data.hyper.widths])
    parts = {"kernel": data.kernel, "targets_V": data.targets_V, "weights": data.weights, "age": data.age}
    return {f"{name}.{key}": value for key, value in {**parts, "hyper": hyper}.items()}


def unpack(name: str, arrays: Mapping[str, FloatArray]) -> WindowData:
    """Inverse of :func:`pack`."""
    hyper = arrays[f"{name}.hyper"]
    kernel, targets_V, weights, age = (arrays[f"{name}.{key}"] for key in ("kernel", "targets_V", "weights", "age"))
    return WindowData(kernel, targets_V, weights, age, Hyperparameters(float(hyper[0]), tuple(map(float, hyper[1:]))))


class Job(BackgroundJob):
    """Runs ``service.background.retuning.worker`` on ``order`` and ``arrays``, from now on."""

    def __init__(self, order: dict[str, Any], arrays: dict[str, FloatArray], timeout_s: float) -> None:
        super().__init__("service.background.retuning.worker", order, arrays, timeout_s)
        self.start()
