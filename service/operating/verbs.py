"""What an operator can ask of an axis, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from adaptive.errors import DehystError
from service.operating.request import Request, take
from service.protocol.errors import FieldError, ServiceError


class OperableAxis(Protocol):
    """What the verbs need of an axis; each of the first four returns the sequence number from which it holds."""

    @property
    def handled_seq(self) -> int: ...

    def freeze(self, by: str = "") -> int: ...

    def thaw(self, by: str = "") -> int: ...

    def select(self, model: str, by: str = "") -> int: ...

    def rollback(self, checkpoint: int, by: str = "") -> int: ...

    def checkpoints(self) -> list[dict[str, Any]]: ...


#: Runs work on an axis where it changes, between two batches of samples, and returns its result.
Between = Callable[[Callable[[Any], int]], int]
#: Something that starts work in the background: arguments in, what was started out.
Background = Callable[[dict[str, Any]], dict[str, Any]]
#: The axis' answer: (sequence number at which it took effect, what else there is to tell).
Outcome = tuple[int, dict[str, Any]]


class Verbs:
    """The verbs of one axis.

    Parameters
    ----------
    axis : what they act on. between : runs work on it between two batches of samples.
    background : name -> what starts long work; None where it is switched off in the configuration.
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
        """Those that start something and do not wait for its end; the others tell an event of their own."""
        return tuple(self._background)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._verbs)

    def apply(self, request: Request) -> Outcome:
        """Do what is asked. Raises InputError on what cannot be asked for, ServiceError on what cannot be done now."""
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
