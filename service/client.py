"""The client: voltages from a running service by one call, or by a model that is followed into this process.

    with Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x") as client:
        u_V = client.point(y_um=40.0).u_V
        answer = client.trajectory(y_um)          # (n,) points, one sample time apart
        more = client.trajectory(next_y_um, after=answer)

Queries change nothing in the service: after an error any of them may be repeated.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from adaptive.types import FloatArray
from service.errors import BehindError, FieldError, NoReplyError, ReplyTimeoutError, error_from_json
from service.follower import Follower
from service.guard import Limits
from service.keys import Keys
from service.motion import derivatives
from service.session import DEFAULT_ENDPOINT, open_client
from service.wire import check_seq, encode_command, encode_reference
from service.wire_query import NEWEST, FeedforwardReply, decode_reply, encode_query

_BEHIND_PAUSE_S: Final = 0.001
#: A session is open before it has heard what is declared at its other end; until then queries get no reply, s.
_SETTLE_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Trajectory:
    """The answer to a trajectory.

    Attributes
    ----------
    u_V, std_V : (n,) voltage and its standard deviation, V.
    flags : (n,) bits, see :func:`service.wire_query.flag_names`.
    memory : (m,) hysteresis memory after the last point. model : that answered. snapshot_seq : the last sample it
    had seen. fallback : whether a stand-in answered for some points. tracked_memory : whether the memory was the
    service's own.
    """

    u_V: FloatArray
    std_V: FloatArray
    flags: NDArray[np.uint8]
    memory: FloatArray
    model: str
    snapshot_seq: int
    fallback: bool
    tracked_memory: bool


@dataclass(frozen=True, slots=True)
class Point:
    """The answer to one point; as :class:`Trajectory`, with ``u_V``, ``std_V`` and ``flags`` as numbers."""

    u_V: float
    std_V: float
    flags: int
    memory: FloatArray
    model: str
    snapshot_seq: int
    fallback: bool
    tracked_memory: bool


class Client:
    """A connection to one axis of a service; use as a context manager, or call :meth:`close`.

    All methods raise NoReplyError (nobody there), ReplyTimeoutError, RefusedError (the service's own words) and
    InputError (not even sent). Not for use from several threads at once.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, timeout_s: float = 1.0, owns_session: bool = False) -> None:
        self.keys = keys
        self.timeout_s = timeout_s
        self._session = session
        self._owns = owns_session
        self._followers: list[Follower] = []
        self._querier = session.declare_querier(keys.feedforward, timeout=timeout_s, express=True)
        self._status: dict[str, Any] | None = None

    @classmethod
    def connect(
        cls,
        endpoint: str = DEFAULT_ENDPOINT,
        stage: str = "demo",
        axis: str = "x",
        timeout_s: float = 1.0,
        wait_s: float = 0.0,
        zenoh_config: Path | None = None,
    ) -> Client:
        """Connect to the service at ``endpoint`` and make sure that it serves this axis.

        ``timeout_s`` is for each query; ``wait_s`` is how long to wait for the service to come up. ``zenoh_config`` is
        a file of zenoh's own for TLS and passwords. Raises SessionError where nobody listens, NoReplyError where
        the axis is not served there.
        """
        keys = Keys(stage, axis)
        until = time.monotonic() + max(wait_s, _SETTLE_S)
        session = open_client(endpoint, wait_s, zenoh_config)
        try:
            client = cls(session, keys, timeout_s, owns_session=True)
            while True:
                try:
                    client.status()
                    return client
                except NoReplyError:
                    if time.monotonic() >= until:
                        raise
                    time.sleep(0.05)
        except BaseException:
            session.close()  # type: ignore[no-untyped-call]
            raise

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Undeclare, and close the session if this client opened it."""
        for follower in self._followers:
            follower.close()
        self._followers = []
        self._querier.undeclare()  # type: ignore[no-untyped-call]
        if self._owns:
            self._session.close()  # type: ignore[no-untyped-call]

    @property
    def dt_s(self) -> float:
        """Sample time of the axis, s: the distance of a trajectory's points."""
        return float(self._known()["dt_s"])

    @property
    def limits(self) -> Limits:
        """The limits that the service enforces."""
        return Limits.from_json(self._known()["limits"])

    def status(self) -> dict[str, Any]:
        """The status of the axis as the service tells it now (docs/protocol.md)."""
        status = json.loads(self._one(self._session.get(self.keys.status, timeout=self.timeout_s)))
        if not isinstance(status, dict) or "dt_s" not in status:
            raise FieldError("status", repr(status)[:80], "a status of this wire version")
        self._status = status
        return status

    def point(
        self,
        y_um: float,
        v_um_per_s: float = 0.0,
        a_um_per_s2: float = 0.0,
        *,
        memory: ArrayLike | None = None,
        model: str = "",
        as_of: int = NEWEST,
        u_before_V: float = math.nan,
        after: Point | Trajectory | None = None,
        wait_s: float = 0.0,
    ) -> Point:
        """The voltage for one point. Arguments as in :meth:`trajectory`."""
        query = _continued(memory, model, u_before_V, after)
        reply = self._ask(lambda: encode_query(y_um, v_um_per_s, a_um_per_s2, as_of=as_of, **query), wait_s)
        return Point(
            float(reply.u_V[0]),
            float(reply.std_V[0]),
            int(reply.flags[0]),
            reply.memory,
            reply.model,
            reply.snapshot_seq,
            reply.fallback,
            reply.tracked_memory,
        )

    def trajectory(
        self,
        y_um: ArrayLike,
        v_um_per_s: ArrayLike | None = None,
        a_um_per_s2: ArrayLike | None = None,
        *,
        memory: ArrayLike | None = None,
        model: str = "",
        as_of: int = NEWEST,
        u_before_V: float = math.nan,
        after: Point | Trajectory | None = None,
        wait_s: float = 0.0,
    ) -> Trajectory:
        """Voltages for n desired points, ``dt_s`` apart.

        Main arguments
        --------------
        y_um : (n,) desired displacement, µm.
        v_um_per_s, a_um_per_s2 : (n,) its velocity and acceleration at the same instants. What is not given is taken
            by central differences, which costs accuracy at the ends of a block: give what the planner knows.

        Other arguments
        ---------------
        after : the answer before this one; brings back its memory and its last voltage.
        memory, u_before_V : the same by hand. Without any, the service begins with what it tracks from the samples.
        model : name of the model to ask, "" for the service's default.
        as_of : answer from the newest snapshot that has seen no sample after this number.
        wait_s : with ``as_of``, how long to wait until the service has learnt that far, s; BehindError after that.
        """
        y = np.atleast_1d(np.asarray(y_um, dtype=np.float64))
        v, a = derivatives(y, v_um_per_s, a_um_per_s2, self.dt_s)
        query = _continued(memory, model, u_before_V, after)
        reply = self._ask(lambda: encode_query(y, v, a, as_of=as_of, **query), wait_s)
        return Trajectory(
            reply.u_V,
            reply.std_V,
            reply.flags,
            reply.memory,
            reply.model,
            reply.snapshot_seq,
            reply.fallback,
            reply.tracked_memory,
        )

    def follow(self, model: str = "", memory: ArrayLike | None = None) -> Follower:
        """Follow the model into this process; see :class:`service.follower.Follower`. Closed with this client.

        Only the model that learns is published as it changes; any other is fetched once, which is all there is to it.
        """
        status = self._known()
        name = model or str(status["served"])

        def fetch() -> bytes:
            # The selector's own syntax keeps the name from being taken for something else: names are plain chunks.
            return self._one(self._session.get(f"{self.keys.model}?name={name}", timeout=self.timeout_s))

        learns = name == status.get("learning")
        follower = Follower(self._session, self.keys.model if learns else None, name, fetch, self.limits, memory)
        self._followers.append(follower)
        return follower

    def command(self, seq: int, u_V: ArrayLike) -> None:
        """Publish voltages, (n,) V, for the stage's samples ``seq``, ``seq + 1``, …"""
        self._session.put(self.keys.command, encode_command(check_seq("seq", seq), u_V), express=True)

    def reference(self, seq: int, y_um: ArrayLike) -> None:
        """Publish what is wanted, (n,) µm, at the stage's samples ``seq``, ``seq + 1``, …; for diagnostics only."""
        self._session.put(self.keys.reference, encode_reference(check_seq("seq", seq), y_um))

    def _known(self) -> dict[str, Any]:
        return self._status or self.status()

    def _ask(self, encode: Callable[[], bytes], wait_s: float) -> FeedforwardReply:
        payload = encode()
        until = time.monotonic() + wait_s
        while True:
            reply = decode_reply(self._one(self._querier.get(payload=payload)))
            if not reply.behind:
                return reply
            if time.monotonic() >= until:
                raise BehindError(
                    f"{self.keys.feedforward}: the service has learnt up to sample {reply.snapshot_seq} only; "
                    "ask for an earlier as_of, allow more wait_s, or see in the status whether samples arrive"
                )
            time.sleep(_BEHIND_PAUSE_S)

    def _one(self, replies: Any) -> bytes:
        """The payload of the one reply that is to come, or the exception that says why there is none."""
        error: bytes | None = None
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            error = bytes(reply.err.payload.to_bytes())
        if error is None:
            raise NoReplyError(
                f"{self.keys.base}: nobody answers; does a service with this stage and axis run, and may you ask it?"
            )
        failure = error_from_json(error)
        if isinstance(failure, ReplyTimeoutError):
            raise ReplyTimeoutError(f"{self.keys.base}: no answer within {self.timeout_s:g} s; ask again")
        raise failure


def _continued(
    memory: ArrayLike | None, model: str, u_before_V: float, after: Point | Trajectory | None
) -> dict[str, Any]:
    if after is not None:
        memory = after.memory if memory is None else memory
        model = model or after.model
        if math.isnan(u_before_V):
            u_before_V = float(np.atleast_1d(after.u_V)[-1])
    return {"memory": memory, "model": model, "u_before_V": u_before_V}
