"""Queries of a client: one reply each, an exception that states why there is none, and repetition without an answer."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import zenoh

from service.protocol.errors import BehindError, FieldError, NoReplyError, ReplyTimeoutError, error_from_json
from service.protocol.keys import Keys
from service.protocol.reply import Trajectory, decode_reply

_BEHIND_PAUSE_S: Final = 0.001
#: Default time for which an unanswered query is repeated, s. A standby takes over within some hundredths of a second if
#: the service has died, within about a second if it has only stopped.
RETRY_S: Final = 2.0
_RETRY_PAUSE_S: Final = 0.003


class RetryingQueries:
    """The queries of one client.

    Parameters
    ----------
    timeout_s : of each query, s. retry_s : time for which an unanswered query is repeated, s.

    Attributes
    ----------
    retries : count of repetitions.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, timeout_s: float, retry_s: float) -> None:
        self.timeout_s, self.retry_s = timeout_s, retry_s
        self.retries = 0
        self._session, self._keys = session, keys
        self._querier = session.declare_querier(keys.feedforward, timeout=timeout_s, express=True)

    def close(self) -> None:
        """Undeclare the querier."""
        self._querier.undeclare()  # type: ignore[no-untyped-call]

    def once(self, selector: str) -> bytes:
        """The payload of the one reply, without repetition. Raises NoReplyError, ReplyTimeoutError, RefusedError."""
        return self._one(self._session.get(selector, timeout=self.timeout_s))

    def get(self, selector: str) -> bytes:
        """As :meth:`once`, but repeated for ``retry_s`` while there is no answer."""
        return self._repeated(lambda: self.once(selector))

    def status(self, once: bool = False) -> dict[str, Any]:
        """The present status of the axis; ``once`` : without repetition."""
        status = json.loads((self.once if once else self.get)(self._keys.status))
        if not isinstance(status, dict) or "dt_s" not in status:
            raise FieldError("status", repr(status)[:80], "a status of this wire version")
        return status

    def feedforward(self, payload: bytes, wait_s: float) -> Trajectory:
        """The answer to an encoded query, which is repeated for ``retry_s`` while there is none.

        ``wait_s`` : longest time to wait, s, until the service has handled all samples that ``as_of`` covers. Raises
        BehindError after that.
        """
        start = time.monotonic()
        while True:
            answer = decode_reply(self._repeated(lambda: self._one(self._querier.get(payload=payload))))
            if not answer.behind:
                return answer
            if time.monotonic() - start >= wait_s:
                raise BehindError(
                    f"{self._keys.feedforward}: the service has learnt up to sample {answer.snapshot_seq} only; "
                    "ask for an earlier as_of, allow more wait_s, or check in the status whether samples arrive"
                )
            time.sleep(_BEHIND_PAUSE_S)

    def _repeated(self, ask: Callable[[], bytes]) -> bytes:
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

    def _one(self, replies: Iterable[zenoh.Reply]) -> bytes:
        error: bytes | None = None
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            if reply.err is not None:
                error = bytes(reply.err.payload.to_bytes())
        if error is None:
            raise NoReplyError(
                f"{self._keys.base}: no reply within {self.timeout_s:g} s. Check that a service for stage "
                f"{self._keys.stage!r}, axis {self._keys.axis!r} is running and that your role may query it"
            )
        failure = error_from_json(error)
        if isinstance(failure, ReplyTimeoutError):
            raise ReplyTimeoutError(f"{self._keys.base}: no answer within {self.timeout_s:g} s; ask again")
        raise failure
