"""Questions that are asked anew where no answer came in time, without giving up the answer that may still come.

An answer that takes 0.12 s is an answer. Whoever gives it up after 0.1 s and asks anew gets none at all on a machine
where each takes so long, and takes for silence what is only slow.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Generic, TypeVar

from adaptive.errors import DehystError

Asks = TypeVar("Asks")
Gets = TypeVar("Gets")

#: Most questions without an answer at a time.
MOST: Final = 12


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Asks, Gets]):
    """What became of a question.

    Attributes
    ----------
    asked : the question. answer : None where there was none, for the reason in ``error``. took_us : round trip, µs.
    at_s : when it was over, s of the monotonic clock.
    """

    asked: Asks
    answer: Gets | None
    error: DehystError | None
    took_us: float
    at_s: float


class Patience(Generic[Asks, Gets]):
    """Asks in threads of its own; use as a context manager.

    Parameters
    ----------
    ways : functions that ask and wait for the answer, one for each question that may be under way at a time: none is
        called while its last call lasts. They raise DehystError where there is no answer, after at most a second or so.
    again_s : how long :meth:`ask` waits for an answer, s.
    """

    def __init__(self, ways: Sequence[Callable[[Asks], Gets]], again_s: float) -> None:
        self._idle = list(ways)
        self._again_s = again_s
        self._pool = ThreadPoolExecutor(len(ways), thread_name_prefix="soak-ask")
        self._under_way: dict[Future[Outcome[Asks, Gets]], Callable[[Asks], Gets]] = {}

    def __enter__(self) -> Patience[Asks, Gets]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown()

    def ask(self, question: Asks) -> list[Outcome[Asks, Gets]]:
        """Ask, wait until this or an earlier question is over, and return all that are, in that order.

        Empty where none was over in ``again_s``; what is under way is then left so, and another call asks beside it.
        """
        if self._idle:
            way = self._idle.pop()
            self._under_way[self._pool.submit(_asked, way, question)] = way
        over, _ = wait(self._under_way, self._again_s, return_when=FIRST_COMPLETED)
        self._idle += [self._under_way.pop(future) for future in over]
        return sorted((future.result() for future in over), key=lambda outcome: outcome.at_s)


def _asked(way: Callable[[Asks], Gets], question: Asks) -> Outcome[Asks, Gets]:
    begin = time.perf_counter()
    answer: Gets | None = None
    failure: DehystError | None = None
    try:
        answer = way(question)
    except DehystError as error:
        failure = error
    return Outcome(question, answer, failure, 1e6 * (time.perf_counter() - begin), time.monotonic())
