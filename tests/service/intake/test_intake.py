"""Between the wire and the learner: messages that wait, work between them, a full queue, the age of what is handled."""

from __future__ import annotations

import time
from typing import Any

from adaptive.types import InverseModel
from service.intake.intake import Intake
from service.protocol.samples import SampleBatch
from tests.service.server.test_axis import make_axis, parts, recording


def test_messages_that_wait_are_handled_together_and_work_in_its_place(models: dict[str, InverseModel]) -> None:
    """Forty messages of a sample each, and something to be done behind the twentieth."""
    axis = make_axis(models)
    intake = Intake(axis, lambda: None)
    sizes: list[int] = []

    class Watcher:
        def take(self, batch: SampleBatch) -> None:
            sizes.append(len(batch))

        def tick(self, now_s: float) -> None: ...
        def request(self, arguments: dict[str, Any]) -> dict[str, Any]:
            return {}

        def status(self) -> dict[str, Any]:
            return {}

        def close(self) -> None: ...

    intake.watcher = Watcher()
    messages = parts(recording(40), 1)
    for part in messages[:20]:
        assert intake.offer(part)
    intake.start()
    try:
        seen = intake.call(lambda: axis.handled_seq)
        for part in messages[20:]:
            assert intake.offer(part)
    finally:
        intake.close()
    assert seen == 19, "what came before the work was handled before it"
    assert axis.handled_seq == 39
    assert sum(sizes) == 40
    assert len(sizes) < 20, "several messages at a time"
    assert intake.waiting == 0


def test_a_full_queue_drops_and_counts(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models, queue_samples=100)
    intake = Intake(axis, lambda: None)  # not started: nobody takes
    offered = [intake.offer(part) for part in parts(recording(150), 30)]
    assert offered == [True, True, True, False, False]
    assert (intake.dropped, intake.waiting) == (60, 90)
    assert [e["event"] for e in axis.take_events()] == ["samples_dropped"]
    intake.start()
    intake.close()
    assert axis.handled_seq == 89


def offered_twice(intake: Intake) -> float:
    """Two messages that came 10 ms apart, before anybody takes them; when the first one did, s."""
    assert intake.handled_at_s is None
    first, second = parts(recording(40), 20)
    intake.offer(first)
    came_s = intake.handled_at_s
    assert came_s is not None
    time.sleep(0.01)
    intake.offer(second)
    assert intake.handled_at_s == came_s
    return came_s


def test_what_has_come_is_no_newer_before_it_is_handled(models: dict[str, InverseModel]) -> None:
    intake = Intake(make_axis(models), lambda: None)
    came_s, before_s = offered_twice(intake), time.monotonic()
    intake.start()
    intake.close()
    assert intake.handled_at_s is not None
    assert came_s + 0.01 <= intake.handled_at_s <= before_s, "when the last one came, not when it was handled"


def test_what_a_standby_holds_back_is_as_new_as_what_is_learnt(models: dict[str, InverseModel]) -> None:
    intake = Intake(make_axis(models), lambda: None)
    intake.gate = lambda batch: None
    came_s = offered_twice(intake)
    intake.start()
    intake.close()
    assert intake.handled_at_s is not None
    assert intake.handled_at_s >= came_s + 0.01


def test_samples_that_could_not_be_handled_make_nothing_newer(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)

    def broken(batch: SampleBatch) -> list[str]:
        raise RuntimeError("for once")

    axis.handle = broken  # type: ignore[method-assign]
    intake = Intake(axis, lambda: None)
    came_s = offered_twice(intake)
    intake.start()
    intake.close()
    assert intake.handled_at_s == came_s
    assert [event["event"] for event in axis.take_events()] == ["internal_error"]
