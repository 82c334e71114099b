"""The commands (verbs) of an operator to one axis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dehyst.service.operating.verbs import Outcome, Request, Verb, take
from dehyst.service.protocol.errors import FieldError, ServiceError
from dehyst.service.server.axis import Axis
from dehyst.service.storage.checkpoint import CheckpointKeeper

#: Starts background work: takes the arguments of the request, returns what was started.
Background = Callable[[dict[str, Any]], dict[str, Any]]


def axis_verbs(
    axis: Axis,
    checkpoints: CheckpointKeeper,
    between: Callable[[Callable[[], int]], int],
    background: Mapping[str, Callable[[], Background | None]],
) -> dict[str, Verb]:
    """The verbs of one axis, by name.

    ``between`` : runs work on it between two batches of samples, in the thread of the axis. ``background`` : by verb,
    returns what starts the work; None if the configuration switches it off.
    """
    folder = checkpoints.folder

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
        (number,) = take(request.arguments, checkpoint=int)

        def go_back() -> int:
            if folder is None or axis.learner is None:
                expected = "an axis that learns and keeps checkpoints"
                raise FieldError("checkpoint", number, expected, "see 'checkpoints'")
            return axis.rollback(folder.learner_of(number, axis.learner), number, request.who)

        return between(go_back), {"checkpoint": number}

    def list_kept(request: Request) -> Outcome:
        take(request.arguments)
        kept = checkpoints.keep_listed()
        entries = [] if folder is None else folder.entries()
        return axis.handled_seq, {"checkpoints": [entry for entry in entries if entry["checkpoint"] in kept]}

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
        "checkpoints": list_kept,
    }
    return own | dict.fromkeys(background, start)
