"""The commands (verbs) of an operator to an axis."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from dehyst.service.protocol.errors import FieldError, ServiceError

if TYPE_CHECKING:
    from dehyst.service.server.axis import Axis

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
#: Starts background work: takes the arguments of the request, returns what was started.
Background = Callable[[dict[str, Any]], dict[str, Any]]


def axis_verbs(
    axis: Axis,
    between: Callable[[Callable[[], int]], int],
    background: Mapping[str, Callable[[], Background | None]],
    listed: Callable[[], frozenset[int]],
) -> dict[str, Verb]:
    """The verbs of one axis, by name.

    ``between`` : runs work on it between two batches of samples, in the thread of the axis. ``background`` : by verb,
    returns what starts the work; None if the configuration switches it off. ``listed`` : keeps checkpoints for the
    operator who asks for them, and gives their numbers.
    """

    def freeze(request: Request) -> Outcome:
        take(request.arguments)
        return between(lambda: axis.freeze(request.who)), {}

    def thaw(request: Request) -> Outcome:
        take(request.arguments)
        return between(lambda: axis.thaw(request.who)), {}

    def select(request: Request) -> Outcome:
        (model,) = take(request.arguments, model=str)
        return between(lambda: axis.select(model, request.who)), {"served": model}

    def rollback(request: Request) -> Outcome:
        (checkpoint,) = take(request.arguments, checkpoint=int)
        return between(lambda: axis.rollback(checkpoint, request.who)), {"checkpoint": checkpoint}

    def checkpoints(request: Request) -> Outcome:
        take(request.arguments)
        kept = listed()
        return axis.handled_seq, {"checkpoints": [one for one in axis.checkpoints() if one["checkpoint"] in kept]}

    def start(request: Request) -> Outcome:
        begin = background[request.verb]()
        if begin is None:
            raise ServiceError(f"{request.verb} is switched off in the service's configuration")
        return axis.handled_seq, begin(dict(request.arguments))

    own: dict[str, Verb] = {
        "freeze": freeze,
        "thaw": thaw,
        "select": select,
        "rollback": rollback,
        "checkpoints": checkpoints,
    }
    return own | dict.fromkeys(background, start)
