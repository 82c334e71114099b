"""The operator's side of the wire: sends commands to an axis, and collects the statuses of all instances."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import zenoh

from dehyst.service.operating.verbs import Request, encode_request
from dehyst.service.protocol.container import fields_of
from dehyst.service.protocol.errors import (
    FieldError,
    NoReplyError,
    ReplyTimeoutError,
    ServiceError,
    UnsignedReplyError,
    error_from_json,
)
from dehyst.service.protocol.keys import ROOT, Keys
from dehyst.service.security.authenticator import Authenticator, own_authenticator

# --- Commands and statuses over the wire.

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
    authenticator: Authenticator | None = None,
) -> dict[str, Any]:
    """Command the axis; returns the reply of the service, with ``seq`` and ``result`` (docs/operating.md).

    Raises RefusedError with the service's message, NoReplyError if there is no reply (a refusal by access control
    gives none either), ReplyTimeoutError after ``timeout_s``. A command without a reply may have been applied: read
    the status before you repeat it. ``authenticator`` : None: by the key of this user.
    """
    by = own_authenticator() if authenticator is None else authenticator
    payload = encode_request(Request(verb, who, arguments or {}))
    until = time.monotonic() + _SETTLE_S
    while True:
        error: bytes | None = None
        unsigned = 0
        for reply, signed in by.ask(session, keys.operate, timeout_s, payload=payload, sign=True):
            if signed is not None:
                answer = json.loads(signed.payload)
                if not isinstance(answer, dict) or answer.get("ok") is not True:
                    raise FieldError("answer", repr(answer)[:80], "an answer of this version")
                return answer
            unsigned += reply.ok is not None
            if reply.err is not None:
                error = error or reply.err.payload.to_bytes()
        if unsigned and error is None:
            raise UnsignedReplyError(f"{keys.operate}: {unsigned} replies, none with the authenticator by {by.path}")
        if error is not None:
            raise _with_advice(error_from_json(error), keys, timeout_s)
        if time.monotonic() >= until:
            raise NoReplyError(
                f"{keys.operate}: no reply within {_SETTLE_S:g} s. Check that a service for stage {keys.stage!r}, axis "
                f"{keys.axis!r} is running and that your role may command it."
            )
        time.sleep(_PAUSE_S)


def statuses(
    session: zenoh.Session,
    stage: str = "*",
    axis: str = "*",
    timeout_s: float = 1.0,
    authenticator: Authenticator | None = None,
) -> list[dict[str, Any]]:
    """The status of every instance of every axis that replies, ordered by stage, axis and role; may be empty.

    ``authenticator`` : None: by the key of this user. Replies without it are left out.
    """
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    by = own_authenticator() if authenticator is None else authenticator
    for _, signed in by.ask(session, f"{ROOT}/{stage}/{axis}/status", timeout_s):
        status = {} if signed is None else fields_of(signed.payload)
        if all(name in status for name in ("stage", "axis", "instance")):
            found[str(status["stage"]), str(status["axis"]), str(status["instance"])] = status
    return in_order(found.values())


def in_order(found: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Statuses by stage, axis, role and instance."""
    return sorted(found, key=lambda s: tuple(str(s.get(name, "")) for name in ("stage", "axis", "role", "instance")))


class Standbys:
    """The statuses of standbys, which answer no queries but publish their status once a second."""

    def __init__(
        self, session: zenoh.Session, stage: str = "*", axis: str = "*", authenticator: Authenticator | None = None
    ) -> None:
        self._by = own_authenticator() if authenticator is None else authenticator
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
        signed = self._by.heard(sample, str(sample.key_expr))
        status = {} if signed is None else fields_of(signed.payload)
        if "instance" in status and len(self._received) < _MOST_STANDBYS:
            self._received[str(sample.key_expr)] = (time.monotonic(), status)


def _with_advice(failure: ServiceError, keys: Keys, timeout_s: float) -> ServiceError:
    if isinstance(failure, ReplyTimeoutError):
        return ReplyTimeoutError(
            f"{keys.operate}: no reply within {timeout_s:g} s; read the status before you repeat the command"
        )
    return failure


# --- The statuses of all instances as a table for a terminal, in plain ANSI.

#: (heading, width, what it shows). One line an instance.
Cell = Callable[[dict[str, Any]], str]
_CLEAR: Final = "\x1b[H\x1b[J"
_BOLD: Final = "\x1b[1m"
_RED: Final = "\x1b[31m"
_PLAIN: Final = "\x1b[0m"


def entry(status: dict[str, Any], *path: str) -> Any:
    """The value at ``path`` in nested objects; None where there is none."""
    value: Any = status
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _number(value: Any, form: str, scale: float = 1.0) -> str:
    return format(value * scale, form) if isinstance(value, int | float) and not isinstance(value, bool) else "-"


def _age(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return "-"
    for unit, size in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.1f} s"


def _state(status: dict[str, Any]) -> str:
    """The state of the axis in a word, as the service says."""
    return str(status.get("state", "unknown"))


def _gates(status: dict[str, Any]) -> str:
    """The two most frequent reasons for refused samples."""
    gates = entry(status, "samples", "gates") or {}
    refused = sorted(((n, name) for name, n in gates.items() if name != "learnt"), reverse=True)
    return " ".join(f"{name}:{n}" for n, name in refused[:2]) or "-"


def _not_handled(status: dict[str, Any]) -> int:
    """Samples that were lost on the way, dropped, or left out by thinning."""
    return sum(entry(status, "samples", name) or 0 for name in ("lost", "dropped", "thinned"))


COLUMNS: Final[tuple[tuple[str, int, Cell], ...]] = (
    ("stage/axis", 16, lambda s: f"{s.get('stage')}/{s.get('axis')}"),
    ("instance", 18, lambda s: str(s.get("instance"))),
    ("role", 8, lambda s: str(s.get("role", "primary"))),
    ("state", 16, _state),
    ("serves", 15, lambda s: str(s.get("served"))),
    ("err %", 7, lambda s: _number(entry(s, "quality", "recent_rms_error_pct"), ".3f")),
    ("trust", 5, lambda s: _number(s.get("trust"), ".2f")),
    ("sample", 10, lambda s: str(s.get("seq"))),
    ("age", 7, lambda s: _age(s.get("sample_age_s"))),
    ("learnt", 9, lambda s: str(entry(s, "samples", "learnt"))),
    ("missed", 6, lambda s: str(_not_handled(s))),
    ("ckpt", 7, lambda s: _age(entry(s, "checkpoints", "age_s"))),
    ("queries", 9, lambda s: str(entry(s, "queries", "count"))),
    ("p50 us", 7, lambda s: _number(entry(s, "queries", "p50_us"), ".0f")),
    ("p99 us", 7, lambda s: _number(entry(s, "queries", "p99_us"), ".0f")),
    ("MB", 5, lambda s: _number(entry(s, "memory", "resident_bytes"), ".0f", 1e-6)),
    ("refused", 8, lambda s: str(sum((s.get("refused") or {}).values())) if s.get("refused") else "-"),
    ("not learnt", 24, _gates),
)


def is_healthy(status: dict[str, Any]) -> bool:
    """Whether a status needs no attention of an operator."""
    return _state(status) in ("ok", "not learning")


def table(statuses: Sequence[dict[str, Any]], width: int = 0, colour: bool = False) -> str:
    """The table as text, with lines of at most ``width`` characters (0: no limit)."""
    lines = [" ".join(f"{name:<{size}}" for name, size, _ in COLUMNS).rstrip()]
    for status in statuses:
        cells = [f"{_safe(show(status))[:size]:<{size}}" for _, size, show in COLUMNS]
        lines.append(" ".join(cells).rstrip())
    if width:
        lines = [line[:width] for line in lines]
    if colour:
        healthy = [True, *(is_healthy(status) for status in statuses)]
        lines = [
            f"{_BOLD if i == 0 else '' if fine else _RED}{line}{_PLAIN}"
            for i, (line, fine) in enumerate(zip(lines, healthy, strict=True))
        ]
    if not statuses:
        lines.append("no instance replies")
    lines += [line[:width] if width else line for status in statuses for line in warnings(status)]
    return "\n".join(lines)


def warnings(status: Mapping[str, Any]) -> list[str]:
    """What did not fit at the start of an axis, one line each."""
    found = status.get("warnings")
    texts = [text for text in found if isinstance(text, str)] if isinstance(found, list) else []
    return [_safe(f"warning: {status.get('stage')}/{status.get('axis')}: {text}") for text in texts]


def screen(statuses: Sequence[dict[str, Any]], endpoint: str, events: Sequence[str]) -> str:
    """A whole screen: clear, a line with time and endpoint, the table, the newest events."""
    try:
        size = os.get_terminal_size()
        width, height = size.columns, size.lines
    except OSError:
        width, height = 200, 50
    head = f"{time.strftime('%H:%M:%S')}  {endpoint}  {len(statuses)} instances  (Ctrl-C ends)"
    body = table(statuses, width, colour=True).split("\n")
    room = max(0, height - len(body) - 3)
    tail = [_safe(line)[:width] for line in list(events)[-room:]] if room else []
    return _CLEAR + "\n".join([_safe(head)[:width], *body[: height - 2], *tail])


def _safe(text: str) -> str:
    """``text`` without control characters: it comes from other processes and must not move the cursor."""
    return "".join(c if c.isprintable() else "?" for c in text)
