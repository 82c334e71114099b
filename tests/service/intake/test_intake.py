"""Between the wire and the learner: messages that wait, work between them, a full queue, the age of what is handled."""

from __future__ import annotations

import time
from typing import Any

from adaptive.types import InverseModel
from service.protocol.samples import SampleBatch
from service.server.axis_loop import AxisLoop
from tests.service.axes import loop_of
from tests.service.server.test_axis import make_axis, parts, recording


def test_messages_that_wait_are_handled_together_and_work_in_its_place(models: dict[str, InverseModel]) -> None:
    """Forty messages of a sample each, and something to be done behind the twentieth."""
    axis = make_axis(models)
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

    loop = loop_of(axis, watcher=Watcher())
    messages = parts(recording(40), 1)
    for part in messages[:20]:
        assert loop.offer(part)
    loop.start()
    try:
        seen = loop.queue.call(lambda: axis.handled_seq)
        for part in messages[20:]:
            assert loop.offer(part)
    finally:
        loop.close()
    assert seen == 19, "what came before the work was handled before it"
    assert axis.handled_seq == 39
    assert sum(sizes) == 40
    assert len(sizes) < 20, "several messages at a time"
    assert loop.queue.waiting == 0


def test_a_full_queue_drops_and_counts(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models, queue_samples=100)
    loop = loop_of(axis)  # not started: nobody takes
    offered = [loop.offer(part) for part in parts(recording(150), 30)]
    assert offered == [True, True, True, False, False]
    assert (loop.queue.dropped, loop.queue.waiting) == (60, 90)
    assert [e["event"] for e in axis.take_events()] == ["samples_dropped"]
    loop.start()
    loop.close()
    assert axis.handled_seq == 89


def offered_twice(loop: AxisLoop) -> float:
    """Two messages that came 10 ms apart, before anybody takes them; when the first one did, s."""
    assert loop.queue.handled_at_s is None
    first, second = parts(recording(40), 20)
    loop.offer(first)
    came_s = loop.queue.handled_at_s
    assert came_s is not None
    time.sleep(0.01)
    loop.offer(second)
    assert loop.queue.handled_at_s == came_s
    return came_s


def test_what_has_come_is_no_newer_before_it_is_handled(models: dict[str, InverseModel]) -> None:
    loop = loop_of(make_axis(models))
    came_s, before_s = offered_twice(loop), time.monotonic()
    loop.start()
    loop.close()
    assert loop.queue.handled_at_s is not None
    assert came_s + 0.01 <= loop.queue.handled_at_s <= before_s, "when the last one came, not when it was handled"


def test_what_a_standby_holds_back_is_as_new_as_what_is_learnt(models: dict[str, InverseModel]) -> None:
    loop = loop_of(make_axis(models))
    loop.set_gate(lambda batch: None)
    came_s = offered_twice(loop)
    loop.start()
    loop.close()
    assert loop.queue.handled_at_s is not None
    assert loop.queue.handled_at_s >= came_s + 0.01


def test_samples_that_could_not_be_handled_make_nothing_newer(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)

    def broken(batch: SampleBatch, on_snapshot: Any) -> list[str]:
        raise RuntimeError("for once")

    axis.handle = broken  # type: ignore[method-assign]
    loop = loop_of(axis)
    came_s = offered_twice(loop)
    loop.start()
    loop.close()
    assert loop.queue.handled_at_s == came_s
    assert [event["event"] for event in axis.take_events()] == ["internal_error"]
