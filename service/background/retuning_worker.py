"""The process that tunes, ``python -m dehyst.service.background.retuning_worker FOLDER``, and how the service starts
it.

`start_job` and `pack` are the side of the service, `tuned` is the work of the process (see `service.background.job`).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from dehyst.adaptive.types import FloatArray, Hyperparameters, WindowData
from dehyst.service.background.job import BackgroundJob, run_worker


def start_job(order: dict[str, Any], arrays: dict[str, FloatArray], timeout_s: float) -> BackgroundJob:
    """Start the process with an ``order`` and the windows in ``arrays`` (see `tuned` and `pack`)."""
    job = BackgroundJob("dehyst.service.background.retuning_worker", order, arrays, timeout_s)
    job.start()
    return job


def pack(name: str, data: WindowData) -> dict[str, FloatArray]:
    """The samples of a window as arrays, which `unpack` finds under ``name``."""
    hyper = np.array([data.hyper.gamma, *data.hyper.widths])
    parts = {"kernel": data.kernel, "targets_V": data.targets_V, "age": data.age}
    return {f"{name}.{key}": value for key, value in {**parts, "hyper": hyper}.items()}


def unpack(name: str, arrays: Mapping[str, FloatArray]) -> WindowData:
    """Inverse of `pack`."""
    hyper = arrays[f"{name}.hyper"]
    kernel, targets_V, age = (arrays[f"{name}.{key}"] for key in ("kernel", "targets_V", "age"))
    return WindowData(kernel, targets_V, age, Hyperparameters(float(hyper[0]), tuple(map(float, hyper[1:]))))


def tuned(order: dict[str, Any], arrays: dict[str, FloatArray]) -> dict[str, Any]:
    """The result of one order.

    ``order`` is ``{"kind": "propose", "search": {...}}`` for the window ``before`` in the arrays, or ``{"kind":
    "compare", "search": {...}, "gamma", "widths"}`` for ``before`` and ``after``. Raises DehystError.
    """
    from dehyst.adaptive.tuning.config import RetuneConfig
    from dehyst.adaptive.tuning.retuning import compare, propose

    data = {name: unpack(name, arrays) for name in ("before", "after") if f"{name}.kernel" in arrays}
    ranges = {name: tuple(order["search"][name]) for name in ("gamma_range", "width_range")}
    config = RetuneConfig(**{**order["search"], **ranges})
    if order["kind"] == "compare":
        hyper = Hyperparameters(float(order["gamma"]), tuple(float(width) for width in order["widths"]))
        trial = compare(data["before"], data["after"], hyper, config)
        return asdict(trial)
    found = propose(data["before"], config)
    return {
        "gamma": found.hyper.gamma,
        "widths": list(found.hyper.widths),
        "changed": found.hyper != data["before"].hyper,
        "J2": found.J2,
        "J2_before": found.J2_before,
        "evaluations": found.evaluations,
    }


if __name__ == "__main__":
    sys.exit(run_worker(tuned))
