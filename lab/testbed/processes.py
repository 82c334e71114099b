"""Child processes that end with their parent: started in their own group, stopped in order, their words kept."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import TracebackType
from typing import Any

from service.protocol.errors import ServiceError
from service.runtime.stopping import unbroken


def free_port() -> int:
    """A port of this machine that nobody listens at just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Child:
    """One process: its lines are read as they come; its errors go to a log file beside the results."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.name = name
        self.lines: list[str] = []
        self._log = log
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        with log.open("w", encoding="utf-8") as errors:
            # A session of its own: Ctrl-C reaches the parent alone, which then stops the children in order.
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                start_new_session=True,
            )
        self._changed = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, name=f"read-{name}", daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as said:
            for line in said:
                with self._changed:
                    self.lines.append(line.rstrip("\n"))
                    self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def wait_line(self, start: str, timeout_s: float) -> str:
        """The first line that begins with ``start``. Raises ServiceError with the child's own words if none comes."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or any(x.startswith(start) for x in self.lines), timeout_s)
            for line in self.lines:
                if line.startswith(start):
                    return line
        raise ServiceError(f"{self.name} did not get ready: {self.words()}")

    def wait(self, timeout_s: float) -> int:
        """Its exit status. Raises ServiceError if it does not end in time."""
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ServiceError(f"{self.name} did not end within {timeout_s:g} s") from None
        self._reader.join(5.0)
        return status

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its number, for whoever measures it or sends it a signal."""
        return self._process.pid

    def send(self, number: int) -> None:
        """Send it a signal, if it is still there."""
        if self.running:
            self._process.send_signal(number)

    def kill(self) -> None:
        """End it at once, as kill -9 does."""
        self.send(signal.SIGKILL)
        self._process.wait()
        self._reader.join(5.0)

    def take_lines(self) -> list[str]:
        """What it has said since the last call; forgotten here, so that a long run does not gather it."""
        with self._changed:
            taken, self.lines = self.lines, []
        return taken

    def last_json(self) -> dict[str, Any]:
        """The last line that is a JSON object. Raises ServiceError where there is none."""
        for line in reversed(self.lines):
            if line.startswith("{"):
                return dict(json.loads(line))
        raise ServiceError(f"{self.name} left no result: {self.words()}")

    def words(self) -> str:
        """The end of what it said, on either channel."""
        told = self._log.read_text(encoding="utf-8").strip()
        return (told or "\n".join(self.lines))[-1500:] or f"nothing (exit status {self._process.poll()})"

    def stop(self, timeout_s: float = 10.0) -> None:
        """Ask it to end as Ctrl-C would; kill it if it does not."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(5.0)


class Children:
    """All children of a run; leaving the block stops them, the last started first."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._children: list[Child] = []
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, arguments: list[str]) -> Child:
        """Start ``python ARGUMENTS``."""
        with unbroken():
            child = Child(name, arguments, self._logs / f"{name}.log")
            self._children = [other for other in self._children if other.running]
            self._children.append(child)
        return child

    def __enter__(self) -> Children:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Who presses Ctrl-C twice is not to be left with what was not stopped yet.
        with unbroken():
            for child in reversed(self._children):
                child.stop()
