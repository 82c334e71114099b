"""The operator's side: commands an axis, and asks all that serve how they are."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from typing import Any, Final

import zenoh

from service.operating.request import Request, encode_request
from service.protocol.errors import FieldError, NoReplyError, ReplyTimeoutError, ServiceError, error_from_json
from service.protocol.json_message import fields_of
from service.protocol.keys import ROOT, Keys

#: A session is open before it has heard what is declared at its other end; until then queries get no reply, s.
_SETTLE_S: Final = 0.5
_PAUSE_S: Final = 0.05
#: A standby is no longer shown after this long without a word, s; and no more of them than these are kept.
_SILENT_S: Final = 3.5
_MOST_STANDBYS: Final = 4096


def operate(
    session: zenoh.Session,
    keys: Keys,
    verb: str,
    who: str,
    arguments: Mapping[str, Any] | None = None,
    timeout_s: float = 5.0,
) -> dict[str, Any]:
    """Command the axis and return the service's answer (docs/operating.md), ``seq`` and ``result`` among it.

    Raises RefusedError in the service's own words, NoReplyError where nobody answers (which is also how a refusal by
    access control looks), ReplyTimeoutError after ``timeout_s``. A verb that was not answered may have been done:
    ask the status before it is repeated.
    """
    payload = encode_request(Request(verb, who, arguments or {}))
    until = time.monotonic() + _SETTLE_S
    while True:
        error: bytes | None = None
        for reply in session.get(keys.operate, payload=payload, timeout=timeout_s):
            if reply.ok is not None:
                answer = json.loads(reply.ok.payload.to_bytes())
                if not isinstance(answer, dict) or answer.get("ok") is not True:
                    raise FieldError("answer", repr(answer)[:80], "an answer of this version")
                return answer
            elif reply.err is not None:
                error = bytes(reply.err.payload.to_bytes())
        if error is not None:
            raise _told(error_from_json(error), keys, timeout_s)
        if time.monotonic() >= until:
            raise NoReplyError(
                f"{keys.operate}: nobody answers; does a service with this stage and axis run, and may you command it?"
            )
        time.sleep(_PAUSE_S)


def statuses(session: zenoh.Session, stage: str = "*", axis: str = "*", timeout_s: float = 1.0) -> list[dict[str, Any]]:
    """The status of every instance of every axis that answers, ordered by stage, axis and role; may be empty."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    # Two instances answer on one key: without consolidation both are heard.
    for reply in session.get(
        f"{ROOT}/{stage}/{axis}/status",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
    ):
        if reply.ok is None:
            continue
        status = fields_of(reply.ok.payload.to_bytes())
        if all(name in status for name in ("stage", "axis", "instance")):
            found[str(status["stage"]), str(status["axis"]), str(status["instance"])] = status
    return in_order(found.values())


def in_order(found: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Statuses by stage, axis, role and instance."""
    return sorted(found, key=lambda s: tuple(str(s.get(name, "")) for name in ("stage", "axis", "role", "instance")))


class Standbys:
    """The statuses of instances that stand by: they answer no queries, but tell of themselves once a second."""

    def __init__(self, session: zenoh.Session, stage: str = "*", axis: str = "*") -> None:
        self._heard: dict[str, tuple[float, dict[str, Any]]] = {}
        self._subscriber = session.declare_subscriber(f"{ROOT}/{stage}/{axis}/standby/*", self._on_status)

    def statuses(self) -> list[dict[str, Any]]:
        """Those that were heard of a moment ago."""
        since = time.monotonic() - _SILENT_S
        return [status for at, status in list(self._heard.values()) if at >= since]

    def undeclare(self) -> None:
        """Hear no more."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_status(self, sample: zenoh.Sample) -> None:
        status = fields_of(sample.payload.to_bytes())
        if "instance" in status and len(self._heard) < _MOST_STANDBYS:
            self._heard[str(sample.key_expr)] = (time.monotonic(), status)


def _told(failure: ServiceError, keys: Keys, timeout_s: float) -> ServiceError:
    if isinstance(failure, ReplyTimeoutError):
        return ReplyTimeoutError(
            f"{keys.operate}: no answer within {timeout_s:g} s; see the status before you repeat it"
        )
    return failure
