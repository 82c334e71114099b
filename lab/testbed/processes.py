"""Child processes that end with their parent: each in its own process group, stopped in order, output kept."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from dehyst.adaptive.errors import DehystError
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.runtime.session import open_client, open_service
from dehyst.service.runtime.stopping import StopSignal, unbroken


def free_port() -> int:
    """A TCP port of this machine on which nothing listens at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def run_client_process(work: Callable[[], int]) -> int:
    """Entry of a process that queries a service: the exit status of ``work``.

    A DehystError is printed as JSON {"error": text}, and the exit status is 2; after Ctrl-C it is 130.
    """
    # zenoh's threads must not wait 5 ms for the interpreter lock.
    sys.setswitchinterval(5e-5)
    try:
        return work()
    except DehystError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return 2
    except KeyboardInterrupt:
        return 130


class Child:
    """One Python process. A thread reads its standard output line by line; standard error goes to a log file."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.name = name
        self.lines: list[str] = []
        self._log = log
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        with log.open("w", encoding="utf-8") as errors:
            # A new session: Ctrl-C reaches only the parent, which then stops the children in order.
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
        with self._process.stdout as output:
            for line in output:
                with self._changed:
                    self.lines.append(line.rstrip("\n"))
                    self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def wait_line(self, start: str, timeout_s: float) -> str:
        """The first output line that begins with ``start``. Raises ServiceError, with the process' output, if there is
        none within ``timeout_s``."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or any(x.startswith(start) for x in self.lines), timeout_s)
            for line in self.lines:
                if line.startswith(start):
                    return line
        raise ServiceError(f"{self.name} did not get ready: {self.output_tail()}")

    def wait(self, timeout_s: float) -> int:
        """The exit status. Raises ServiceError if the process does not end in time."""
        try:
            status = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise ServiceError(f"{self.name} did not end within {timeout_s:g} s") from None
        self._reader.join(5.0)
        return status

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, number: int) -> None:
        """Send a signal, if the process still runs."""
        if self.running:
            self._process.send_signal(number)

    def kill(self) -> None:
        """End the process at once, as kill -9 does."""
        self.send(signal.SIGKILL)
        self._process.wait()
        self._reader.join(5.0)

    def take_lines(self) -> list[str]:
        """The output lines since the last call. They are dropped here, so that a long run does not collect them."""
        with self._changed:
            taken, self.lines = self.lines, []
        return taken

    def last_json(self) -> dict[str, Any]:
        """The last output line that is a JSON object. Raises ServiceError if there is none."""
        for line in reversed(self.lines):
            if line.startswith("{"):
                return dict(json.loads(line))
        raise ServiceError(f"{self.name} left no result: {self.output_tail()}")

    def output_tail(self) -> str:
        """The last 1500 characters of standard error, or of standard output if there is no standard error."""
        errors = self._log.read_text(encoding="utf-8").strip()
        return (errors or "\n".join(self.lines))[-1500:] or f"no output (exit status {self._process.poll()})"

    def stop(self, timeout_s: float = 10.0) -> None:
        """Send SIGINT, as Ctrl-C does; kill the process if it does not end within ``timeout_s``."""
        if self.running:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(5.0)


class Children:
    """All child processes of a run. Leaving the block stops them, the last one started first."""

    def __init__(self, logs: Path) -> None:
        self.logs = logs
        self._children: list[Child] = []
        logs.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, arguments: list[str]) -> Child:
        """Start ``python ARGUMENTS``; its standard error goes to ``NAME.log``."""
        with unbroken():
            child = Child(name, arguments, self.logs / f"{name}.log")
            self._children = [other for other in self._children if other.running]
            self._children.append(child)
        return child

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A second Ctrl-C must not leave processes behind.
        with unbroken():
            for child in reversed(self._children):
                child.stop()


# --- A bare zenoh echo: ``python -m dehyst.lab.testbed.processes listen|connect ENDPOINT`` answers queries with as many
# bytes as asked for, which is the round trip without a service. It prints ``ready`` and runs until stopped.

#: Key of the echo; ``echo/BYTES`` asks for a reply of so many bytes.
ECHO_KEY = "echo"


def echo(how: str, endpoint: str) -> int:
    """Answer every query on ``echo/BYTES`` with as many bytes. The payload is read as the service reads it.

    ``how``: ``listen`` opens ``endpoint``, ``connect`` connects to the router there.
    """
    from dehyst.service.server.process import tune_process

    tune_process()
    stop = StopSignal()

    def answer(query: zenoh.Query) -> None:
        with query:
            if query.payload is not None:
                query.payload.to_bytes()
            key = str(query.key_expr)
            query.reply(key, bytes(int(key.rpartition("/")[2])))

    with open_service([endpoint]) if how == "listen" else open_client(endpoint, 20.0) as session:
        queryable = session.declare_queryable(f"{ECHO_KEY}/*", answer)
        print("ready", flush=True)
        stop.wait()
        queryable.undeclare()  # type: ignore[no-untyped-call]
    return 0


if __name__ == "__main__":
    sys.exit(echo(sys.argv[1], sys.argv[2]))
