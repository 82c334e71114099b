"""The operator's side of the wire: sends commands to an axis, and collects the statuses of all instances."""

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

#: Time, s, until a new session knows what the other end has declared; before, queries get no reply.
_SETTLE_S: Final = 0.5
_PAUSE_S: Final = 0.05
#: Time without a status after which a standby is no longer shown, s, and the most standbys that are kept.
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
    """Command the axis; returns the reply of the service, with ``seq`` and ``result`` (docs/operating.md).

    Raises RefusedError with the service's message, NoReplyError if there is no reply (a refusal by access control
    gives none either), ReplyTimeoutError after ``timeout_s``. A command without a reply may have been applied: read
    the status before you repeat it.
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
            raise _with_advice(error_from_json(error), keys, timeout_s)
        if time.monotonic() >= until:
            raise NoReplyError(
                f"{keys.operate}: no reply within {_SETTLE_S:g} s. Check that a service for stage {keys.stage!r}, axis "
                f"{keys.axis!r} is running and that your role may command it."
            )
        time.sleep(_PAUSE_S)


def statuses(session: zenoh.Session, stage: str = "*", axis: str = "*", timeout_s: float = 1.0) -> list[dict[str, Any]]:
    """The status of every instance of every axis that replies, ordered by stage, axis and role; may be empty."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    # Two instances reply on one key; consolidation would drop one of them.
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
    """The statuses of standbys, which answer no queries but publish their status once a second."""

    def __init__(self, session: zenoh.Session, stage: str = "*", axis: str = "*") -> None:
        self._received: dict[str, tuple[float, dict[str, Any]]] = {}
        self._subscriber = session.declare_subscriber(f"{ROOT}/{stage}/{axis}/standby/*", self._on_status)

    def statuses(self) -> list[dict[str, Any]]:
        """The statuses received within the last seconds."""
        since = time.monotonic() - _SILENT_S
        return [status for at, status in list(self._received.values()) if at >= since]

    def undeclare(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _on_status(self, sample: zenoh.Sample) -> None:
        status = fields_of(sample.payload.to_bytes())
        if "instance" in status and len(self._received) < _MOST_STANDBYS:
            self._received[str(sample.key_expr)] = (time.monotonic(), status)


def _with_advice(failure: ServiceError, keys: Keys, timeout_s: float) -> ServiceError:
    if isinstance(failure, ReplyTimeoutError):
        return ReplyTimeoutError(
            f"{keys.operate}: no reply within {timeout_s:g} s; read the status before you repeat the command"
        )
    return failure
