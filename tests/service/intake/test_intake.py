"""Between the wire and the learner: messages that wait, work between them, a full queue, the age of what is handled."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from dehyst.adaptive.types import InverseModel
from dehyst.service.intake.sample_queue import MOST_TOGETHER
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server import axis_loop
from dehyst.service.server.axis_loop import AxisLoop
from tests.service.axes import loop_of
from tests.service.living import eventually
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


# --- Commands of operators: in front of what waits, and what is said of them is true.


def test_a_command_does_not_wait_for_the_samples_that_wait(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models, queue_samples=20_000)
    sizes: list[int] = []
    handle, begun, may_go = axis.handle, threading.Event(), threading.Event()

    def held(batch: SampleBatch, *more: Any) -> list[str]:
        sizes.append(len(batch))
        begun.set()
        may_go.wait(30.0)
        return handle(batch, *more)

    axis.handle = held  # type: ignore[method-assign]
    loop = loop_of(axis)
    for part in parts(recording(8000), 100):
        assert loop.offer(part)
    loop.start()
    try:
        assert begun.wait(30.0)
        answers: list[int] = []
        command = threading.Thread(
            target=lambda: answers.append(loop.queue.call(lambda: axis.freeze("alice"), 30.0, urgent=True))
        )
        command.start()
        eventually(lambda: loop.queue._urgent)  # the samples of one batch are being handled, and 7500 wait before it
        may_go.set()
        command.join()
        assert axis.frozen
        assert answers == [sizes[0] - 1]
        eventually(lambda: axis.handled_seq == 7999)
    finally:
        may_go.set()
        loop.close()
    assert max(sizes) <= MOST_TOGETHER


def test_work_that_was_given_up_is_never_done(models: dict[str, InverseModel]) -> None:
    loop = loop_of(make_axis(models))
    loop.start()
    done: list[str] = []
    begun, may_go = threading.Event(), threading.Event()
    blocker = threading.Thread(target=lambda: loop.queue.call(lambda: (begun.set(), may_go.wait(30.0)), 30.0))
    blocker.start()
    assert begun.wait(30.0)
    try:
        with pytest.raises(ServiceError, match=r"did not get to it within 0.1 s; it was not applied"):
            loop.queue.call(lambda: done.append("late"), 0.1, urgent=True)
        may_go.set()
        blocker.join()
        loop.queue.call(lambda: None)
    finally:
        loop.close()
    assert done == []


def test_the_end_does_not_wait_for_a_full_queue(
    models: dict[str, InverseModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(axis_loop, "DRAIN_S", 0.3)
    axis = make_axis(models, queue_samples=20_000)
    handle = axis.handle

    def slowly(batch: SampleBatch, *more: Any) -> list[str]:
        time.sleep(4e-4 * len(batch))
        return handle(batch, *more)

    axis.handle = slowly  # type: ignore[method-assign]
    handled: list[int] = []
    waited: list[int] = []

    class Sink:
        def put(self, seq: Any, *rest: Any) -> bool:
            (waited if rest[-1] == "waited" else handled).extend(seq.tolist())
            return True

        def put_aside(self, seq: Any, *rest: Any) -> bool:
            raise AssertionError("apart from the others")

        def rebase(self, index: int) -> None: ...
        def counters(self) -> dict[str, Any]:
            return {}

        def close(self, timeout_s: float = 1.0) -> bool:
            return True

    loop = loop_of(axis, Sink())
    for part in parts(recording(8000), 100):
        assert loop.offer(part)
    loop.start()
    begin_s = time.monotonic()
    loop.close()
    assert time.monotonic() - begin_s < 3.0, "8000 samples take 3.2 s"
    # In the order of handling, so that the next start learns them.
    assert handled == list(range(axis.handled_seq + 1))
    assert waited == list(range(axis.handled_seq + 1, 8000))
    assert (loop.queue.dropped, loop.queue.waiting) == (len(waited), 0)
    event = axis.take_events()[-1]
    assert event["event"] == "stopped_behind"
    assert event["detail"].startswith(f"{len(waited)} samples still waited; they are in the recording")
