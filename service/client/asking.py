"""How a client asks: one reply to a query, the exception that says why there is none, and what is asked again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from typing import Any, Final

import zenoh

from service.protocol.errors import BehindError, FieldError, NoReplyError, ReplyTimeoutError, error_from_json
from service.protocol.keys import Keys
from service.protocol.reply import FeedforwardReply, decode_reply

_BEHIND_PAUSE_S: Final = 0.001
#: How long a query without an answer is repeated, and the pause before each time, s: a standby needs some hundredths
#: of a second where the service has died, and a second where it only stopped.
RETRY_S: Final = 2.0
_RETRY_PAUSE_S: Final = 0.003


class Asking:
    """The queries of one client.

    Parameters
    ----------
    timeout_s : of each query. retry_s : how long one without an answer is repeated.

    Attributes
    ----------
    retries : queries that were repeated because there was no answer.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, timeout_s: float, retry_s: float) -> None:
        self.timeout_s, self.retry_s = timeout_s, retry_s
        self.retries = 0
        self._session, self._keys = session, keys
        self._querier = session.declare_querier(keys.feedforward, timeout=timeout_s, express=True)

    def close(self) -> None:
        """Undeclare."""
        self._querier.undeclare()  # type: ignore[no-untyped-call]

    def once(self, selector: str) -> bytes:
        """The payload of the one reply; asked once. Raises NoReplyError, ReplyTimeoutError, RefusedError."""
        return self._one(self._session.get(selector, timeout=self.timeout_s))

    def get(self, selector: str) -> bytes:
        """As :meth:`once`, but repeated while there is no answer, for ``retry_s``."""
        return self._repeated(lambda: self.once(selector))

    def status(self, once: bool = False) -> dict[str, Any]:
        """The status of the axis as the service tells it now; ``once`` : not repeated."""
        status = json.loads((self.once if once else self.get)(self._keys.status))
        if not isinstance(status, dict) or "dt_s" not in status:
            raise FieldError("status", repr(status)[:80], "a status of this wire version")
        return status

    def feedforward(self, payload: bytes, wait_s: float) -> FeedforwardReply:
        """The answer to an encoded query, which is repeated while there is none, for ``retry_s``.

        ``wait_s`` : how long to wait, s, until the service has learnt as far as the query asks; BehindError after that.
        """
        start = time.monotonic()
        while True:
            reply = decode_reply(self._repeated(lambda: self._one(self._querier.get(payload=payload))))
            if not reply.behind:
                return reply
            if time.monotonic() - start >= wait_s:
                raise BehindError(
                    f"{self._keys.feedforward}: the service has learnt up to sample {reply.snapshot_seq} only; "
                    "ask for an earlier as_of, allow more wait_s, or see in the status whether samples arrive"
                )
            time.sleep(_BEHIND_PAUSE_S)

    def _repeated(self, ask: Callable[[], bytes]) -> bytes:
        """What ``ask`` returns, the first time that it is answered at all."""
        start = time.monotonic()
        while True:
            try:
                return ask()
            except (NoReplyError, ReplyTimeoutError):
                # It may have died while asked; another one takes over, or it comes back.
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
                f"{self._keys.base}: nobody answers; does a service with this stage and axis run, and may you ask it?"
            )
        failure = error_from_json(error)
        if isinstance(failure, ReplyTimeoutError):
            raise ReplyTimeoutError(f"{self._keys.base}: no answer within {self.timeout_s:g} s; ask again")
        raise failure
