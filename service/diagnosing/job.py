"""One diagnosis in a process of its own: started, waited for with a limit, ended with the service."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.types import FloatArray


class Job:
    """Runs the worker on samples, in a thread that waits for it, and hands the result to ``done``.

    ``done`` gets the worker's result, or ``{"error": why}``; it is called once, from that thread, and not at all
    after :meth:`cancel`. Never raises.
    """

    def __init__(
        self,
        order: dict[str, Any],
        reference: FloatArray,
        recent: FloatArray,
        timeout_s: float,
        done: Callable[[dict[str, Any]], None],
    ) -> None:
        self._order = order
        self._reference, self._recent = reference, recent
        self._timeout_s = timeout_s
        self._done = done
        self._cancelled = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="diagnose", daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the result is still to come."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """End the process, drop the result, and wait for the thread."""
        self._cancelled.set()
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(10.0)

    def _run(self) -> None:
        try:
            with tempfile.TemporaryDirectory(prefix="dehyst-diagnosis-") as folder:
                result = self._work(Path(folder))
        except Exception as error:
            # A full disk, no processes left: the service goes on, and says why it has no verdict.
            result = {"error": f"{type(error).__name__}: {error}"}
        if not self._cancelled.is_set():
            self._done(result)

    def _work(self, folder: Path) -> dict[str, Any]:
        (folder / "job.json").write_text(json.dumps(self._order), encoding="utf-8")
        np.savez(folder / "samples.npz", reference=self._reference, recent=self._recent)
        with self._lock:
            if self._cancelled.is_set():
                return {}
            self._process = subprocess.Popen(
                [sys.executable, "-m", "service.diagnosing.worker", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
                start_new_session=True,
            )
        process = self._process
        try:
            _, complaint = process.communicate(timeout=self._timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return {"error": f"took longer than {self._timeout_s:g} s and was ended (timeout_s)"}
        try:
            told: dict[str, Any] = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            last = complaint.decode(errors="replace").strip().splitlines()[-1:] or [f"status {process.returncode}"]
            return {"error": f"the process ended without a result: {last[0][:300]}"}
        return told
