"""The commands (verbs) of an operator to an axis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from adaptive.errors import DehystError
from service.operating.request import Request, take
from service.protocol.errors import FieldError, ServiceError


class OperableAxis(Protocol):
    """What the verbs need of an axis; each command returns the number of the sample after which it holds."""

    @property
    def handled_seq(self) -> int: ...

    def freeze(self, by: str = "") -> int: ...

    def thaw(self, by: str = "") -> int: ...

    def select(self, model: str, by: str = "") -> int: ...

    def rollback(self, checkpoint: int, by: str = "") -> int: ...

    def checkpoints(self) -> list[dict[str, Any]]: ...


#: Runs work on an axis between two batches of samples, in the thread of the axis; returns its result.
Between = Callable[[Callable[[Any], int]], int]
#: Starts background work: takes the arguments of the request, returns what was started.
Background = Callable[[dict[str, Any]], dict[str, Any]]
#: (number of the sample after which the command holds, further fields of the reply).
Outcome = tuple[int, dict[str, Any]]


class Verbs:
    """The verbs of one axis.

    Parameters
    ----------
    axis : the axis. between : runs work on it between two batches of samples.
    background : by verb, returns what starts the work; None if the configuration switches it off.
    """

    def __init__(
        self, axis: OperableAxis, between: Between, background: Mapping[str, Callable[[], Background | None]]
    ) -> None:
        self._axis = axis
        self._between = between
        self._background = dict(background)
        self._verbs: dict[str, Callable[[Request], Outcome]] = {
            "freeze": self._freeze,
            "thaw": self._thaw,
            "select": self._select,
            "rollback": self._rollback,
            "checkpoints": self._checkpoints,
            **{name: self._start for name in background},
        }

    @property
    def background(self) -> tuple[str, ...]:
        """Verbs that start background work and do not wait for it; the others note their own events."""
        return tuple(self._background)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._verbs)

    def apply(self, request: Request) -> Outcome:
        """Run a command. Raises InputError if it is not valid, ServiceError if it is not possible now."""
        verb = self._verbs.get(request.verb)
        if verb is None:
            raise FieldError("verb", repr(request.verb), f"one of {', '.join(self._verbs)}")
        try:
            return verb(request)
        except DehystError:
            raise
        except OSError as error:
            raise ServiceError(f"{request.verb}: {error}") from error

    def _freeze(self, request: Request) -> Outcome:
        take(request.arguments)
        return self._between(lambda axis: int(axis.freeze(request.who))), {}

    def _thaw(self, request: Request) -> Outcome:
        take(request.arguments)
        return self._between(lambda axis: int(axis.thaw(request.who))), {}

    def _select(self, request: Request) -> Outcome:
        (model,) = take(request.arguments, model=str)
        return self._between(lambda axis: int(axis.select(model, request.who))), {"served": model}

    def _rollback(self, request: Request) -> Outcome:
        (checkpoint,) = take(request.arguments, checkpoint=int)
        seq = self._between(lambda axis: int(axis.rollback(checkpoint, request.who)))
        return seq, {"checkpoint": checkpoint}

    def _checkpoints(self, request: Request) -> Outcome:
        take(request.arguments)
        return self._axis.handled_seq, {"checkpoints": self._axis.checkpoints()}

    def _start(self, request: Request) -> Outcome:
        start = self._background[request.verb]()
        if start is None:
            raise ServiceError(f"{request.verb} is switched off in the service's configuration")
        return self._axis.handled_seq, start(dict(request.arguments))
