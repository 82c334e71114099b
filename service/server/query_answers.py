"""Answers the queries to one axis: voltages, model, status, and its state for a standby."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import zenoh

from dehyst.adaptive.errors import DehystError
from dehyst.service.answers.slices import Pace
from dehyst.service.protocol.container import JSON, to_json
from dehyst.service.protocol.errors import BusyError, FieldError, ServiceError, error_to_json
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.model import encode_model
from dehyst.service.protocol.query import Trajectory, decode_query, encode_reply, points_of
from dehyst.service.protocol.samples import MAX_COUNT
from dehyst.service.security.authenticator import NO_KEY, Authenticator
from dehyst.service.server.axis import Axis
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.server.long_queries import SHORT, LongQueries
from dehyst.service.storage.checkpoint import CheckpointKeeper, encode_checkpoint

# --- How long the service took over its queries: the last thousand, and counts since the start.

_KEPT: Final = 1024


class LatencyMeter:
    """Keeps the last durations of short queries, and counts all; any thread may add and read."""

    def __init__(self) -> None:
        self._us = np.zeros(_KEPT)
        self._lock = threading.Lock()
        self._short = 0
        self.count = 0
        self.errors = 0
        self.busy = 0

    def add(self, duration_s: float | None = None, failed: bool = False, busy: bool = False) -> None:
        """Count one query. A short one took ``duration_s`` in the service, wire not included.

        ``busy`` : refused, because others asked for too much, which is no error.
        """
        with self._lock:
            if duration_s is not None:
                self._us[self._short % _KEPT] = duration_s * 1e6
                self._short += 1
            self.count += 1
            self.errors += failed
            self.busy += busy

    def summary(self) -> dict[str, float | int | None]:
        """``count``, ``errors``, ``busy``, and of the last thousand short ones ``p50_us`` and ``p99_us`` or null."""
        known = self._us[: min(self._short, _KEPT)].copy()
        p50, p99 = np.percentile(known, (50, 99)).tolist() if known.size else (None, None)
        return {
            "count": self.count,
            "errors": self.errors,
            "busy": self.busy,
            "p50_us": None if p50 is None else round(p50, 1),
            "p99_us": None if p99 is None else round(p99, 1),
        }


# --- Answers.

#: Longest payload that is read in the thread that receives it, bytes, and the fewest bytes of a point.
_COPIED_BYTES: Final = 65_536
_POINT_BYTES: Final = 16
#: Longest time from the routing of a sample to others until it is in the queue of this instance, s.
_ROUTING_S: Final = 0.02
#: States that are copied at the same time at most.
_MOST_STATES: Final = 4


class QueryAnswers:
    """Every query gets a reply: an exception becomes an error reply, because a callback that raises sends none.

    Parameters
    ----------
    long_queries : answers the feedforward queries that are not short.
    latency : measures every short one. status : makes the status.
    authenticator : signs the answers, and decides who gets the state.
    deltas : the models whose changes are published.

    Attributes
    ----------
    states_refused : queries for the state that are not signed by an instance of this service.
    """

    def __init__(
        self,
        keys: Keys,
        axis: Axis,
        checkpoints: CheckpointKeeper,
        latency: LatencyMeter,
        status: Callable[[], dict[str, Any]],
        long_queries: LongQueries,
        authenticator: Authenticator = NO_KEY,
        deltas: DeltaStreams | None = None,
    ) -> None:
        self._deltas = deltas
        self._keys = keys
        self._axis = axis
        self._checkpoints = checkpoints
        self._latency = latency
        self._status = status
        self._long = long_queries
        self._by = authenticator
        self.states_refused = 0
        self._copies = threading.BoundedSemaphore(_MOST_STATES)

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Answer from now on; returns what is to be undeclared."""
        keys = self._keys
        return [
            session.declare_queryable(keys.feedforward, self._on_feedforward),
            session.declare_queryable(keys.model, self._guarded(keys.model, self._model_reply, ("name", "changes"))),
            session.declare_queryable(keys.status, self._guarded(keys.status, self._status_reply)),
            session.declare_queryable(keys.state, self._on_state),
        ]

    def encoded(self, name: str) -> bytes:
        """The payload of the model called ``name``."""
        model, seq, memory = self._axis.model(name)
        return encode_model(name, model, seq, memory, self._axis.safety(name))

    def _on_feedforward(self, query: zenoh.Query) -> None:
        """Answer a short query at once, and hand on a long one."""
        start = time.perf_counter()
        self._long.short_begins()
        try:
            check_parameters(query.parameters)
            payload = query.payload
            if payload is None:
                raise FieldError("payload", "none", "a feedforward query")
            size = len(payload)
            # Copying a megabyte takes as long as answering ten points: the other thread does it.
            data = payload.to_bytes() if size <= _COPIED_BYTES else None
            points = min(size // _POINT_BYTES, MAX_COUNT) if data is None else points_of(data)
            if points > SHORT:
                self._hand_on(query, data, points)
                return
            assert data is not None
            reply = encode_reply(self._answer(query, data))
            # Leaving the context finishes the query; otherwise the caller waits until its time is over.
            key = self._keys.feedforward
            with query:
                query.reply(key, reply, attachment=self._by.answered(query, key, reply, asked=data))
            self._latency.add(time.perf_counter() - start)
        except BusyError as error:
            self._latency.add(busy=True)
            self._refuse(query, error)
        except Exception as error:
            self._latency.add(time.perf_counter() - start, failed=True)
            self._refuse(query, error)
        finally:
            self._long.short_ends()

    def _answer(self, query: zenoh.Query, data: bytes, pace: Pace | None = None) -> Trajectory:
        asked = decode_query(data)
        # Anybody may ask; who says what was commanded has to show the key.
        commands = asked.pending is not None and self._by.is_asked_by_ours(query, self._keys.feedforward)
        return self._axis.answer(asked, pace, commands)

    def _hand_on(self, query: zenoh.Query, data: bytes | None, points: int) -> None:
        """Answer in another thread. Raises BusyError if others ask for too much."""
        key = self._keys.feedforward

        def refuse(error: BaseException) -> None:
            self._latency.add(failed=True)
            self._refuse(query, error)

        def send(reply: bytes) -> None:
            try:
                with query:
                    query.reply(key, reply, attachment=self._by.answered(query, key, reply))
                self._latency.add()
            except Exception as error:
                refuse(error)

        def work(pace: Pace) -> Callable[[], None]:
            try:
                payload = query.payload
                assert payload is not None
                asked = payload.to_bytes() if data is None else data
                return partial(send, encode_reply(self._answer(query, asked, pace)))
            except Exception as error:
                return partial(refuse, error)

        self._long.offer(source_of(query), points, work, refuse)

    def _refuse(self, query: zenoh.Query, error: BaseException) -> None:
        """Reply with an error; nothing where the caller is gone or an answer was sent."""
        if not isinstance(error, DehystError | zenoh.ZError):
            self._axis.note("internal_error", f"{query.key_expr}: {type(error).__name__}: {error}")
        with contextlib.suppress(zenoh.ZError), query:
            query.reply_err(error_to_json(error), encoding=JSON)

    def _model_reply(self, query: zenoh.Query) -> bytes:
        name = str(query.parameters.get("name") or self._axis.served)
        followed = None
        if self._deltas is not None and query.parameters.get("changes"):
            followed = self._deltas.payload(name)  # the model that the next change changes
        return followed or self.encoded(name)

    def _status_reply(self, query: zenoh.Query) -> bytes:
        return to_json(self._status())

    def _on_state(self, query: zenoh.Query) -> None:
        """Reply with the state, from a thread of its own: the copy waits for the learner, and a callback must not."""
        try:
            check_parameters(query.parameters)
            # Check the signature first: strangers must neither take the places of instances nor cost a thread each.
            if not self._by.is_asked_by_ours(query, self._keys.state):
                self.states_refused += 1
                raise ServiceError("the state is for instances of this service: sign the query, each time anew")
            if not self._copies.acquire(blocking=False):
                raise ServiceError(f"{_MOST_STATES} states are being copied: ask again later")
            threading.Thread(
                target=self._send_state, args=(query,), name=f"state-{self._keys.axis}", daemon=True
            ).start()
        except Exception as error:
            self._refuse(query, error)

    def _send_state(self, query: zenoh.Query) -> None:
        try:
            # The asking standby gets samples from its connection on: the state must contain all that came before.
            time.sleep(_ROUTING_S)
            key, state = self._keys.state, b"".join(encode_checkpoint(*self._checkpoints.state()))
            with query:
                query.reply(key, state, attachment=self._by.answered(query, key, state))
        except Exception as error:
            self._refuse(query, error)
        finally:
            self._copies.release()

    def _guarded(
        self, key: str, answer: Callable[[zenoh.Query], bytes], parameters: tuple[str, ...] = ()
    ) -> Callable[[zenoh.Query], None]:
        def note(error: Exception) -> None:
            if not isinstance(error, DehystError):
                self._axis.note("internal_error", f"{key}: {type(error).__name__}: {error}")

        return guarded(key, answer, note, parameters, self._by)


def guarded(
    key: str,
    answer: Callable[[zenoh.Query], bytes],
    failed: Callable[[Exception], None],
    parameters: tuple[str, ...] = (),
    authenticator: Authenticator = NO_KEY,
) -> Callable[[zenoh.Query], None]:
    """A callback that replies to each query and never raises: what ``answer`` raises goes to ``failed`` and the reply.

    ``parameters`` : those that its selector may have. ``authenticator`` : signs the reply.
    """

    def callback(query: zenoh.Query) -> None:
        # Leaving the context finishes the query; otherwise the caller waits until its time is over.
        with query:
            try:
                check_parameters(query.parameters, *parameters)
                stamp = authenticator.stamp()
                reply = answer(query)
                query.reply(key, reply, attachment=authenticator.answered(query, key, reply, stamp))
            except Exception as error:
                failed(error)
                query.reply_err(error_to_json(error), encoding=JSON)

    return callback


def check_parameters(parameters: zenoh.Parameters, *known: str) -> None:
    """Raise InputError on a parameter of a selector that is not ``known``; zenoh's own begin with ``_``."""
    if parameters.is_empty():
        return
    for pair in str(parameters).split(";"):
        name = pair.partition("=")[0]
        if name and not name.startswith("_") and name not in known:
            expected = f"no parameter but {', '.join(known)}" if known else "no parameter"
            raise FieldError("parameter", repr(name)[:80], expected, "check its spelling")


def source_of(query: zenoh.Query) -> str:
    """The session that asks, where the query tells it; else ""."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)
