"""Long queries: turns between those who ask, pauses for short ones, refusals that tell when to ask again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from dehyst.service.answers.slices import Pace
from dehyst.service.protocol.errors import BusyError, ServiceError
from dehyst.service.server.long_queries import LongQueries

SLICE = 100
SLICE_S = 0.002


class Asked:
    """Queries whose slices take a while; keeps the order of the slices and of the answers."""

    def __init__(self, queries: LongQueries) -> None:
        self.queries = queries
        self.slices: list[str] = []
        self.answered: list[str] = []
        self.refused: list[tuple[str, BaseException]] = []
        self.may_go = threading.Event()

    def ask(self, name: str, points: int) -> None:
        def work(pace: Pace) -> Callable[[], None]:
            self.may_go.wait(5.0)
            for _ in range(points // SLICE):
                time.sleep(SLICE_S)
                self.slices.append(name)
                pace(SLICE)
            return lambda: self.answered.append(name)

        self.queries.offer(name, points, work, lambda error: self.refused.append((name, error)))

    def wait(self, answers: int) -> None:
        until = time.monotonic() + 10.0
        while len(self.answered) + len(self.refused) < answers:
            assert time.monotonic() < until, (self.answered, self.refused)
            time.sleep(0.001)


@pytest.fixture
def asked() -> Iterator[Asked]:
    queries = LongQueries(busy_after_s=60.0)
    made = Asked(queries)
    yield made
    made.may_go.set()
    queries.close()


def test_each_source_has_its_turn_and_the_shorter_query_is_done_first(asked: Asked) -> None:
    for name, slices in (("a", 30), ("a", 5), ("b", 3), ("c", 6)):
        asked.ask(name, slices * SLICE)
    assert asked.queries.waiting_points == 44 * SLICE
    asked.may_go.set()
    asked.wait(4)
    assert asked.answered == ["b", "c", "a", "a"]
    assert asked.slices[:9] == ["a", "b", "c"] * 3
    assert asked.queries.waiting_points == 0


def test_a_receiver_that_does_not_read_keeps_nobody_waiting(asked: Asked) -> None:
    asked.may_go.set()
    stuck = threading.Event()
    asked.queries.offer("stuck", SLICE, lambda pace: lambda: (stuck.wait(5.0), None)[1], lambda error: None)
    asked.ask("b", SLICE)
    asked.wait(1)
    stuck.set()


def busy(asked: Asked, name: str, points: int) -> float:
    with pytest.raises(BusyError) as refused:
        asked.ask(name, points)
    return refused.value.retry_after_s


def test_a_query_that_would_take_too_long_beside_others_is_refused_and_has_the_next_place(asked: Asked) -> None:
    queries = asked.queries
    queries.busy_after_s = 0.2  # 100,000 points at the 2 µs that are expected before any is measured
    asked.ask("a", 65_536)  # alone: whatever it takes
    assert busy(asked, "b", 65_536) == pytest.approx(2 * 65_536 * 2e-6 - 0.2, rel=0.01)
    asked.ask("c", 20_000)  # in turns it is done after three times its own length
    # What a source has waiting counts as its own; the others do not pay for it.
    assert busy(asked, "c", 60_000) > 0.0
    assert queries.refused == 2
    # A newcomer does not get the place of those who were refused before; when the others are done, they do.
    asked.may_go.set()
    asked.wait(0)
    queries._sources["a"].jobs[0].points = 0
    queries._sources["c"].jobs[0].points = 0
    assert busy(asked, "d", 65_536) > 0.0
    asked.ask("b", 65_536)


def test_the_end_answers_everybody(asked: Asked) -> None:
    for name in ("a", "b"):
        asked.ask(name, 1000 * SLICE)
        asked.ask(name, SLICE)
    asked.may_go.set()
    while len(asked.slices) < 3:
        time.sleep(0.001)
    asked.queries.close()
    assert sorted(name for name, _ in asked.refused) == ["a", "a", "b", "b"]
    assert all(isinstance(error, ServiceError) for _, error in asked.refused)
    with pytest.raises(ServiceError, match="stopping"):
        asked.ask("a", SLICE)
    assert not [thread for thread in threading.enumerate() if thread.name == "long-queries"]
