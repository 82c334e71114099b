"""Observes a soak from outside the service: samples, references, commands, events and statuses."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from adaptive.errors import InputError
from lab.soak.task import AXIS, STAGE, ControlTask
from lab.soak.verdict.observations import SampleSecond, SampleTracker
from service.protocol import samples as wire
from service.protocol.keys import Keys
from service.runtime.session import SURELY, open_client
from service.stage_node.node import status_key

#: Events are kept up to this number, which lasts for months.
_MAX_EVENTS = 500_000


class Monitor:
    """Subscribes through the router, and asks all services for their status. Times are s from ``start_s``."""

    def __init__(self, endpoint: str, control: ControlTask, start_s: float) -> None:
        self.start_s = start_s
        self.track = SampleTracker(control, self.now)
        self.events: list[dict[str, Any]] = []
        #: By instance, when its newest status came, and the status.
        self.statuses: dict[str, tuple[float, dict[str, Any]]] = {}
        self.stage: dict[str, Any] = {}
        self.malformed = 0
        self._lock = threading.Lock()
        self._session = open_client(endpoint, 10.0)
        keys = Keys(STAGE, AXIS)
        self._subscribers = [
            self._session.declare_subscriber(key, self._guarded(take))
            for key, take in (
                (keys.sample, self._sample),
                (keys.reference, self._reference),
                (keys.command, self._command),
                (keys.event, self._event),
                (keys.status, self._status),
                (f"{keys.base}/standby/*", self._status),
                (status_key(STAGE, AXIS), self._stage),
            )
        ]
        tokens = self._session.liveliness().declare_subscriber(f"{keys.base}/**", self._alive)
        self._subscribers.append(tokens)

    def _alive(self, sample: zenoh.Sample) -> None:
        """A liveliness token of this axis has appeared or gone."""
        event = "came" if sample.kind == zenoh.SampleKind.PUT else "gone"
        with self._lock:
            if len(self.events) < _MAX_EVENTS:
                self.events.append({"t_s": round(self.now(), 3), "event": event, "detail": str(sample.key_expr)})

    def begin(self) -> None:
        """Set the time to zero, and forget what was seen before."""
        with self._lock:
            self.start_s = time.monotonic()
            self.track.seconds.clear()
            self.events.clear()
            self.statuses.clear()

    def now(self) -> float:
        """Seconds since `begin`."""
        return time.monotonic() - self.start_s

    def _guarded(self, take: Callable[[bytes], None]) -> Callable[[zenoh.Sample], None]:
        def callback(sample: zenoh.Sample) -> None:
            try:
                with self._lock:
                    take(sample.payload.to_bytes())
            except (InputError, ValueError, KeyError):
                self.malformed += 1

        return callback

    def _sample(self, payload: bytes) -> None:
        self.track.take(wire.decode_samples(payload))

    def _reference(self, payload: bytes) -> None:
        block = wire.decode_reference(payload)
        self.track.want(block.seq, block.values)

    def _command(self, payload: bytes) -> None:
        try:
            block = wire.decode_command(payload)
        except InputError:
            # Its receiver refuses it, but the controller has sent it.
            self.track.refuse_command()
            raise
        self.track.command(block.seq, block.values)

    def _event(self, payload: bytes) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append({"t_s": round(self.now(), 3), **json.loads(payload)})

    def _status(self, payload: bytes) -> None:
        status = json.loads(payload)
        self.statuses[str(status["instance"])] = (self.now(), status)

    def _stage(self, payload: bytes) -> None:
        self.stage = json.loads(payload)

    def ask(self) -> list[dict[str, Any]]:
        """The status of every service that answers now; the first is the one that answers queries."""
        found = []
        for reply in self._session.get(Keys(STAGE, AXIS).status, timeout=0.5):
            if reply.ok is not None:
                status = json.loads(reply.ok.payload.to_bytes())
                with self._lock:
                    self.statuses[str(status["instance"])] = (self.now(), status)
                found.append(status)
        return found

    def put(self, key: str, value: dict[str, Any]) -> None:
        """Publish JSON, for the stage or the controller."""
        self._session.put(key, json.dumps(value), congestion_control=SURELY)

    def samples(self) -> dict[str, int]:
        """Number of distinct samples seen so far, and of samples received."""
        with self._lock:
            return {"seen": len(self.track.seen), "received_by_monitor": self.track.received}

    def latest(self) -> tuple[SampleSecond | None, int]:
        """The last complete second, and the newest sample number."""
        with self._lock:
            seconds = self.track.seconds
            return (seconds[-2] if len(seconds) > 1 else None), self.track.newest

    def close(self) -> None:
        """Unsubscribe and close the session."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
