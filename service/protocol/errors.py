"""What the wire and the processes raise, below :class:`adaptive.errors.DehystError`.

::

    ServiceError
    ├── SessionError        a zenoh session could not be opened: port in use, nobody listening, bad endpoint
    ├── NoReplyError        no service answered: not running, stopped while asked, or access refused
    ├── ReplyTimeoutError   the service is there but did not answer in time (also the built-in TimeoutError)
    ├── RefusedError        the service answered with an error of its own; carries field, got and expected
    └── BehindError         the service has not yet learnt as far as the query asked for with ``as_of``
"""

from __future__ import annotations

import json
from typing import Any

from adaptive.errors import DehystError, InputError


class ServiceError(DehystError):
    """Root of what goes wrong on the wire and in the processes."""


class SessionError(ServiceError):
    """A zenoh session could not be opened; the message names the endpoint and what to do."""


class NoReplyError(ServiceError):
    """A query got no reply at all. The request may be repeated: queries change nothing in the service."""


class ReplyTimeoutError(ServiceError, TimeoutError):
    """A query was not answered within its time. The request may be repeated."""


class BehindError(ServiceError):
    """The service had not handled the samples that ``as_of`` needs within the time allowed."""


class RefusedError(ServiceError):
    """The service refused a request, in its own words.

    Attributes
    ----------
    kind : name of the error class in the service, such as ``InputError``.
    field, got, expected : what the service said of the offending field; empty where it said nothing.
    """

    def __init__(self, kind: str, message: str, field: str = "", got: str = "", expected: str = "") -> None:
        super().__init__(message)
        self.kind = kind
        self.field = field
        self.got = got
        self.expected = expected


class FieldError(InputError):
    """An :class:`InputError` that also carries its parts, so that they can travel as JSON."""

    def __init__(self, field: str, got: object, expected: str, advice: str = "") -> None:
        self.field = field
        self.got = str(got)
        self.expected = expected
        super().__init__(f"{field}: got {self.got}, expected {expected}{'; ' + advice if advice else ''}")


def error_to_json(error: BaseException) -> bytes:
    """The payload of an error reply: ``{"error", "message", "field", "got", "expected"}`` as UTF-8 JSON."""
    # The public name of what a peer gave wrongly is InputError; FieldError is how it carries its parts.
    kind = "InputError" if isinstance(error, InputError) else type(error).__name__
    return json.dumps(
        {
            "error": kind,
            "message": str(error),
            "field": getattr(error, "field", ""),
            "got": getattr(error, "got", ""),
            "expected": getattr(error, "expected", ""),
        }
    ).encode()


def error_from_json(payload: bytes) -> ServiceError:
    """The exception for the payload of an error reply, whoever made it; never raises."""
    try:
        data: Any = json.loads(payload)
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict):
        text = payload.decode(errors="replace")
        # Zenoh itself answers a query that ran out of time with this word as an error reply.
        if "timeout" in text.lower():
            return ReplyTimeoutError("the service did not answer in time; ask again or allow more time")
        return RefusedError("unknown", text)
    parts = {name: str(data.get(name, "")) for name in ("field", "got", "expected")}
    return RefusedError(str(data.get("error", "unknown")), str(data.get("message", "")), **parts)
