"""The serving process: one zenoh session, its axes, and the thread that publishes. Never imports torch."""

from __future__ import annotations

import math
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Final

import zenoh
from threadpoolctl import threadpool_limits

from service.axis_server import AxisServer
from service.config import AxisConfig, ServeConfig
from service.intake import SampleSink
from service.keys import Keys
from service.models import LearnerFactory, load_axis, make_learner
from service.session import open_service

#: How long a Python thread may keep the interpreter's lock from another that waits for it, s. The default of 5 ms
#: would be the latency of a query that meets the learner.
_SWITCH_S: Final = 1e-4
#: The publishing thread looks at least this often, s.
_TICK_S: Final = 0.02


def make_recorder(config: AxisConfig) -> SampleSink | None:
    """The recorder of an axis, or None where the configuration names no folder."""
    if config.recorder is None:
        return None
    from service.recorder import Recorder, RecorderConfig

    return Recorder(RecorderConfig(config.recorder))


class Service:
    """A running service; use as a context manager.

    Parameters
    ----------
    config : what to serve.
    factory : makes what learns.
    sinks : makes the recorder of an axis, or None.
    """

    def __init__(
        self,
        config: ServeConfig,
        factory: LearnerFactory = make_learner,
        sinks: Callable[[AxisConfig], SampleSink | None] = make_recorder,
    ) -> None:
        self.config = config
        self.instance = f"i{os.getpid()}-{secrets.token_hex(4)}"
        self.axes: list[AxisServer] = []
        self._factory = factory
        self._sinks = sinks
        self._session: zenoh.Session | None = None
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._publisher = threading.Thread(target=self._publish, name="publish")

    def __enter__(self) -> Service:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Load the models, open the session, declare. Raises ModelFileError, InputError, SessionError."""
        config = self.config
        # Everything that can be refused is looked at before anything can be seen on the wire.
        loaded = [load_axis(config.stage, axis, self._factory) for axis in config.axes]
        self._session = open_service(config.listen, config.connect, config.zenoh_config)
        try:
            for axis in loaded:
                server = AxisServer(
                    self._session,
                    Keys(config.stage, axis.config.name),
                    axis,
                    self.instance,
                    self._wake.set,
                    self._sinks(axis.config),
                )
                self.axes.append(server)
                server.declare()
            self._publisher.start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Undeclare, end the threads, close the session; in that order, or the interpreter hangs at its end."""
        self._stopping.set()
        self._wake.set()
        if self._publisher.is_alive():
            self._publisher.join()
        for axis in self.axes:
            axis.undeclare()
            if axis.intake.sink is not None:
                axis.intake.sink.close()
        self.axes = []
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
            self._session = None

    def ready(self) -> dict[str, Any]:
        """What a caller needs to know to reach this service."""
        return {
            "ready": True,
            "instance": self.instance,
            "listen": list(self.config.listen),
            "connect": list(self.config.connect),
            "stage": self.config.stage,
            "axes": {axis.keys.axis: list(axis.axis.newest.models) for axis in self.axes},
            "key": self.axes[0].keys.base if len(self.axes) == 1 else f"dehyst/v1/{self.config.stage}/*",
        }

    def _publish(self) -> None:
        while not self._stopping.is_set():
            self._wake.wait(_TICK_S)
            self._wake.clear()
            for axis in self.axes:
                try:
                    axis.tick(time.monotonic())
                except Exception as error:
                    # Publishing informs; it must not end because one message could not be made.
                    axis.axis.note("internal_error", f"publishing: {type(error).__name__}: {error}")
                    self._stopping.wait(_TICK_S)


def tune_process() -> None:
    """One BLAS thread (two stall for tens of ms now and then), and quick changes between Python's threads."""
    threadpool_limits(1)
    sys.setswitchinterval(_SWITCH_S)


class StopSignal:
    """Ctrl-C and SIGTERM, caught from its making on; make it in the main thread before anything slow."""

    def __init__(self) -> None:
        self.reason = ""
        self._event = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def wait(self, duration_s: float | None = None) -> str:
        """Wait for a signal or for ``duration_s``; returns the signal's name, or that the time is over."""
        until = math.inf if duration_s is None else time.monotonic() + duration_s
        # In steps, because a wait without end keeps some platforms from delivering the signal.
        while not self._event.wait(min(0.5, max(0.0, until - time.monotonic()))):
            if time.monotonic() >= until:
                return "time is over"
        return self.reason

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.reason = signal.Signals(number).name
        self._event.set()
