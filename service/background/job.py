"""Background work in a process of its own, with a time limit; it ends with the service.

The process is ``python -m MODULE FOLDER``. It reads ``order.json`` and ``data.npz`` from the folder and writes
``result.json`` there. `BackgroundJob` is the side of the service, `run_worker` the side of the process.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.types import FloatArray
from dehyst.service.storage.output import atomic_write

# --- Priority of processes: background jobs run at low priority, behind the process that answers queries.

#: The lowest priority of Unix (niceness).
LAST: Final = 19
_AUTOGROUP: Final = Path("/proc/self/autogroup")
#: Linux accepts one change of an autogroup in 0.1 s, from all processes together.
_TRIES, _PAUSE_S = 20, 0.11


def step_back(steps: int = LAST) -> None:
    """Increase the niceness of this process by ``steps``, and that of its session if the process leads it.

    With autogroups, which most distributions enable, Linux divides a core between sessions first; niceness counts only
    within a session. A process of the lowest priority in a session of its own would take half a core from the service
    and delay answers by tenths of a second. The session therefore gets a niceness too.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(steps)
        # Do not slow down a session that another process leads, such as a shell.
        if os.getsid(0) != os.getpid():
            return
        for _ in range(_TRIES):
            try:
                _AUTOGROUP.write_text(str(steps), encoding="ascii")
                return
            except BlockingIOError:
                time.sleep(_PAUSE_S)


# --- Jobs.

_ORDER: Final = "order.json"
_DATA: Final = "data.npz"
_RESULT: Final = "result.json"
#: The process must not start threads of its own: queries need the cores.
_ENVIRONMENT: Final = {
    f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA")
}  # fmt: skip


class BackgroundJob:
    """One order in a process, and the thread that waits for it. Never raises.

    Parameters
    ----------
    module : that the process runs. order : JSON object for it. arrays : arrays for it, by name.
    timeout_s : longest time, s; then the process is killed.
    done : called once with the result, from the waiting thread; not called after :meth:`cancel`.

    Attributes
    ----------
    result : of the process, or ``{"error": why}``, or ``{"error": why, "timeout": True}``; None while it runs.
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
        # The thread also starts the process: a fork takes milliseconds, for which the learner must not wait.
        self._thread = threading.Thread(target=self._run, name=module, daemon=True)

    def start(self) -> None:
        """Start the thread; returns at once."""
        self._thread.start()

    @property
    def running(self) -> bool:
        """True until there is a result."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Kill the process, drop its result, and wait for the thread."""
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
            # For example a full disk, or no process left: the service continues.
            result = {"error": f"{type(error).__name__}: {error}"}
        self.result = result
        if self._done is not None and not self._cancelled:
            self._done(result)

    def _work(self, folder: Path) -> dict[str, Any]:
        (folder / _ORDER).write_text(json.dumps(self._order), encoding="utf-8")
        np.savez(folder / _DATA, **self._arrays)  # type: ignore[arg-type]
        # They are in the folder now: a job that is kept for its result must not keep megabytes of samples.
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
            result: dict[str, Any] = json.loads((folder / _RESULT).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"status {process.returncode}"]
            return {"error": f"the process ended without a result: {last[0][:300]}"}
        return result


def run_worker(do: Callable[[dict[str, Any], dict[str, FloatArray]], dict[str, Any]]) -> int:
    """Run one order in this process: call ``do(order, arrays)`` and write its result atomically. Returns 0.

    The folder is the first argument of the process. A DehystError becomes the result ``{"error": message}``.
    """
    # Before the heavy imports of ``do``: queries have priority.
    step_back()
    folder = Path(sys.argv[1])
    order = json.loads((folder / _ORDER).read_text(encoding="utf-8"))
    with np.load(folder / _DATA, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    try:
        result = do(order, arrays)
    except DehystError as error:
        result = {"error": str(error)}
    with atomic_write(folder / _RESULT) as file:
        file.write(json.dumps(result).encode())
    return 0
