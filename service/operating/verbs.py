"""The request of an operator, and what carries it out."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from dehyst.service.protocol.errors import FieldError

# --- The request of an operator: JSON, decoded strictly.

#: Longest request that is read, bytes.
MAX_BYTES: Final = 16_384
MAX_WHO: Final = 64
_MAX_VERB: Final = 32
_FIELDS: Final = ("verb", "arguments", "who")


@dataclass(frozen=True, slots=True)
class Request:
    """A command and who sends it.

    Attributes
    ----------
    verb : such as ``freeze``. arguments : by name, JSON values.
    who : name that the caller gives; it is not verified. Zenoh's access control decides who may send commands.
    """

    verb: str
    who: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


def encode_request(request: Request) -> bytes:
    """The payload of a request. Raises InputError if the service would refuse it."""
    data = {"verb": request.verb, "arguments": dict(request.arguments), "who": request.who}
    try:
        payload = json.dumps(data, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise FieldError("arguments", repr(request.arguments)[:80], "values that JSON can say") from error
    decode_request(payload)
    return payload


def decode_request(payload: bytes | None) -> Request:
    """The request in a payload. Raises InputError with the field, what was got and what was expected."""
    if payload is None:
        raise FieldError("payload", "none", "JSON with verb, arguments and who")
    if len(payload) > MAX_BYTES:
        raise FieldError("payload", f"{len(payload)} bytes", f"at most {MAX_BYTES} bytes")
    try:
        data = json.loads(payload, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise FieldError("payload", f"no JSON ({str(error)[:80]})", "JSON with verb, arguments and who") from error
    if not isinstance(data, dict):
        raise FieldError("payload", type(data).__name__, "a JSON object with verb, arguments and who")
    for key in data:
        if key not in _FIELDS:
            raise FieldError(str(key)[:64], "a field", f"only {', '.join(_FIELDS)}")
    verb, who, arguments = data.get("verb"), data.get("who"), data.get("arguments", {})
    if not isinstance(verb, str) or not 1 <= len(verb) <= _MAX_VERB:
        raise FieldError("verb", repr(verb)[:80], "the name of a verb")
    if not isinstance(who, str) or not 1 <= len(who) <= MAX_WHO or not who.isprintable() or not who.strip():
        raise FieldError("who", repr(who)[:80], f"1 to {MAX_WHO} printable characters", "say who commands")
    if not isinstance(arguments, dict):
        raise FieldError("arguments", type(arguments).__name__, "a JSON object")
    return Request(verb, who, arguments)


def take(arguments: Mapping[str, Any], **kinds: type) -> list[Any]:
    """The values of exactly the named arguments, checked for their kind; InputError on any other or missing one."""
    for name in arguments:
        if name not in kinds:
            raise FieldError(
                f"arguments.{str(name)[:64]}", "given", f"only {', '.join(kinds)}" if kinds else "no arguments"
            )
    values = []
    for name, kind in kinds.items():
        value = arguments.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise FieldError(
                f"arguments.{name}", repr(value)[:80], {str: "a text", int: "an integer", list: "a list"}[kind]
            )
        values.append(value)
    return values


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no JSON")


# --- Verbs.

#: (number of the sample after which the command holds, further fields of the reply).
Outcome = tuple[int, dict[str, Any]]
#: Carries out a request. Raises InputError if it is not valid, ServiceError if it is not possible now.
Verb = Callable[[Request], Outcome]
