"""The answers of one axis to queries: voltages, model, status, and its state for a standby."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from adaptive.errors import DehystError
from service.answers.latency import LatencyMeter
from service.failover.state_transfer import send_state
from service.protocol.errors import FieldError, error_to_json
from service.protocol.keys import Keys
from service.protocol.model import encode_model
from service.protocol.query import decode_query
from service.protocol.reply import encode_reply
from service.server.axis import Axis
from service.storage.checkpoint import encode_checkpoint
from service.storage.checkpoint_keeper import Keeper

JSON: Final = "application/json"
#: Longest time that a sample takes from being passed on to others to the queue of this instance, s.
_PASSED_ON_S: Final = 0.02


class Answers:
    """Every callback answers: an exception on the way to an answer becomes an error reply, because a callback that
    raises leaves its caller without any.

    Parameters
    ----------
    latency : takes the time of every feedforward query. status : as it is published.
    """

    def __init__(
        self, keys: Keys, axis: Axis, keeper: Keeper, latency: LatencyMeter, status: Callable[[], dict[str, Any]]
    ) -> None:
        self._keys = keys
        self._axis = axis
        self._keeper = keeper
        self._latency = latency
        self._status = status

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Answer from now on; what is to be undeclared."""
        keys = self._keys
        return [
            session.declare_queryable(
                keys.feedforward, self._guarded(keys.feedforward, self._feedforward, self._latency)
            ),
            session.declare_queryable(keys.model, self._guarded(keys.model, self._model_reply)),
            session.declare_queryable(keys.status, self._guarded(keys.status, self._status_reply)),
            session.declare_queryable(keys.state, self._on_state),
        ]

    def _feedforward(self, query: zenoh.Query) -> bytes:
        if query.payload is None:
            raise FieldError("payload", "none", "a feedforward query")
        return encode_reply(self._axis.answer(decode_query(query.payload.to_bytes())))

    def _model_reply(self, query: zenoh.Query) -> bytes:
        return self.encoded(str(query.parameters.get("name") or self._axis.served))

    def _status_reply(self, query: zenoh.Query) -> bytes:
        return json.dumps(self._status(), default=plain).encode()

    def _on_state(self, query: zenoh.Query) -> None:
        """Answered from a thread of its own: the copy waits for the learner, and the wire must not."""

        def reply() -> None:
            # A sample that was passed on before whoever asks was known must be among those that the state has seen.
            time.sleep(_PASSED_ON_S)
            with query:
                try:
                    send_state(query, self._keys.state, encode_checkpoint(*self._keeper.state()))
                except Exception as error:
                    query.reply_err(error_to_json(error), encoding=JSON)

        threading.Thread(target=reply, name="state", daemon=True).start()

    def encoded(self, name: str) -> bytes:
        """The payload of the model called ``name``."""
        model, seq, memory = self._axis.model(name)
        return encode_model(name, model, seq, memory, self._axis.safety(name))

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
                        self._axis.note("internal_error", f"{key}: {type(error).__name__}: {error}")
                    query.reply_err(error_to_json(error), encoding=JSON)
            if meter is not None:
                meter.add(time.perf_counter() - start, failed)

        return callback


def plain(value: Any) -> Any:
    """numpy's numbers and arrays for JSON."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
