"""Work in a process of its own: started, waited for with a limit, ended with the service.

The process is ``python -m MODULE FOLDER``. It finds ``order.json`` and ``data.npz`` in the folder and leaves
``result.json`` there; `work` is its side of that.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive.types import FloatArray
from service.background.priority import step_back
from service.storage.atomic_write import atomic_write

_ORDER: Final = "order.json"
_DATA: Final = "data.npz"
_RESULT: Final = "result.json"
#: A process that may not start threads of its own: the cores belong to those who answer.
_ENVIRONMENT: Final = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA")
}  # fmt: skip


class BackgroundJob:
    """One order, in a thread that waits for its process. Never raises.

    Parameters
    ----------
    module : what runs, and reads the folder. order : for JSON. arrays : by name.
    timeout_s : longest time; then it is ended.
    done : is given the result, once, from that thread; not at all after :meth:`cancel`.

    Attributes
    ----------
    result : the process' own, or ``{"error": why}``, or ``{"error": why, "timeout": True}``; None until it is there.
    """

    def __init__(
        self,
        module: str,
        order: dict[str, Any],
        arrays: dict[str, FloatArray],
        timeout_s: float,
        done: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self.result: dict[str, Any] | None = None
        self._module = module
        self._order, self._arrays, self._timeout_s = order, arrays, timeout_s
        self._done = done
        self._cancelled = False
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        # The process is made in this thread too: a fork takes milliseconds that a learner need not wait.
        self._thread = threading.Thread(target=self._run, name=module, daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the result is still to come."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """End the process, drop the result, and wait for the thread."""
        with self._lock:
            self._cancelled = True
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(10.0)

    def _run(self) -> None:
        try:
            with tempfile.TemporaryDirectory(prefix="dehyst-") as folder:
                result = self._work(Path(folder))
        except Exception as error:
            # A full disk, no processes left: the service goes on, and says why it has no result.
            result = {"error": f"{type(error).__name__}: {error}"}
        self.result = result
        if self._done is not None and not self._cancelled:
            self._done(result)

    def _work(self, folder: Path) -> dict[str, Any]:
        (folder / _ORDER).write_text(json.dumps(self._order), encoding="utf-8")
        np.savez(folder / _DATA, **self._arrays)  # type: ignore[arg-type]
        # They are in the folder now. Who keeps a job for its result must not keep megabytes of samples with it.
        self._order, self._arrays = {}, {}
        with self._lock:
            if self._cancelled:
                return {"error": "cancelled"}
            self._process = process = subprocess.Popen(
                [sys.executable, "-m", self._module, str(folder)],
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
            told: dict[str, Any] = json.loads((folder / _RESULT).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"status {process.returncode}"]
            return {"error": f"the process ended without a result: {last[0][:300]}"}
        return told


def work(folder: Path, do: Callable[[dict[str, Any], dict[str, FloatArray]], dict[str, Any]]) -> int:
    """The process' side: ``do`` gets order and arrays, and its result is written whole or not at all. Returns 0."""
    # Before the heavy imports: whoever answers queries goes first, always.
    step_back()
    order = json.loads((folder / _ORDER).read_text(encoding="utf-8"))
    with np.load(folder / _DATA, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    with atomic_write(folder / _RESULT) as file:
        file.write(json.dumps(do(order, arrays)).encode())
    return 0
