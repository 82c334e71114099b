"""The serving process: one zenoh session, its axes, and the thread that publishes. Never imports torch."""

from __future__ import annotations

import logging
import os
import secrets
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import zenoh
from threadpoolctl import threadpool_limits

from dehyst.service.config.settings import ServeConfig
from dehyst.service.failover.role_control import RoleControl
from dehyst.service.failover.standby_model import standby_folder
from dehyst.service.protocol.errors import FieldError, SessionError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.memory import TRIM_S, give_back, keep_little
from dehyst.service.runtime.session import open_service
from dehyst.service.security.authenticator import NO_KEY, Authenticator, default_key, read_key
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.server.axis_server import HOLD_S, PRIMARY, STANDBY, UNSIGNED, AxisServer
from dehyst.service.server.long_queries import LongQueries
from dehyst.service.storage.checkpoint import restore_newest

_LOGGER: Final = logging.getLogger("dehyst.service")
#: Longest time for which a Python thread keeps the interpreter's lock from another that waits, s. With the default of
#: 5 ms a query that meets the learner would wait for that long.
_SWITCH_S: Final = 1e-4
#: How long an instance looks for another that serves before it serves itself, s: one that is to stand by, one that a
#: standby may be about to connect to, which it tries five times a second, and any other that is connected to something;
#: and how much longer it may take until that is settled.
STANDBY_PATIENCE_S: Final = 3.0
PAIR_PATIENCE_S: Final = 0.6
PATIENCE_S: Final = 0.3
SETTLE_S: Final = 20.0
#: How long it waits for the state of the one that serves before it says that it is ready all the same, s.
SYNC_S: Final = 30.0
#: Longest pause of the publishing thread, s.
_TICK_S: Final = 0.02


def authenticator_of(config: ServeConfig, standby: bool = False) -> Authenticator:
    """By the key of this service, which is made where it is missing; without one (``open``) a warning is logged.

    Raises FieldError where a key cannot be used, or a pair of instances can share none.
    """
    path = config.key or default_key()
    if config.open or path is None:
        _LOGGER.warning("%s", UNSIGNED)
        return NO_KEY
    try:
        return read_key(path, make=path != config.key)
    except OSError as error:
        if standby or config.standby_listen:
            raise FieldError(
                "key",
                f"nothing, and {path} cannot be written",
                "a file with a key that both instances can read",
                "name one as key, or in DEHYST_KEY; see docs/access.md",
            ) from error
        _LOGGER.warning("key: %s cannot be written: no client can check an answer, and no standby can follow", path)
        return Authenticator(secrets.token_bytes(32))


def as_standby(config: ServeConfig) -> ServeConfig:
    """``config`` for the instance that stands by: other ears, other folders. Raises InputError where it has no ears."""
    if config.listen and not config.standby_listen:
        raise FieldError(
            "standby_listen",
            "nothing",
            "an endpoint of the standby's own",
            "clients look for it there; or use a router",
        )
    axes = tuple(
        replace(axis, recorder=standby_folder(axis.recorder), checkpoints=standby_folder(axis.checkpoints))
        for axis in config.axes
    )
    return replace(config, axes=axes, listen=config.standby_listen, connect=(*config.connect, *config.listen))


def _restore(server: AxisServer) -> None:
    """Restore the newest checkpoint, then learn the samples after it from the recording.

    A *freeze* or *thaw* that is in the operators' journal but not in the checkpoint is applied at its sample.
    """
    axis, folder, sink = server.axis, server.checkpoints.folder, server.loop.sink
    server.checkpoints.hold(HOLD_S)
    switch = server.journal().last_switch()
    number = None if folder is None else restore_newest(axis, folder, axis.config.recorder, switch)
    if number is None and switch is not None:
        axis.set_frozen(switch.freezes, switch.who)
    if sink is not None:
        sink.rebase(axis.sequence.received)


class Service:
    """A running service; use as a context manager.

    Parameters
    ----------
    config : what to serve.
    standby : look longer for another that serves before serving; listen at ``standby_listen``, keep files apart.
    stopped : ends the wait for the state of the one that serves.
    """

    def __init__(
        self,
        config: ServeConfig,
        standby: bool = False,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.config = as_standby(config) if standby else config
        self.standby = standby
        self._stopped = stopped
        self._key: Path | None = None
        self.instance = f"i{os.getpid()}-{secrets.token_hex(4)}"
        self.axes: list[AxisServer] = []
        self._long_queries = LongQueries(config.busy_after_s)
        self._role_controls: list[RoleControl] = []
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
        """Load the models, open the session, declare; a standby waits until it holds the model of the one that serves.

        Raises ModelFileError, InputError, SessionError.
        """
        config = self.config
        # Everything that can be refused is read before anything appears on the wire.
        authenticator = authenticator_of(config, self.standby)
        self._key = authenticator.path
        loaded = [load_axis(config.stage, axis) for axis in config.axes]
        # Of a pair the one that stands by connects to the other, which waits for that. Where each connected to the
        # other and one was stopped, both connections were made anew when it went on, and once in some ten times zenoh
        # (1.10) left the two without half of what they had declared to each other, for good: both served.
        self._session = open_service(config.listen, config.connect, config.zenoh_config, config.lease_s)
        alone_s = PATIENCE_S if config.connect else 0.0
        patience_s = STANDBY_PATIENCE_S if self.standby else PAIR_PATIENCE_S if config.standby_listen else alone_s
        try:
            for axis in loaded:
                server = AxisServer(
                    self._session,
                    Keys(config.stage, axis.config.name),
                    axis,
                    self.instance,
                    self._wake.set,
                    authenticator,
                    self._long_queries,
                )
                self.axes.append(server)
                _restore(server)
                control = RoleControl(self._session, server, patience_s, not config.listen)
                self._role_controls.append(control)
                server.listen()
                control.start()
            for control in self._role_controls:
                if not control.settled.wait(patience_s + SETTLE_S):
                    raise SessionError(f"axis {control.server.keys.axis}: it could not be declared; see its events")
            self._publisher.start()
            until = time.monotonic() + SYNC_S
            for control in self._role_controls:
                while not control.ready.wait(0.1) and time.monotonic() < until and not self._stopped():
                    pass
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Undeclare, end the threads, close the session; in that order, or the interpreter hangs at its end."""
        self._stopping.set()
        self._wake.set()
        if self._publisher.is_alive():
            self._publisher.join()
        for control in self._role_controls:
            control.close()
        self._role_controls = []
        # Whoever still waits gets an error before the session closes.
        self._long_queries.close()
        for axis in self.axes:
            axis.undeclare()
            if axis.loop.sink is not None:
                axis.loop.sink.close()
        self.axes = []
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
            self._session = None

    def ready(self) -> dict[str, Any]:
        """Fields of the line that `dehyst serve` prints when it is ready: role, endpoints, axes and their models."""
        return {
            "ready": True,
            "instance": self.instance,
            "role": PRIMARY if any(axis.role == PRIMARY for axis in self.axes) else STANDBY,
            "epoch": max(axis.epoch for axis in self.axes),
            "synced": all(axis.synced for axis in self.axes),
            "listen": list(self.config.listen),
            "connect": list(self.config.connect),
            "stage": self.config.stage,
            "axes": {axis.keys.axis: list(axis.axis.newest.models) for axis in self.axes},
            "key_file": None if self._key is None else str(self._key),
            "key": self.axes[0].keys.base if len(self.axes) == 1 else f"dehyst/v1/{self.config.stage}/*",
        }

    def _publish(self) -> None:
        trimmed_at = time.monotonic()
        while not self._stopping.is_set():
            self._wake.wait(_TICK_S)
            self._wake.clear()
            if time.monotonic() - trimmed_at >= TRIM_S:
                trimmed_at = time.monotonic()
                give_back()
            for axis in self.axes:
                try:
                    axis.tick(time.monotonic())
                except Exception as error:
                    # One message that cannot be made must not end publishing.
                    axis.axis.note("internal_error", f"publishing: {type(error).__name__}: {error}")
                    self._stopping.wait(_TICK_S)


def tune_process() -> None:
    """One BLAS thread (two stall for tens of ms now and then), fast switches between Python's threads, few heaps."""
    keep_little()
    threadpool_limits(1)
    sys.setswitchinterval(_SWITCH_S)
