"""Watches a soak from outside: the samples of the stage, what was wanted, what the services say, what processes take.

Seconds are kept, not samples, so that a run of days fits into memory.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh

from adaptive.errors import InputError
from service import wire
from service.keys import Keys
from service.session import open_client
from service.soak.intervals import Intervals
from service.soak.setup import AXIS, STAGE, Control
from service.stage_node import status_key

#: Samples for which the reference is remembered.
_RING = 16_384
_MAX_EVENTS = 20_000


@dataclass
class Second:
    """One second of samples: how many, the sums and worst of |error| in µm, and of the voltages what was worst.

    ``held`` samples had no command of their own in time: the stage held the last one.
    """

    t_s: float
    seq: int = 0
    samples: int = 0
    judged: int = 0
    error_sum_um: float = 0.0
    error_max_um: float = 0.0
    step_max_V: float = 0.0
    beyond_V: float = 0.0
    held: int = 0
    not_finite: int = 0

    @property
    def mae_um(self) -> float:
        """Mean |error|, µm; NaN where nothing could be judged."""
        return self.error_sum_um / self.judged if self.judged else math.nan


@dataclass
class Track:
    """What the samples of a stage show, second by second; fed with batches, in the order of arrival.

    ``clock`` tells the time of a batch, s, on the axis of the report.
    """

    control: Control
    clock: Callable[[], float]
    seconds: list[Second] = field(default_factory=list)
    seen: Intervals = field(default_factory=Intervals)

    def __post_init__(self) -> None:
        self._wanted = np.full(_RING, np.nan)
        self._wanted_seq = np.full(_RING, -1, dtype=np.int64)
        self._commanded_V = np.full(_RING, np.nan)
        self._commanded_seq = np.full(_RING, -1, dtype=np.int64)
        self._u_V, self._seq = math.nan, -2
        self.newest = -1
        self.received = 0
        self.repeated = 0

    def want(self, first: int, y_um: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        """The reference from sample ``first`` on, µm."""
        numbers = np.arange(first, first + y_um.size)
        self._wanted[numbers % _RING] = y_um
        self._wanted_seq[numbers % _RING] = numbers

    def command(self, first: int, u_V: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        """Voltages sent for the samples from ``first`` on, V."""
        numbers = np.arange(first, first + u_V.size)
        self._commanded_V[numbers % _RING] = u_V
        self._commanded_seq[numbers % _RING] = numbers

    def take(self, batch: wire.SampleBatch) -> None:
        """Samples as they came."""
        now = self.clock()
        if not self.seconds or now - self.seconds[-1].t_s >= 1.0:
            self.seconds.append(Second(math.floor(now)))
        second = self.seconds[-1]
        c, seq, u_V = self.control, batch.seq, batch.u_V
        self.received += len(batch)
        fresh = seq > self.newest if abs(int(seq[0]) - self.newest) < 10_000_000 else np.ones(len(batch), dtype=bool)
        self.repeated += len(batch) - int(np.count_nonzero(fresh))
        self.seen.add_all(seq)
        second.samples += len(batch)
        second.seq = int(seq[-1])
        slots = seq % _RING
        in_time = (self._commanded_seq[slots] == seq) & (self._commanded_V[slots] == u_V)
        second.held += len(batch) - int(np.count_nonzero(in_time))
        finite = np.isfinite(u_V)
        second.not_finite += int(np.count_nonzero(~finite))
        if finite.any():
            beyond = max(float(u_V[finite].max()) - c.u_max_V, c.u_min_V - float(u_V[finite].min()))
            second.beyond_V = max(second.beyond_V, beyond)
        if fresh.all():
            # The step is that of samples that follow one another; what lies between others nobody saw.
            before = np.concatenate(([self._u_V], u_V[:-1]))
            follows = np.diff(seq, prepend=self._seq) == 1
            if follows.any():
                second.step_max_V = max(second.step_max_V, float(np.max(np.abs(u_V - before)[follows])))
            self._u_V, self._seq = float(u_V[-1]), int(seq[-1])
            self.newest = int(seq[-1])
        known = (self._wanted_seq[seq % _RING] == seq) & np.isfinite(batch.y_um)
        if known.any():
            error = np.abs(self._wanted[seq % _RING] - batch.y_um)[known]
            second.judged += error.size
            second.error_sum_um += float(error.sum())
            second.error_max_um = max(second.error_max_um, float(error.max()))


class Monitor:
    """Subscribes through the router, and asks all instances for their status; times are s from ``start_s``."""

    def __init__(self, endpoint: str, control: Control, start_s: float) -> None:
        self.start_s = start_s
        self.track = Track(control, self.now)
        self.events: list[dict[str, Any]] = []
        #: By instance the newest status, and when it came.
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
        """A process of this axis has come, or gone: the wire's own word for it."""
        event = "came" if sample.kind == zenoh.SampleKind.PUT else "gone"
        with self._lock:
            if len(self.events) < _MAX_EVENTS:
                self.events.append({"t_s": round(self.now(), 3), "event": event, "detail": str(sample.key_expr)})

    def now(self) -> float:
        """Seconds since the watch began."""
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
        block = wire.decode_command(payload)
        self.track.command(block.seq, block.values)

    def _event(self, payload: bytes) -> None:
        if len(self.events) < _MAX_EVENTS:
            self.events.append({"t_s": round(self.now(), 3), **json.loads(payload)})

    def _status(self, payload: bytes) -> None:
        told = json.loads(payload)
        self.statuses[str(told["instance"])] = (self.now(), told)

    def _stage(self, payload: bytes) -> None:
        self.stage = json.loads(payload)

    def ask(self) -> list[dict[str, Any]]:
        """The status of every instance that answers now; the first is the one that serves queries."""
        found = []
        for reply in self._session.get(Keys(STAGE, AXIS).status, timeout=0.5):
            if reply.ok is not None:
                told = json.loads(reply.ok.payload.to_bytes())
                with self._lock:
                    self.statuses[str(told["instance"])] = (self.now(), told)
                found.append(told)
        return found

    def put(self, key: str, value: dict[str, Any]) -> None:
        """Publish JSON, to the stage or the controller."""
        self._session.put(key, json.dumps(value))

    def latest(self) -> tuple[Second | None, int]:
        """The second before the present one, and the newest number."""
        with self._lock:
            seconds = self.track.seconds
            return (seconds[-2] if len(seconds) > 1 else None), self.track.newest

    def close(self) -> None:
        """Stop watching."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
