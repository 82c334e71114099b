"""What the tests of a service that must not go down share: a stage that never stops, and processes that are ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.query import Point
from dehyst.service.runtime.session import open_client

DT_S = 1e-3


def samples(first: int, n: int) -> bytes:
    """A stage with 5 % less gain than the models of conftest believe, moving at 3 Hz."""
    k = np.arange(first, first + n)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S)
    return wire.encode_samples(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), y)


class Stage:
    """Publishes samples at 1 kHz in a thread, whatever happens to who listens; use as a context manager."""

    def __init__(self, endpoints: list[str], first: int = 0, a_message: int = 5) -> None:
        self.sent = first
        self.silent = threading.Event()
        self._endpoints = endpoints
        self._n = a_message
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Stage:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        with open_client(self._endpoints, 20.0) as session:
            put = session.declare_publisher(
                "dehyst/v1/demo/x/sample", congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
            start = time.monotonic() - self.sent * DT_S
            while not self._stop.is_set():
                if not self.silent.is_set():
                    put.put(samples(self.sent, self._n))
                    self.sent += self._n
                else:
                    start += self._n * DT_S
                time.sleep(max(0.0, start + self.sent * DT_S - time.monotonic()))


class Process:
    """``dehyst COMMAND`` as a process, ready when constructed."""

    def __init__(self, *args: str, path: Path | None = None) -> None:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        if path is not None:
            environment["PYTHONPATH"] = os.pathsep.join([str(path), environment.get("PYTHONPATH", "")])
        start = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dehyst.lab.cli", *args, "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        self.start_s = time.monotonic() - start
        assert line, self.process.communicate(timeout=20)[1]
        self.ready: dict[str, Any] = json.loads(line) if line.startswith("{") else {}

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate(timeout=20)


class Asker:
    """Asks for one point after the other, as a controller does, and keeps the longest silence and the largest step."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.last: Point = client.point(40.0)
        self.silence_s = self.step_V = 0.0
        self.asked = 0

    def ask_for(self, duration_s: float) -> None:
        """Ask without a pause worth the name; raises what the client raises."""
        self.silence_s = self.step_V = 0.0
        start = answered = time.monotonic()
        while answered - start < duration_s:
            point = self.client.point(40.0, memory=self.last.memory)
            now = time.monotonic()
            self.silence_s = max(self.silence_s, now - answered)
            self.step_V = max(self.step_V, abs(point.u_V - self.last.u_V))
            self.last, answered = point, now
            self.asked += 1
            time.sleep(0.001)


def declared(session: zenoh.Session, other: zenoh.Session) -> None:
    """Wait until the wire knows all that ``session`` has declared: ``other`` sees a token that it declares last."""
    key = f"test/declared/{uuid.uuid4().hex}"
    token = session.liveliness().declare_token(key)
    eventually(lambda: any(reply.ok for reply in other.liveliness().get(key, timeout=5.0)))
    token.undeclare()


def settled(value: Callable[[], Any], quiet_s: float, within_s: float = 60.0) -> Any:
    """``value()`` once it has not changed for ``quiet_s``; fails after ``within_s``."""
    last, until = value(), time.monotonic() + within_s
    since = time.monotonic()
    while (now := time.monotonic()) - since < quiet_s:
        assert now < until, f"still changes: {last!r}"
        if (found := value()) != last:
            last, since = found, now
        time.sleep(0.05)
    return last


def eventually(condition: Any, within_s: float = 60.0) -> Any:
    """The first true value of ``condition``; fails after ``within_s``."""
    until = time.monotonic() + within_s
    while not (value := condition()):
        assert time.monotonic() < until, "did not come true in time"
        time.sleep(0.02)
    return value
