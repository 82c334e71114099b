"""A stop that is neither lost nor leaves anything behind."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from dehyst.lab.testbed import processes
from dehyst.lab.testbed.processes import Child, Children
from dehyst.service.runtime.stopping import StopSignal, unbroken

SLEEPER = ["-c", "import time; print('up', flush=True); time.sleep(60)"]


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, and StopSignal leaves it so
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def interrupt(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)
    signal.sigtimedwait([], 0.01)  # a step of the interpreter in which it is delivered


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_raises_at_once(number: int) -> None:
    stop = StopSignal(raising=True)
    stop.look()
    with pytest.raises(KeyboardInterrupt):
        interrupt(number)
    assert stop.reason == signal.Signals(number).name


def test_what_was_swallowed_is_raised_at_the_next_look() -> None:
    stop = StopSignal(raising=True)
    with contextlib.suppress(KeyboardInterrupt):
        interrupt()
    with pytest.raises(KeyboardInterrupt):
        stop.look()


def test_a_block_that_must_not_be_broken_ends_first() -> None:
    stop = StopSignal(raising=True)
    done = []

    def work() -> None:
        with unbroken():
            interrupt()
            interrupt(signal.SIGTERM)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == [True]
    assert stop.reason == "SIGINT"
    with pytest.raises(KeyboardInterrupt):
        interrupt()


def test_a_child_that_was_being_started_is_not_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    StopSignal(raising=True)
    started: list[Child] = []

    class Interrupted(Child):
        def __init__(self, name: str, arguments: list[str], log: Path) -> None:
            super().__init__(name, arguments, log)
            started.append(self)
            interrupt()

    monkeypatch.setattr(processes, "Child", Interrupted)
    with pytest.raises(KeyboardInterrupt), Children(tmp_path) as children:
        children.start("sleeper", SLEEPER)
    assert len(started) == 1
    assert not started[0].running


def test_a_second_signal_while_stopping_leaves_none_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    StopSignal(raising=True)
    stop = Child.stop

    def interrupted(child: Child, timeout_s: float = 10.0) -> None:
        interrupt()
        stop(child, timeout_s)

    monkeypatch.setattr(Child, "stop", interrupted)
    started: list[Child] = []

    def work() -> None:
        with Children(tmp_path) as children:
            started.extend(children.start(name, SLEEPER) for name in ("one", "two"))
            for child in started:
                child.wait_line("up", 20.0)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert len(started) == 2
    assert not any(child.running for child in started)


def test_the_handler_takes_no_lock_that_the_interrupted_code_may_hold() -> None:
    """A signal whose handler is entered twice, and a wait that is over at once afterwards."""
    stop = StopSignal()
    for _ in range(70_000):  # more than the pipe holds
        stop._on_signal(signal.SIGTERM, None)
    assert stop.wait(60.0) == "SIGTERM"
    assert StopSignal().wait(0.01) == "time is over"
