"""Errors of the wire and the processes, below :class:`dehyst.adaptive.errors.DehystError`.

::

    ServiceError
    ├── SessionError        a zenoh session cannot be opened: port in use, no answer, bad endpoint
    ├── NoReplyError        no service answered: not running, stopped meanwhile, or access refused
    │   └── UnsignedReplyError  somebody answered, and none of the replies carries the authenticator of the service
    ├── ReplyTimeoutError   the service is running but did not answer in time (also the built-in TimeoutError)
    ├── RefusedError        the service refused the request; has field, got and expected
    ├── CommandHeldError    another controller commands the axis
    ├── BusyError           the service has too much to do; has the time to ask again after
    └── BehindError         the service has not yet handled the samples that ``as_of`` covers
"""

from __future__ import annotations

import json
import math
from typing import Any, Final

from dehyst.adaptive.errors import DehystError, InputError

#: ``error`` of the error reply to a query that may be repeated after ``retry_after_s``.
BUSY: Final = "busy"


class ServiceError(DehystError):
    """Root of the errors of the wire and the processes."""


class SessionError(ServiceError):
    """A zenoh session cannot be opened; the message names the endpoint and what to do."""


class NoReplyError(ServiceError):
    """A query got no reply. It can be repeated: queries change nothing in the service."""


class UnsignedReplyError(NoReplyError):
    """Somebody answered, and no reply carries the authenticator of the service: another key, or a stranger."""


class ReplyTimeoutError(ServiceError, TimeoutError):
    """A query was not answered in time. It can be repeated."""


class BehindError(ServiceError):
    """The service did not handle all samples that ``as_of`` covers within the time allowed."""


class RefusedError(ServiceError):
    """The service refused a request; the message is that of the service.

    Attributes
    ----------
    kind : name of the error class in the service, such as ``InputError``.
    field, got, expected : the refused field, its value and what was expected; empty if the error has none.
    """

    def __init__(self, kind: str, message: str, field: str = "", got: str = "", expected: str = "") -> None:
        super().__init__(message)
        self.kind = kind
        self.field = field
        self.got = got
        self.expected = expected


class BusyError(ServiceError):
    """Others ask for so much that the answer would take too long. The query can be repeated after ``retry_after_s``."""

    def __init__(self, retry_after_s: float, message: str = "") -> None:
        super().__init__(message or f"others ask for too much at present: ask again in {retry_after_s:.3f} s")
        self.retry_after_s = retry_after_s


class CommandHeldError(ServiceError):
    """Another controller commands the axis; ``holder`` is its process, its host, and since when."""

    def __init__(self, message: str, holder: str) -> None:
        super().__init__(message)
        self.holder = holder


class FieldError(InputError):
    """An :class:`InputError` with its parts as attributes, for the JSON of an error reply."""

    def __init__(self, field: str, got: object, expected: str, advice: str = "") -> None:
        self.field = field
        self.got = str(got)
        self.expected = expected
        super().__init__(f"{field}: got {self.got}, expected {expected}{'; ' + advice if advice else ''}")


def error_to_json(error: BaseException) -> bytes:
    """The payload of an error reply: ``{"error", "message", "field", "got", "expected"}`` as UTF-8 JSON.

    For a `BusyError` ``error`` is "busy", and ``retry_after_s`` is added.
    """
    if isinstance(error, BusyError):
        busy = {"error": BUSY, "message": str(error), "field": "", "got": "", "expected": ""}
        return json.dumps({**busy, "retry_after_s": round(error.retry_after_s, 6)}).encode()
    # FieldError is not part of the protocol: clients see InputError.
    kind = "InputError" if isinstance(error, InputError) else type(error).__name__
    parts = {"field": "", "got": "", "expected": ""}
    if isinstance(error, FieldError | RefusedError):
        parts = {"field": error.field, "got": error.got, "expected": error.expected}
    return json.dumps({"error": kind, "message": str(error), **parts}).encode()


def error_from_json(payload: bytes) -> ServiceError:
    """The exception for the payload of an error reply; never raises."""
    try:
        data: Any = json.loads(payload)
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict):
        text = payload.decode(errors="replace")
        # Zenoh answers a query that timed out with an error reply that contains this word.
        if "timeout" in text.lower():
            return ReplyTimeoutError("the service did not answer in time; ask again or allow more time")
        return RefusedError("unknown", text)
    retry_after_s = data.get("retry_after_s")
    if data.get("error") == BUSY and isinstance(retry_after_s, int | float) and 0.0 <= retry_after_s < math.inf:
        return BusyError(float(retry_after_s), str(data.get("message", "")))
    parts = {name: str(data.get(name, "")) for name in ("field", "got", "expected")}
    return RefusedError(str(data.get("error", "unknown")), str(data.get("message", "")), **parts)
