"""Subscribes to a stage and its service over zenoh and passes batches of records to the outputs.

The stream costs the service no time: callbacks only put a payload into a bounded inbox; the thread ``view-batches``
decodes it and offers batches to outputs that drop what they cannot take. Everything that is lost is counted.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, TypeGuard

import numpy as np
import zenoh

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.config.schema import Setting, check_bounds
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.keys import Keys
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.viewer.output import Output
from dehyst.service.viewer.records import Diagnostics, Event, Health, IntArray, Record, Status, Tracking, event_record

#: Largest time that can be drawn, s: Rerun stores nanoseconds in 64 bits.
MOST_S: Final = 9e9

# --- Samples and their references


@dataclass(slots=True)
class ReferenceRing:
    """The last ``size`` references by sequence number. Each slot stores its number: an old value is never returned."""

    size: int = 1 << 16
    _seq: IntArray = field(init=False)
    _value_um: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._seq = np.full(self.size, -1, dtype=np.int64)
        self._value_um = np.full(self.size, np.nan)

    def put(self, seq: IntArray, value_um: FloatArray) -> None:
        """Store references; (n,) each, from 0 on."""
        slot = seq[-self.size :] % self.size
        self._seq[slot], self._value_um[slot] = seq[-self.size :], value_um[-self.size :]

    def get(self, seq: IntArray) -> FloatArray:
        """References of these sequence numbers, µm; NaN where there is none, or none any more."""
        slot = seq % self.size
        return np.where(self._seq[slot] == seq, self._value_um[slot], np.nan)


@dataclass(slots=True)
class Unit:
    """The samples of one unit that wait for the references of the same sequence number.

    References usually arrive before the samples. Where some are missing, the samples wait once more, and go on without.
    ``shared`` holds the references of the unit that this one shares its reference with.
    """

    model: str
    shared: ReferenceRing
    ring: ReferenceRing = field(default_factory=ReferenceRing)
    restarts: int = 0
    _waiting: list[wire.SampleBatch] = field(default_factory=list)
    _waited: bool = False
    _newest_s: float = -np.inf

    def put(self, samples: wire.SampleBatch) -> None:
        """Take samples. If time runs backwards the stage has restarted: waiting samples are dropped."""
        samples = samples.where(np.abs(samples.t_s) < MOST_S)
        if not len(samples):
            return
        if samples.t_s[0] < self._newest_s:
            self.restarts += 1
            self._waiting = []
        self._newest_s = float(samples.t_s[-1])
        self._waiting.append(samples)

    def take(self, everything: bool = False) -> Tracking | None:
        """The samples that are ready, in order, or None. ``everything``: all of them, at the end of a run."""
        if not self._waiting:
            return None
        samples = wire.joined(self._waiting)
        own_um = self.ring.get(samples.seq)
        reference_um = np.where(np.isnan(own_um), self.shared.get(samples.seq), own_um)
        if np.isnan(reference_um).any() and not (self._waited or everything):
            self._waited = True
            return None
        self._waiting, self._waited = [], False
        return Tracking(self.model, samples.seq, samples.t_s, samples.u_V, samples.y_um, reference_um)


# --- The consumer

#: A message about a sample may come so long before the sample itself, s of the stage's time: it has another key.
_AHEAD_S = 1.0


@dataclass(frozen=True, slots=True)
class ConsumerConfig:
    """What to subscribe to.

    Attributes
    ----------
    stage, axis : the unit that the service serves and learns from. model : the model that drives it.
    twins : pairs (axis of the same stage, model that drives it), for comparison.
    changes_s : times of the stage at which it is known to change, s; loops are drawn before and after.
    batch_s : period of the batches, s. inbox : messages that may wait for the next batch, at most.

    Raises InputError on values that do not fit.
    """

    stage: str
    axis: str
    model: str = "lssvm_adaptive"
    twins: tuple[tuple[str, str], ...] = ()
    changes_s: tuple[float, ...] = ()
    batch_s: Annotated[float, Setting(unit="s", low=0.05, high=5.0)] = 0.2
    inbox: int = 20_000

    def __post_init__(self) -> None:
        check_bounds(self)
        axes = [self.axis, *(axis for axis, _ in self.twins)]
        if len(set(axes)) != len(axes) or len(set(self.models)) != len(axes):
            raise InputError(
                f"twins: got {self.twins!r}, expected other axes and models than each other's and {axes[0]!r}"
            )
        for axis in axes:
            Keys(self.stage, axis)

    @property
    def models(self) -> tuple[str, ...]:
        """All models shown, the main one first."""
        return (self.model, *(model for _, model in self.twins))


class Consumer:
    """Runs from its construction until `close`. Declares its subscribers on ``session``, which the caller closes."""

    def __init__(self, session: zenoh.Session, config: ConsumerConfig, outputs: Sequence[Output]) -> None:
        self.config = config
        self.counts: Counter[str] = Counter()
        self._by = own_authenticator()
        self._outputs = outputs
        self._inbox: deque[tuple[str, str, bytes]] = deque()
        main = ReferenceRing()
        self._units = {model: Unit(model, main) for model in config.models}
        self._units[config.model].ring = main
        self._t_s, self._seq, self._dt_s = 0.0, 0, 0.0
        self._next_health = 0.0
        self._changes_s = sorted(config.changes_s)
        self._stop = threading.Event()
        self._subscribers = [
            session.declare_subscriber(key, self._callback(kind, model, key))
            for kind, model, key in _subscriptions(config)
        ]
        self._thread = threading.Thread(target=self._run, name="view-batches")
        self._thread.start()

    def close(self) -> None:
        """Unsubscribe, pass on the rest, end the thread. May be called twice."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._subscribers = []
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
            self._next_health = 0.0
            self._offer(everything=True)

    def _callback(self, kind: str, model: str, key: str) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            self.counts["messages"] += 1
            if kind == "status" and self._by.heard(sample, key) is None:
                self.counts["unsigned"] += 1  # not of the service
            elif len(self._inbox) >= self.config.inbox:
                self.counts["inbox_full"] += 1
            else:
                self._inbox.append((kind, model, sample.payload.to_bytes()))

        return take

    def _run(self) -> None:
        while not self._stop.wait(self.config.batch_s):
            self._offer(everything=False)

    def _offer(self, everything: bool) -> None:
        """Decode the waiting messages and offer them as one batch."""
        said: list[Record] = []
        # Only what waits now, so that a flood of messages does not keep this loop running.
        for _ in range(len(self._inbox)):
            kind, model, payload = self._inbox.popleft()
            try:
                record = self._decode(kind, model, payload)
            except Exception:  # A peer may send anything; it must not end the stream.
                self.counts["malformed"] += 1
                continue
            if record is not None:
                said.append(record)
        tracking = [t for unit in self._units.values() if (t := unit.take(everything)) is not None]
        while self._changes_s and self._changes_s[0] <= self._t_s:
            change_s = self._changes_s.pop(0)
            ago = round((self._t_s - change_s) / self._dt_s) if self._dt_s else 0
            said.append(Event(change_s, max(0, self._seq - ago), "change, as announced", "WARN", change=True))
        # Events first: a change must be known before the samples after it are drawn.
        events = [record for record in said if isinstance(record, Event)]
        batch = [*events, *tracking, *(record for record in said if not isinstance(record, Event))]
        if time.monotonic() >= self._next_health:
            self._next_health = time.monotonic() + 1.0
            self.counts["restarts"] = sum(unit.restarts for unit in self._units.values())
            self.counts["dropped_batches"] = sum(output.dropped for output in self._outputs)
            batch.append(Health(self._t_s, self._seq, dict(self.counts)))
        if batch:
            for output in self._outputs:
                output.offer(batch)

    def _decode(self, kind: str, model: str, payload: bytes) -> Record | None:
        if kind == "sample":
            samples = wire.decode_samples(payload)
            self.counts["samples"] += len(samples)
            self._units[model].put(samples)
            if model == self.config.model:
                self._clock(samples)
            return None
        if kind == "reference":
            block = wire.decode_reference(payload)
            self._units[model].ring.put(block.seq + np.arange(len(block), dtype=np.int64), block.values)
            return None
        fields = json.loads(payload)
        if not isinstance(fields, dict):
            raise ValueError("not an object")
        self.counts[kind] += 1
        t_s, seq = self._when(fields)
        if kind == "diagnostics":
            return Diagnostics(t_s, seq, fields)
        if kind == "status":
            return Status(t_s, seq, fields)
        return event_record(t_s, seq, fields)

    def _clock(self, samples: wire.SampleBatch) -> None:
        """Keep the newest pair of sequence number and time of the stage, and the sample time."""
        t_s, seq = float(samples.t_s[-1]), int(samples.seq[-1])
        if _is_time(t_s):
            if seq > self._seq and t_s > self._t_s:
                self._dt_s = (t_s - self._t_s) / (seq - self._seq)
            self._t_s, self._seq = t_s, seq

    def _when(self, fields: Mapping[str, Any]) -> tuple[float, int]:
        """Time and number of a message: from its fields, from the time of its number, or those of the newest sample."""
        t_s, seq = fields.get("t_s"), fields.get("seq")
        numbered = isinstance(seq, int) and not isinstance(seq, bool) and 0 <= seq <= wire.MAX_SEQ
        number = int(seq) if numbered else self._seq  # type: ignore[arg-type]
        ago_s = (self._seq - number) * self._dt_s
        if _is_time(t_s):
            return float(t_s), number
        # A number from before a restart of the stage has no time here; one that is slightly ahead does.
        return (self._t_s - ago_s if -_AHEAD_S <= ago_s <= self._t_s else self._t_s), number


def _is_time(value: Any) -> TypeGuard[float]:
    """Whether this can be drawn as a time."""
    return isinstance(value, (int, float)) and abs(value) < MOST_S


def _subscriptions(config: ConsumerConfig) -> Iterator[tuple[str, str, str]]:
    """(kind, model, key) of every subscription."""
    for kind in ("sample", "reference", "status", "diagnostics", "event"):
        yield kind, config.model, getattr(Keys(config.stage, config.axis), kind)
    for axis, model in config.twins:
        for kind in ("sample", "reference"):
            yield kind, model, getattr(Keys(config.stage, axis), kind)
