"""The entities of one axis on the wire: three queryables, a subscriber, four publishers and a liveliness token."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from adaptive.errors import DehystError
from service.axis import Axis
from service.errors import FieldError, error_to_json
from service.intake import Intake, SampleSink
from service.keys import Keys
from service.latency import LatencyMeter
from service.status import axis_status
from service.wire import decode_samples
from service.wire_model import encode_model
from service.wire_query import decode_query, encode_reply

JSON: Final = "application/json"
STATUS_PERIOD_S: Final = 1.0


class AxisServer:
    """Puts one axis on the wire.

    Every callback answers: an exception on the way to an answer becomes an error reply, because a callback that raises
    leaves its caller without any.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        axis: Axis,
        instance: str,
        wake: Callable[[], None],
        sink: SampleSink | None = None,
    ) -> None:
        self.keys = keys
        self.axis = axis
        self.instance = instance
        self.latency = LatencyMeter()
        self.intake = Intake(axis, wake, sink)
        self._session = session
        self._published = axis.newest
        self._published_at = 0.0
        self._told: dict[str, Any] = {}
        self._status_at = 0.0
        self._sample_at: float | None = None
        self._entities: list[Any] = []
        self._token: Any = None

    def declare(self) -> None:
        """Declare everything; the liveliness token last, because alive means callable."""
        self.intake.start()
        session, keys = self._session, self.keys
        drop, block = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
        self._model = session.declare_publisher(keys.model, congestion_control=drop)
        self._diagnostics = session.declare_publisher(keys.diagnostics, congestion_control=drop, encoding=JSON)
        self._status = session.declare_publisher(keys.status, congestion_control=drop, encoding=JSON)
        self._event = session.declare_publisher(keys.event, congestion_control=block, encoding=JSON)
        self._entities = [
            session.declare_subscriber(keys.sample, self._on_sample),
            session.declare_queryable(
                keys.feedforward, self._guarded(keys.feedforward, self._feedforward, self.latency)
            ),
            session.declare_queryable(keys.model, self._guarded(keys.model, self._model_reply)),
            session.declare_queryable(keys.status, self._guarded(keys.status, self._status_reply)),
            self._model,
            self._diagnostics,
            self._status,
            self._event,
        ]
        self._token = session.liveliness().declare_token(keys.alive(self.instance))

    def undeclare(self) -> None:
        """First no longer alive, then no longer callable; what is queued is handled, then the rest goes."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None
        for entity in self._entities[:4]:
            entity.undeclare()
        self.intake.close()
        self._publish_events()
        for entity in self._entities[4:]:
            entity.undeclare()
        self._entities = []

    def tick(self, now_s: float) -> None:
        """Publish what is due at ``now_s`` on a clock that never goes back. Called from one thread."""
        newest = self.axis.newest
        if newest is not self._published and now_s - self._published_at >= 1.0 / self.axis.config.model_hz:
            if self.axis.config.learn and _is_followed(self._model):
                self._model.put(self._encoded(self.axis.config.learn))
            self._published, self._published_at = newest, now_s
        told = self.intake.diagnostics
        if told is not self._told:
            self._told = told
            latency = self.latency.summary()
            extra = {"counters": self.intake.counters, "query_us": {"p50": latency["p50_us"], "p99": latency["p99_us"]}}
            self._diagnostics.put(json.dumps({**told, **extra}, default=_plain))
        if now_s - self._status_at >= STATUS_PERIOD_S:
            self._status_at = now_s
            self.intake.want_diagnostics = _is_followed(self._diagnostics)
            self._status.put(json.dumps(self.status(), default=_plain))
        self._publish_events()

    def status(self) -> dict[str, Any]:
        """The status as it is published."""
        age_s = None if self._sample_at is None else time.monotonic() - self._sample_at
        return axis_status(self.keys, self.instance, self.axis, self.intake, self.latency, age_s)

    def _publish_events(self) -> None:
        # Nothing to tell them by where declaring failed on the way.
        for event in self.axis.take_events() if self._entities else ():
            self._event.put(json.dumps({**event, "instance": self.instance, "time_unix_s": time.time()}))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        try:
            batch = decode_samples(sample.payload.to_bytes())
        except Exception as error:
            self.intake.malformed += 1
            if self.intake.malformed == 1:
                self.axis.note("malformed_samples", f"{error}; later ones are only counted")
            return
        self._sample_at = time.monotonic()
        self.intake.offer(batch)

    def _feedforward(self, query: zenoh.Query) -> bytes:
        if query.payload is None:
            raise FieldError("payload", "none", "a feedforward query")
        return encode_reply(self.axis.answer(decode_query(query.payload.to_bytes())))

    def _model_reply(self, query: zenoh.Query) -> bytes:
        return self._encoded(str(query.parameters.get("name") or self.axis.config.served))

    def _status_reply(self, query: zenoh.Query) -> bytes:
        return json.dumps(self.status(), default=_plain).encode()

    def _encoded(self, name: str) -> bytes:
        model, seq, memory = self.axis.model(name)
        return encode_model(name, model, seq, memory)

    def _guarded(
        self, key: str, answer: Callable[[zenoh.Query], bytes], meter: LatencyMeter | None = None
    ) -> Callable[[zenoh.Query], None]:
        def callback(query: zenoh.Query) -> None:
            start = time.perf_counter()
            failed = False
            # Leaving the context finishes the query; without that the caller waits until its time is over.
            with query:
                try:
                    query.reply(key, answer(query))
                except Exception as error:
                    failed = True
                    if not isinstance(error, DehystError):
                        self.axis.note("internal_error", f"{key}: {type(error).__name__}: {error}")
                    query.reply_err(error_to_json(error), encoding=JSON)
            if meter is not None:
                meter.add(time.perf_counter() - start, failed)

        return callback


def _plain(value: Any) -> Any:
    """numpy's numbers and arrays for JSON."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _is_followed(publisher: Any) -> bool:
    """Whether anybody subscribes to what ``publisher`` puts."""
    status = publisher.matching_status
    # An object that is always true in this release, a plain truth value by its own type stub.
    return bool(getattr(status, "matching", status))
