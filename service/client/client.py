"""Client of one axis: voltages by a query, or by a model that is followed into this process.

    with Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x") as client:
        u_V = client.point(y_um=40.0).u_V
        answer = client.trajectory(y_um)          # (n,) points, one sample time apart
        more = client.trajectory(next_y_um, after=answer)

Queries change nothing in the service: any of them can be repeated. The client repeats an unanswered query itself for
``retry_s``. With the endpoints of a service and of its standby it continues with the one that is alive. It takes the
first reply that carries the authenticator of the service (`service.security.authenticator`) and keeps the known limits;
others are passed over and counted, and the first one is logged.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.types import FloatArray
from dehyst.service.answers.answering import derivatives
from dehyst.service.answers.correcting import Correcting
from dehyst.service.answers.guard import Limits, guard, limit_voltage
from dehyst.service.client.follower import Follower
from dehyst.service.protocol.errors import (
    BehindError,
    BusyError,
    FieldError,
    NoReplyError,
    ReplyTimeoutError,
    ServiceError,
    UnsignedReplyError,
    error_from_json,
)
from dehyst.service.protocol.keys import AUTO, Keys
from dehyst.service.protocol.query import (
    MAX_PENDING,
    NEWEST,
    Answer,
    Pending,
    Point,
    Trajectory,
    decode_reply,
    encode_query,
)
from dehyst.service.protocol.samples import (
    check_finite,
    check_seq,
    column,
    encode_command,
    encode_reference,
    encode_samples,
    number,
    waiting_time,
)
from dehyst.service.runtime.session import DEFAULT_ENDPOINT, SURELY, open_client
from dehyst.service.security.authenticator import EVERYBODY, Authenticator, Heard, Question, Signed, own_authenticator
from dehyst.service.security.lease import CommandGate, CommandLease

# --- How a query continues from the answer before it: its memory, its last voltage, and what is under way.
#
# Under way are the samples that are commanded and not yet seen by the service.

#: Fewest samples under way that are kept. Only those after the newest snapshot matter, some tens of samples.
#: While no samples arrive, all since that snapshot are kept, up to MAX_PENDING, because the stage may have turned.
UNDER_WAY: Final = 512


def pending_before(after: Point | Trajectory | None, begin: int) -> Pending | None:
    """What is under way before sample ``begin``; None for nothing.

    It is what ``after`` left, without the samples from ``begin`` on. Between its end and ``begin`` nothing was
    commanded: the stage holds the last voltage there.
    """
    if after is None or after.pending is None or begin <= after.pending.first:
        return None
    first, y_um, u_V = after.pending
    wanted = begin - first
    if wanted >= y_um.size + UNDER_WAY:
        return None
    held = max(wanted - y_um.size, 0)
    y_um, u_V = np.pad(y_um, (0, held), "edge")[:wanted], np.pad(u_V, (0, held), "edge")[:wanted]
    kept = min(wanted, max(UNDER_WAY, min(begin - after.snapshot_seq, MAX_PENDING)))
    return Pending(begin - kept, y_um[-kept:], u_V[-kept:])


def with_pending(answer: Trajectory, before: Pending | None, begin: int, y_um: FloatArray) -> Trajectory:
    """``answer`` to (n,) ``y_um``, commanded from sample ``begin`` on, behind what is under way ``before`` it."""
    under = Pending(begin, y_um, answer.u_V)
    if before is not None:
        columns = (np.concatenate([one, more]) for one, more in zip(before[1:], under[1:], strict=True))
        under = Pending(before.first, *columns)
    return answer._replace(pending=under)


@dataclass(slots=True)
class PendingCommands:
    """The commands under way of a loop in one process, which asks as a client that gives ``begin``."""

    answer: Trajectory | None = None

    def before(self, begin: int) -> Pending | None:
        """What is under way before sample ``begin``."""
        return pending_before(self.answer, begin)

    def take(self, begin: int, y_um: FloatArray, answer: Trajectory) -> None:
        """Note that the (n,) voltages of ``answer`` to ``y_um``, µm, are commanded from sample ``begin`` on."""
        self.answer = with_pending(answer, self.before(begin), begin, y_um)


def continued(
    memory: ArrayLike | None, model: str, u_before_V: float, after: Point | Trajectory | None, begin: int | None = None
) -> dict[str, Any]:
    """Arguments ``memory``, ``model``, ``u_before_V`` (and ``pending``) of a query that continues from ``after``.

    Arguments that are given are kept. With ``begin``, the number of the first sample of the query, ``pending`` replaces
    the memory. Raises InputError if both ``memory`` and ``begin`` are given.
    """
    u_before_V = number("u_before_V", u_before_V)
    if not (after is None or isinstance(after, Answer)):
        raise FieldError("after", repr(after)[:80], "the answer to a point or a trajectory")
    if begin is not None:
        begin = check_seq("begin", begin)
        if memory is not None:
            raise FieldError("memory", "memory and begin", "one of the two: with begin the service tracks the memory")
        under = pending_before(after, begin)
        asked = continued(np.empty(0), model, u_before_V, after)
        # The answer may replace the end of the one before: then the last voltage under way is the one before it.
        before_V = float(under.u_V[-1]) if under is not None and math.isnan(u_before_V) else asked["u_before_V"]
        return asked | {"memory": None, "pending": under, "u_before_V": before_V}
    if after is not None:
        memory = after.memory if memory is None else memory
        model = model or after.model
        if math.isnan(u_before_V):
            u_before_V = after.u_V if isinstance(after.u_V, float) else float(after.u_V[-1])
    return {"memory": memory, "model": model, "u_before_V": u_before_V}


# --- Queries of a client: one reply each, an exception that states why there is none, and repetition without an answer.

_LOGGER: Final = logging.getLogger("dehyst.client")
_T = TypeVar("_T")
_BEHIND_PAUSE_S: Final = 0.001
#: Pause between two questions how far the service has learnt, s.
_LEARNT_PAUSE_S: Final = 0.01
#: Default time for which an unanswered query is repeated, s. A standby takes over within some hundredths of a second if
#: the service has died, within about a second if it has only stopped.
RETRY_S: Final = 2.0
_RETRY_PAUSE_S: Final = 0.003
#: Queries longer than this, bytes, are more than a hundred points, which are not answered at once.
_SHORT_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class Known:
    """What a client knows of its axis, from the status."""

    status: dict[str, Any]
    limits: Limits
    dt_s: float

    @classmethod
    def read(cls, payload: bytes, keys: Keys) -> Known:
        """Of a status of the axis of ``keys``. Raises FieldError."""
        status = json.loads(payload)
        if not isinstance(status, dict) or not {"dt_s", "limits"} <= status.keys():
            raise FieldError("status", repr(status)[:80], "a status of this wire version")
        names = status.get("stage"), status.get("axis")
        if names != (keys.stage, keys.axis):
            raise FieldError("status", f"that of {names}", f"that of {(keys.stage, keys.axis)}")
        dt_s = status["dt_s"]
        if not (isinstance(dt_s, float) and 0.0 < dt_s < math.inf):
            raise FieldError("dt_s", repr(dt_s)[:80], "a sample time in s")
        return cls(status, Limits.from_json(status["limits"]), dt_s)

    def check(self, answer: Trajectory, n: int, u_before_V: float) -> None:
        """Raise FieldError where ``answer`` is not ``n`` voltages that the limits leave as they are.

        ``u_before_V`` : voltage before the first, V; NaN: none.
        """
        u_V, limits = answer.u_V, self.limits
        if u_V.size != n:
            raise FieldError("u_V", f"{u_V.size} voltages", f"{n}, one for each point")
        if n == 1:  # as fast as it can be
            step_V = limits.slew_V_per_s * self.dt_s
            safe_V = np.array(limit_voltage(u_V.item(0), u_before_V, limits.u_min_V, limits.u_max_V, step_V)[:1])
        else:
            safe_V = guard(u_V, np.ones(n, dtype=np.bool_), self.dt_s, limits, u_before_V)[0]
        wrong = np.flatnonzero(safe_V != u_V)
        if wrong.size:
            i = int(wrong[0])
            before_V, most_V = u_V[i - 1] if i else u_before_V, limits.slew_V_per_s * self.dt_s
            raise FieldError(
                f"u_V[{i}]",
                f"{u_V[i]:g} V after {before_V:g} V",
                f"{limits.u_min_V:g} to {limits.u_max_V:g} V, in steps of at most {most_V:g} V",
            )


class RetryingQueries:
    """The queries of one client.

    Parameters
    ----------
    timeout_s : of each query, s. retry_s : time for which a query is repeated that is unanswered or refused as busy, s.

    Attributes
    ----------
    retries : count of repetitions. refused : replies that were passed over: without the right authenticator, malformed
    or beyond what is known. known : from the newest status; None before any. followers : get the limits of each status.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, timeout_s: float, retry_s: float, authenticator: Authenticator
    ) -> None:
        self.timeout_s, self.retry_s = timeout_s, retry_s
        self.retries = self.refused = 0
        self.known: Known | None = None
        self.followers: list[Follower] = []
        self._session, self._keys, self._by = session, keys, authenticator
        self._querier = session.declare_querier(keys.feedforward, timeout=timeout_s, express=True, **EVERYBODY)
        # Of low priority, so that a megabyte there and back delays no other message, and the service hands it over at
        # once: twice as fast, because its queue has room for it. The source gives this session its share.
        self._long = session.declare_querier(
            keys.feedforward,
            timeout=timeout_s,
            priority=zenoh.Priority.DATA_LOW,
            congestion_control=SURELY,
            **EVERYBODY,
        )
        self._source = zenoh.SourceInfo(self._long.id, 0)

    def close(self) -> None:
        """Undeclare the queriers."""
        self._querier.undeclare()  # type: ignore[no-untyped-call]
        self._long.undeclare()  # type: ignore[no-untyped-call]

    def get(self, key: str, parameters: str, read: Callable[[Signed], _T], once: bool = False) -> _T:
        """What ``read`` makes of the first right reply; repeated for ``retry_s`` while there is none, unless ``once``.

        Raises NoReplyError, ReplyTimeoutError, RefusedError, and what ``read`` raises of the only reply.
        """

        def ask() -> _T:
            question = self._by.question(parameters)
            replies = self._session.get(
                f"{key}?{parameters}" if parameters else key,
                timeout=self.timeout_s,
                attachment=question.attachment,
                **EVERYBODY,
            )
            return self._first(replies, question, read)

        return ask() if once else self._repeated(ask)

    def status(self, once: bool = False) -> dict[str, Any]:
        """The present status of the axis; ``once`` : without repetition."""
        return self._read_known(once).status

    def _read_known(self, once: bool) -> Known:
        keys = self._keys
        known = self.known = self.get(keys.status, "", lambda signed: Known.read(signed.payload, keys), once)
        for follower in self.followers:
            follower.limits = known.limits
        return known

    def feedforward(
        self, payload: bytes, wait_s: float, n: int, u_before_V: float, commands: bool = False
    ) -> Trajectory:
        """The answer to an encoded query for ``n`` points, which is repeated for ``retry_s`` while there is none.

        ``commands`` : whether it tells what is under way, which is believed where it is signed.
        ``u_before_V`` : the voltage before the first point that the query names, V; NaN: none.
        ``wait_s`` : longest time to wait, s, until the service has handled all samples that ``as_of`` covers. Raises
        BehindError after that.
        """

        def read(signed: Signed) -> Trajectory:
            answer = decode_reply(signed.payload)
            try:
                if self.known is not None:
                    self.known.check(answer, n, u_before_V)
            except FieldError:
                if not signed.stamp:
                    raise
                # It is the service: started again with other limits.
                self._read_known(once=True).check(answer, n, u_before_V)
            return answer

        def ask() -> Trajectory:
            question = self._by.question(payload=payload, key=self._keys.feedforward if commands else "")
            sent: dict[str, Any] = {"payload": payload, "attachment": question.attachment}
            if len(payload) <= _SHORT_BYTES:
                return self._first(self._querier.get(**sent), question, read)
            return self._first(self._long.get(**sent, source_info=self._source), question, read)

        start, wait_s = time.monotonic(), waiting_time("wait_s", wait_s)
        while True:
            answer = self._repeated(ask)
            if not answer.behind:
                return answer
            if time.monotonic() - start >= wait_s:
                raise BehindError(
                    f"{self._keys.feedforward}: the service has learnt up to sample {answer.snapshot_seq} only; "
                    "ask for an earlier as_of, allow more wait_s, or check in the status whether samples arrive"
                )
            time.sleep(_BEHIND_PAUSE_S)

    def _repeated(self, ask: Callable[[], _T]) -> _T:
        start = time.monotonic()
        while True:
            try:
                return ask()
            except (NoReplyError, ReplyTimeoutError):
                # The service may have died: a standby takes over, or the service restarts.
                if time.monotonic() - start >= self.retry_s:
                    raise
                self.retries += 1
                time.sleep(_RETRY_PAUSE_S)
            except BusyError as error:
                # It keeps a place for this query from then on.
                if time.monotonic() + error.retry_after_s - start >= self.retry_s:
                    raise
                self.retries += 1
                time.sleep(error.retry_after_s)

    def _first(self, replies: Iterable[zenoh.Reply], question: Question, read: Callable[[Signed], _T]) -> _T:
        """The first right reply. Anybody can send an error, so one counts only where there is no right reply."""
        failure: DehystError | None = None
        unsigned = 0
        for reply in replies:
            if reply.ok is None:
                if reply.err is not None and not isinstance(failure, ServiceError):
                    failure = error_from_json(reply.err.payload.to_bytes())
                continue
            signed = question.answer(reply.ok)
            try:
                if signed is not None:
                    return read(signed)
                unsigned += 1
                reason = "it carries no authenticator of the service"
            except (DehystError, ValueError) as error:
                reason = str(error)
                failure = failure or (error if isinstance(error, DehystError) else FieldError("reply", error, "JSON"))
            self._refuse(reason)
        raise self._failed(failure, unsigned)

    def _refuse(self, reason: str) -> None:
        if not self.refused:
            _LOGGER.warning("%s: a reply is passed over: %s; later ones are only counted", self._keys.base, reason)
        self.refused += 1

    def _failed(self, failure: DehystError | None, unsigned: int) -> DehystError:
        base = self._keys.base
        if isinstance(failure, ReplyTimeoutError):
            return ReplyTimeoutError(f"{base}: no answer within {self.timeout_s:g} s; ask again")
        if failure is not None:
            return failure
        if unsigned:
            return UnsignedReplyError(
                f"{base}: {unsigned} replies, none with the authenticator by {self._by.path}. Name the key that "
                "'dehyst serve' prints (--key, DEHYST_KEY); for a service with --open: --key -, DEHYST_KEY=-"
            )
        return NoReplyError(
            f"{base}: no reply within {self.timeout_s:g} s. Check that a service for stage "
            f"{self._keys.stage!r}, axis {self._keys.axis!r} is running and that your role may query it"
        )


# --- The client.


def _path(field: str, path: object) -> Path | None:
    """``path`` as a path, None as it is. Raises InputError for any other type."""
    if path is None or isinstance(path, Path):
        return path
    if not isinstance(path, str):
        raise FieldError(field, repr(path)[:80], "the path of a file")
    return Path(path)


#: Longest time until an open session knows what is declared at its other end, s; until then queries get no reply.
_SETTLE_S: Final = 0.5
_SETTLE_PAUSE_S: Final = 0.05


class Client:
    """A connection to one axis of a service; use as a context manager, or call :meth:`close`.

    All methods raise NoReplyError (no service), ReplyTimeoutError, RefusedError (refused by the service, with its
    message), BusyError (others ask for too much, for longer than ``retry_s``) and InputError (refused before sending).
    Use one client from one thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        timeout_s: float = 1.0,
        owns_session: bool = False,
        retry_s: float = RETRY_S,
        authenticator: Authenticator | None = None,
    ) -> None:
        self.keys = keys
        self._by = own_authenticator() if authenticator is None else authenticator
        self._commanded = (-1, math.nan)
        self._session = session
        self._owns = owns_session
        self._lease: CommandLease | None = None
        self._queries = RetryingQueries(session, keys, timeout_s, retry_s, self._by)

    @classmethod
    def connect(
        cls,
        endpoint: str | Sequence[str] = DEFAULT_ENDPOINT,
        stage: str = "demo",
        axis: str = "x",
        timeout_s: float = 1.0,
        wait_s: float = 0.0,
        zenoh_config: Path | str | None = None,
        retry_s: float = RETRY_S,
        key: Path | str | None = None,
    ) -> Client:
        """Connect to the service at ``endpoint``, or to one of several, and check that it serves this axis.

        Parameters
        ----------
        timeout_s : of each query, s. retry_s : time for which an unanswered query is repeated, s.
        wait_s : time to wait for the service to start, s.
        zenoh_config : configuration file of zenoh with TLS (docs/access.md); None without.
        key : file with the key of the service (docs/access.md); None: the one of this user on this machine, or without
            one nothing is checked.

        Raises SessionError if the endpoint does not answer, NoReplyError if the axis is not served there.
        """
        keys = Keys(stage, axis)
        key, zenoh_config = _path("key", key), _path("zenoh_config", zenoh_config)
        timeout_s, retry_s = waiting_time("timeout_s", timeout_s), waiting_time("retry_s", retry_s)
        wait_s = waiting_time("wait_s", wait_s)
        until = time.monotonic() + max(wait_s, _SETTLE_S)
        session = open_client(endpoint, wait_s, zenoh_config)
        try:
            # Only now: the first start of a service makes the key before it listens.
            client = cls(session, keys, timeout_s, True, retry_s, own_authenticator(key))
            while True:
                try:
                    client._queries.status(once=True)
                    return client
                except NoReplyError:
                    if time.monotonic() >= until:
                        raise
                    time.sleep(_SETTLE_PAUSE_S)
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
        """Close followers, lease and queries, and the session if this client opened it."""
        if self._lease is not None:
            self._lease.undeclare()
            self._lease = None
        for follower in self._queries.followers:
            follower.close()
        self._queries.followers = []
        self._queries.close()
        if self._owns:
            self._session.close()  # type: ignore[no-untyped-call]

    @property
    def retries(self) -> int:
        """Count of queries that were repeated because there was no answer."""
        return self._queries.retries

    @property
    def refused(self) -> int:
        """Count of replies that were passed over: without the right authenticator, or beyond what is known."""
        return self._queries.refused

    @property
    def dt_s(self) -> float:
        """Sample time of the axis, s: the distance of the points of a trajectory."""
        return self._known().dt_s

    @property
    def limits(self) -> Limits:
        """The limits that the service enforces."""
        return self._known().limits

    def status(self) -> dict[str, Any]:
        """The present status of the axis (docs/protocol.md)."""
        return self._queries.status()

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
        one = number("y_um", y_um), number("v_um_per_s", v_um_per_s), number("a_um_per_s2", a_um_per_s2)
        asked = encode_query(*one, as_of=as_of, **query)
        answer = self._queries.feedforward(asked, wait_s, 1, query["u_before_V"], query.get("pending") is not None)
        if begin is not None:
            answer = with_pending(answer, query["pending"], begin, np.array([y_um]))
        return Answer(answer.u_V.item(0), answer.std_V.item(0), answer.flags.item(0), *answer[3:])

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

        Parameters
        ----------
        y_um : (n,) desired displacement, µm.
        v_um_per_s, a_um_per_s2 : (n,) its velocity and acceleration at the same instants. Central differences replace
            what is not given; they are less accurate at the ends of a block, so give what the planner knows.
        after : the previous answer; gives its memory, its model and its last voltage to this query.
        begin : sample number of the stage at which the first point is due, for a controller that commands the answers.
            The service then takes the hysteresis memory that it tracks from the samples and advances it by what
            ``after`` left under way, so that it knows where the stage really is. An answer may begin before the end of
            the previous one and replaces it from there on.
        memory, u_before_V : (m,) memory and voltage, V, before the first point, instead of ``after``. Without any, the
            service takes the memory that it tracks from the samples.
        model : name of the model to ask; "" for the default of the service.
        as_of : answer from the newest snapshot that has seen no sample after this number.
        wait_s : with ``as_of``, longest time to wait until the service has learnt that far, s; then BehindError.
        """
        y = column("y_um", y_um)
        v, a = derivatives(y, v_um_per_s, a_um_per_s2, self.dt_s)
        query = continued(memory, model, u_before_V, after, begin)
        asked = encode_query(y, v, a, as_of=as_of, **query)
        answer = self._queries.feedforward(asked, wait_s, y.size, query["u_before_V"], query.get("pending") is not None)
        return answer if begin is None else with_pending(answer, query["pending"], begin, y)

    def follow(
        self, model: str = "", memory: ArrayLike | None = None, *, deltas: bool = True, keep: int = 1
    ) -> Follower:
        """Follow a model into this process (:class:`dehyst.service.client.follower.Follower`), closed with this client.

        The changes of the learning model and of "auto" are published with every batch that was learnt; any other model
        is constant and fetched once. "auto" holds all competing models: the learning model alone is faster to evaluate.
        Without ``deltas`` whole snapshots are followed: fewer, larger, and those that queries are answered from.
        Where the axis has ``[axis.correction]`` on, the follower corrects by the readings that it is given
        (docs/correction.md).
        """
        if not isinstance(model, str):
            raise FieldError("model", repr(model)[:80], "a name, or an empty text for the default")
        if check_seq("keep", keep) < 1:
            raise FieldError("keep", keep, "1 state or more")
        status = self._known().status
        name = model or str(status["served"])

        learning, keys = str(status.get("learning")), self.keys
        deltas = deltas and bool(status.get("delta_hz"))
        of = {learning: keys.model_delta, AUTO: keys.champion_delta} if deltas else {}
        key = (of or {learning: keys.model, AUTO: keys.champion}).get(name)
        parameters = f"name={name}" + (";changes=1" if name in of else "")
        heard = Heard(self._by, key or keys.model)

        def read(signed: Signed) -> bytes:
            heard.meet(signed.stamp)
            return signed.payload

        def fetch() -> bytes:
            payload = self._queries.get(keys.model, parameters, read)
            # Another instance may answer since then, with other limits.
            self._queries.status()
            return payload

        follower = Follower(
            self._session,
            key,
            name,
            fetch,
            self.limits,
            memory,
            keep=keep,
            heard=heard,
            dt_s=self.dt_s,
            correcting=Correcting.of_status(status, self.limits, self.dt_s),
        )
        self._queries.followers.append(follower)
        follower.limits = self.limits
        return follower

    def command(self, seq: int, u_V: ArrayLike) -> NDArray[np.uint8]:
        """Publish voltages, (n,) V, for the samples ``seq``, ``seq + 1``, … of the stage; returns (n,) flags.

        The published voltages keep the limits of the axis, and its slew limit from the previous command on; the flags
        mark changed voltages. The first call takes the lease of ``.../command`` (:meth:`take_command`).

        Raises InputError if a voltage is not finite, CommandHeldError if another controller commands the axis.
        """
        wanted = column("u_V", u_V)
        check_finite("u_V", wanted)
        following, before = self._commanded
        limits, gap = self.limits, check_seq("seq", seq) - following
        if following < 0 or gap < 0:
            before = math.nan  # the first command, or one that replaces others
        elif gap:
            # In a gap the stage holds the last voltage: the slew limit allows a larger step after it.
            reach_V = gap * limits.slew_V_per_s * self.dt_s
            before = limit_voltage(wanted.item(0), before, limits.u_min_V, limits.u_max_V, reach_V)[0]
        safe, flags = guard(wanted, np.ones(wanted.size, dtype=np.bool_), self.dt_s, limits, before)
        self._own().put(encode_command(seq, safe))
        self._commanded = (seq + safe.size, float(safe[-1]))
        return flags

    def take_command(self, wait_s: float = 0.0, *, force: bool = False) -> None:
        """Become the one controller of the axis until :meth:`close`; :meth:`command` does so by itself.

        wait_s : longest time to wait until another controller has ended, s. force : take it over from a controller that
            goes on; its voltages are left out from then on.

        Raises CommandHeldError, which names the other controller.
        """
        wait_s = waiting_time("wait_s", wait_s)
        self._own().take(wait_s, force)

    def _own(self) -> CommandLease:
        if self._lease is None:
            self._lease = CommandLease(self._session, self.keys, self._by)
        return self._lease

    def reference(self, seq: int, y_um: ArrayLike) -> None:
        """Publish the desired motion, (n,) µm, at the samples ``seq``, ``seq + 1``, …; for diagnostics only."""
        payload = encode_reference(check_seq("seq", seq), y_um)
        self._session.put(self.keys.reference, payload, congestion_control=SURELY)

    def samples(self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike) -> None:
        """Publish samples of the stage: what the service learns from.

        Parameters
        ----------
        seq : (n,) sample numbers, rising, one for each sample time. t_s : (n,) their times, s.
        u_V : (n,) voltages applied from these times on, V. y_um : (n,) readings of the sensor at these times, µm; NaN
            where there is none.

        May be called by another thread than the queries. Waits while the network is slow; nothing is dropped. Raises
        InputError if the lengths differ.
        """
        payload, key = encode_samples(seq, t_s, u_V, y_um), self.keys.sample
        attached = self._by.published(key, payload)
        self._session.put(key, payload, attachment=attached, express=True, congestion_control=SURELY)

    def wait_learnt(self, seq: int, wait_s: float = 10.0) -> int:
        """Wait until the service has learnt up to sample ``seq``; returns the number of the last one that it has.

        For a simulation that runs faster than real time: without it more samples wait than the service can hold, and
        are dropped. Raises BehindError after ``wait_s``.
        """
        seq, until = check_seq("seq", seq), time.monotonic() + waiting_time("wait_s", wait_s)
        while (learnt := int(self.status()["seq"])) < seq:
            if time.monotonic() >= until:
                raise BehindError(
                    f"{self.keys.base}: the service has learnt up to sample {learnt} and not up to sample {seq} within "
                    f"{wait_s:g} s: allow more wait_s; samples must come in the order of their numbers, up to this one"
                )
            time.sleep(_LEARNT_PAUSE_S)
        return learnt

    def subscribe_commands(self, receive: Callable[[bytes], None]) -> CommandGate:
        """Call ``receive`` with the payload of each command of the owner of ``.../command``, in a thread of zenoh.

        For a stage, which applies them (:class:`dehyst.service.adapters.StageLoop`). The result counts other
        commands, which are left out, as ``foreign``; ``stranger`` sent the last one. ``undeclare()`` ends it.
        """
        return CommandGate(self._session, self.keys, self._by, receive)

    def _known(self) -> Known:
        if self._queries.known is None:
            self.status()
        assert self._queries.known is not None
        return self._queries.known
