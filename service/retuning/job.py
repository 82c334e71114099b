"""One piece of background work in a process of its own: started, waited for with a limit, ended with the service."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.residual import Hyperparameters, WindowData
from adaptive.types import FloatArray

#: A process that may not start threads of its own: the cores belong to those who answer.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


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


class Job:
    """Runs the worker on ``order`` and ``arrays`` beside everything else. Never raises.

    The result is the worker's, or ``{"error": why}``, or ``{"error": why, "timeout": True}``; None until it is there.
    """

    def __init__(self, order: dict[str, Any], arrays: dict[str, FloatArray], timeout_s: float) -> None:
        self.result: dict[str, Any] | None = None
        self._order, self._arrays, self._timeout_s = order, arrays, timeout_s
        self._cancelled = False
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        # The process is made in this thread too: a fork takes milliseconds that a learner need not wait.
        self._thread = threading.Thread(target=self._run, name="retune", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """End the process and wait for the thread; there will be no result."""
        with self._lock:
            self._cancelled = True
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
        self._thread.join(10.0)

    def _run(self) -> None:
        try:
            with tempfile.TemporaryDirectory(prefix="dehyst-retuning-") as folder:
                self.result = self._work(Path(folder))
        except Exception as error:
            # A full disk, no processes left: the service goes on as it is tuned.
            self.result = {"error": f"{type(error).__name__}: {error}"}

    def _work(self, folder: Path) -> dict[str, Any]:
        (folder / "order.json").write_text(json.dumps(self._order), encoding="utf-8")
        np.savez(folder / "data.npz", **self._arrays)  # type: ignore[arg-type]
        with self._lock:
            if self._cancelled:
                return {"error": "cancelled"}
            self._process = process = subprocess.Popen(
                [sys.executable, "-m", "service.retuning.worker", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env={**os.environ, **_ENVIRONMENT},
                start_new_session=True,
            )
        try:
            _, complaint = process.communicate(timeout=self._timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return {"error": f"took longer than {self._timeout_s:g} s and was ended (timeout_s)", "timeout": True}
        try:
            told: dict[str, Any] = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"status {process.returncode}"]
            return {"error": f"the process ended without a result: {last[0][:300]}"}
        return told
