"""Answers the queries to one axis: voltages, model, status, and its state for a standby."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import zenoh

from adaptive.errors import DehystError
from service.failover.state_transfer import NO_SECRET, UnprovenError, send_sign_of_life, send_state
from service.protocol.container import JSON, to_json
from service.protocol.errors import FieldError, ServiceError, error_to_json
from service.protocol.keys import Keys
from service.protocol.model import encode_model
from service.protocol.query import decode_query, encode_reply
from service.security.peers import PeerSecret
from service.server.axis import Axis
from service.storage.checkpoint import CheckpointKeeper, encode_checkpoint

# --- How long the service took over its queries: the last thousand, and counts since the start.

_KEPT: Final = 1024


class LatencyMeter:
    """Keeps the last durations; one thread adds, others may read."""

    def __init__(self) -> None:
        self._us = np.zeros(_KEPT)
        self.count = 0
        self.errors = 0

    def add(self, duration_s: float, failed: bool = False) -> None:
        """Count one query that took ``duration_s`` in the service, wire not included."""
        self._us[self.count % _KEPT] = duration_s * 1e6
        self.count += 1
        self.errors += failed

    def summary(self) -> dict[str, float | int | None]:
        """``count``, ``errors``, and of the last thousand ``p50_us`` and ``p99_us``; null before the first."""
        known = self._us[: min(self.count, _KEPT)].copy()
        p50, p99 = np.percentile(known, (50, 99)).tolist() if known.size else (None, None)
        return {
            "count": self.count,
            "errors": self.errors,
            "p50_us": None if p50 is None else round(p50, 1),
            "p99_us": None if p99 is None else round(p99, 1),
        }


# --- Answers.

#: Longest time from the routing of a sample to others until it is in the queue of this instance, s.
_ROUTING_S: Final = 0.02
#: States that are sent at the same time at most.
_MOST_STATES: Final = 4


class QueryAnswers:
    """Every query gets a reply: an exception becomes an error reply, because a callback that raises sends none.

    Parameters
    ----------
    latency : takes the time of every feedforward query. status : makes the status.
    instance, secret : of this process, for other instances that ask for its state or for a sign of life.
    """

    def __init__(
        self,
        keys: Keys,
        axis: Axis,
        checkpoints: CheckpointKeeper,
        latency: LatencyMeter,
        status: Callable[[], dict[str, Any]],
        instance: str = "",
        secret: PeerSecret = NO_SECRET,
    ) -> None:
        self._keys = keys
        self._axis = axis
        self._checkpoints = checkpoints
        self._latency = latency
        self._status = status
        self._instance = instance
        self._secret = secret
        #: Queries for the state from somebody who did not prove to be an instance of this service.
        self.states_refused = 0
        self._sends = threading.BoundedSemaphore(_MOST_STATES)

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Answer from now on; returns what is to be undeclared."""
        keys = self._keys
        return [
            session.declare_queryable(
                keys.feedforward, self._guarded(keys.feedforward, self._feedforward, self._latency)
            ),
            session.declare_queryable(keys.model, self._guarded(keys.model, self._model_reply)),
            session.declare_queryable(keys.status, self._guarded(keys.status, self._status_reply)),
            session.declare_queryable(keys.state, self._on_state),
        ]

    def encoded(self, name: str) -> bytes:
        """The payload of the model called ``name``."""
        model, seq, memory = self._axis.model(name)
        return encode_model(name, model, seq, memory, self._axis.safety(name))

    def _feedforward(self, query: zenoh.Query) -> bytes:
        if query.payload is None:
            raise FieldError("payload", "none", "a feedforward query")
        return encode_reply(self._axis.answer(decode_query(query.payload.to_bytes())))

    def _model_reply(self, query: zenoh.Query) -> bytes:
        return self.encoded(str(query.parameters.get("name") or self._axis.served))

    def _status_reply(self, query: zenoh.Query) -> bytes:
        return to_json(self._status())

    def _on_state(self, query: zenoh.Query) -> None:
        """Reply from a thread of its own: the copy of the state waits for the learner, and a callback must not."""

        def reply() -> None:
            # The state must contain each sample that was routed before whoever asks was known.
            time.sleep(_ROUTING_S)
            with query:
                try:
                    send_state(query, self._keys.state, self._state_buffers(), self._secret)
                except Exception as error:
                    self.states_refused += isinstance(error, UnprovenError)
                    query.reply_err(error_to_json(error), encoding=JSON)
                finally:
                    self._sends.release()

        if send_sign_of_life(query, self._keys.state, self._instance, self._secret):
            return
        if not self._sends.acquire(blocking=False):
            query.reply_err(error_to_json(ServiceError(f"{_MOST_STATES} states are being sent: ask again later")))
            return
        threading.Thread(target=reply, name=f"state-{self._keys.axis}", daemon=True).start()

    def _state_buffers(self) -> Iterator[Any]:
        """The buffers of the present state, copied when the first one is asked for."""
        yield from encode_checkpoint(*self._checkpoints.state())

    def _guarded(
        self, key: str, answer: Callable[[zenoh.Query], bytes], meter: LatencyMeter | None = None
    ) -> Callable[[zenoh.Query], None]:
        def callback(query: zenoh.Query) -> None:
            start = time.perf_counter()
            failed = False
            # Leaving the context finishes the query; otherwise the caller waits until its time is over.
            with query:
                try:
                    query.reply(key, answer(query))
                except Exception as error:
                    failed = True
                    if not isinstance(error, DehystError):
                        self._axis.note("internal_error", f"{key}: {type(error).__name__}: {error}")
                    query.reply_err(error_to_json(error), encoding=JSON)
            if meter is not None:
                meter.add(time.perf_counter() - start, failed)

        return callback
