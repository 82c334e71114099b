"""The client: voltages from a running service by one call, or by a model that is followed into this process.

    with Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x") as client:
        u_V = client.point(y_um=40.0).u_V
        answer = client.trajectory(y_um)          # (n,) points, one sample time apart
        more = client.trajectory(next_y_um, after=answer)

Queries change nothing in the service: after an error any of them may be repeated, and what gets no answer is, for a
while, by the client itself. Given the endpoints of a service and of its standby it goes on with the one that is left.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from service.answers.guard import Limits, guard
from service.answers.motion import derivatives
from service.client.answers import Point, Trajectory, as_point, as_trajectory, continued, extended
from service.client.asking import RETRY_S, Asking
from service.client.follower import Follower
from service.protocol.errors import NoReplyError
from service.protocol.keys import AUTO, Keys
from service.protocol.query import NEWEST, encode_query
from service.protocol.samples import check_finite, check_seq, column, encode_command, encode_reference
from service.runtime.delivery import SURELY
from service.runtime.session import DEFAULT_ENDPOINT, open_client

#: A session is open before it has heard what is declared at its other end; until then queries get no reply, s.
_SETTLE_S: Final = 0.5


__all__ = ["Client", "Point", "Trajectory"]


class Client:
    """A connection to one axis of a service; use as a context manager, or call :meth:`close`.

    All methods raise NoReplyError (nobody there), ReplyTimeoutError, RefusedError (the service's own words) and
    InputError (not even sent). Not for use from several threads at once.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        timeout_s: float = 1.0,
        owns_session: bool = False,
        retry_s: float = RETRY_S,
    ) -> None:
        self.keys = keys
        self._commanded = (-1, math.nan)
        self._session = session
        self._owns = owns_session
        self._followers: list[Follower] = []
        self._asking = Asking(session, keys, timeout_s, retry_s)
        self._status: dict[str, Any] | None = None

    @classmethod
    def connect(
        cls,
        endpoint: str | Sequence[str] = DEFAULT_ENDPOINT,
        stage: str = "demo",
        axis: str = "x",
        timeout_s: float = 1.0,
        wait_s: float = 0.0,
        zenoh_config: Path | None = None,
        retry_s: float = RETRY_S,
    ) -> Client:
        """Connect to the service at ``endpoint``, or to one of several, and make sure that it serves this axis.

        ``timeout_s`` is for each query; ``retry_s`` is how long one that gets no answer is repeated; ``wait_s`` is how
        long to wait for the service to come up. ``zenoh_config`` is a file of zenoh's own for TLS and passwords. Raises
        SessionError where nobody listens, NoReplyError where the axis is not served there.
        """
        keys = Keys(stage, axis)
        until = time.monotonic() + max(wait_s, _SETTLE_S)
        session = open_client(endpoint, wait_s, zenoh_config)
        try:
            client = cls(session, keys, timeout_s, owns_session=True, retry_s=retry_s)
            while True:
                try:
                    client._status = client._asking.status(once=True)
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
        self._asking.close()
        if self._owns:
            self._session.close()  # type: ignore[no-untyped-call]

    @property
    def retries(self) -> int:
        """Queries that were repeated because there was no answer."""
        return self._asking.retries

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
        self._status = self._asking.status()
        return self._status

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
        begin: int | None = None,
        wait_s: float = 0.0,
    ) -> Point:
        """The voltage for one point. Arguments as in :meth:`trajectory`."""
        query = continued(memory, model, u_before_V, after, begin)
        reply = self._asking.feedforward(encode_query(y_um, v_um_per_s, a_um_per_s2, as_of=as_of, **query), wait_s)
        if begin is None:
            return as_point(reply)
        return as_point(reply, extended(query["pending"], begin, np.array([y_um]), reply.u_V))

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
        begin: int | None = None,
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
        begin : the stage's number of the sample at which the first point is due, for whoever commands the answers. The
            hysteresis memory is then what the service tracks from the samples, carried along what ``after`` left under
            way: where the stage has not gone where it was sent, the next answer knows. An answer may begin before the
            end of the one before, which it then replaces from there on.
        memory, u_before_V : the same by hand. Without any, the service begins with what it tracks from the samples.
        model : name of the model to ask, "" for the service's default.
        as_of : answer from the newest snapshot that has seen no sample after this number.
        wait_s : with ``as_of``, how long to wait until the service has learnt that far, s; BehindError after that.
        """
        y = np.atleast_1d(np.asarray(y_um, dtype=np.float64))
        v, a = derivatives(y, v_um_per_s, a_um_per_s2, self.dt_s)
        query = continued(memory, model, u_before_V, after, begin)
        reply = self._asking.feedforward(encode_query(y, v, a, as_of=as_of, **query), wait_s)
        return as_trajectory(reply, None if begin is None else extended(query["pending"], begin, y, reply.u_V))

    def follow(self, model: str = "", memory: ArrayLike | None = None) -> Follower:
        """Follow the model into this process; see :class:`service.client.follower.Follower`. Closed with this client.

        Only the model that learns and "auto" are published as they change; any other is fetched once, which is all
        there is to it. "auto" carries every model that competes; the one that learns is quicker to evaluate alone.
        """
        status = self._known()
        name = model or str(status["served"])

        def fetch() -> bytes:
            # The selector's own syntax keeps the name from being taken for something else: names are plain chunks.
            return self._asking.get(f"{self.keys.model}?name={name}")

        key = {str(status.get("learning")): self.keys.model, AUTO: self.keys.champion}.get(name)
        follower = Follower(self._session, key, name, fetch, self.limits, memory)
        self._followers.append(follower)
        return follower

    def command(self, seq: int, u_V: ArrayLike) -> NDArray[np.uint8]:
        """Publish voltages, (n,) V, for the stage's samples ``seq``, ``seq + 1``, …; returns (n,) flags.

        What leaves is within the limits of the axis and, from the command before on, within its slew limit; flags say
        where that changed a voltage. Raises InputError on what is not finite.
        """
        wanted = column("u_V", u_V)
        check_finite("u_V", wanted)
        following, before = self._commanded
        limits, gap = self.limits, check_seq("seq", seq) - following
        if following < 0 or gap < 0:
            before = math.nan  # the first, or one that is to replace others
        elif gap:
            # Over samples for which nothing was commanded the stage has held the last one; it had as long to move.
            reach = gap * limits.slew_V_per_s * self.dt_s
            before = min(max(float(wanted[0]), before - reach), before + reach)
        safe, flags = guard(wanted, np.ones(wanted.size, dtype=np.bool_), self.dt_s, limits, before)
        self._session.put(self.keys.command, encode_command(seq, safe), express=True, congestion_control=SURELY)
        self._commanded = (seq + safe.size, float(safe[-1]))
        return flags

    def reference(self, seq: int, y_um: ArrayLike) -> None:
        """Publish what is wanted, (n,) µm, at the stage's samples ``seq``, ``seq + 1``, …; for diagnostics only."""
        payload = encode_reference(check_seq("seq", seq), y_um)
        self._session.put(self.keys.reference, payload, congestion_control=SURELY)

    def _known(self) -> dict[str, Any]:
        return self._status or self.status()
