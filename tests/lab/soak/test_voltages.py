"""A soak judges the voltages that were sent: a stage that keeps to its own limits hides what it was asked for."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dehyst.lab.soak.controller import AXIS, STAGE, ControlTask
from dehyst.lab.soak.observed import FaultRecord, Monitor, Observations, SampleTracker
from dehyst.service.protocol import samples as wire
from dehyst.service.runtime.session import open_router
from tests.lab.soak.soaked import broken, healthy, verdict

CONTROL = ControlTask(1e-3, 4.0, 80.0, 3, -2.0, 10.0, 4000.0)
STEP_V = 4.0
FIRST = 1_000_000_000


class Driven:
    """A stage of a soak that clamps what it is sent as `service.stage_node.node` does, and the track that sees both."""

    def __init__(self, first: int = FIRST) -> None:
        self.now = 10.0
        self.track = SampleTracker(CONTROL, lambda: self.now)
        self.rest(first)

    def rest(self, first: int) -> None:
        """Another life: rested, counting from ``first``."""
        self._k, self._u_V, self._last_V = first, 0.0, 0.0
        self._commands: dict[int, float] = {}

    def send(self, first: int, *u_V: float, reaches: bool = True, seen: bool = True) -> None:
        if reaches:
            self._commands |= dict(zip(range(first, first + len(u_V)), u_V, strict=True))
        if seen:
            self.track.command(first, np.array(u_V))

    def run(self, stop: int) -> None:
        """Until sample ``stop``."""
        for k in range(self._k, stop):
            self._last_V = self._commands.get(k, self._last_V)
            wanted = min(max(self._last_V, CONTROL.u_min_V), CONTROL.u_max_V)
            self._u_V = min(max(wanted, self._u_V - STEP_V), self._u_V + STEP_V)
            one = np.array([k], dtype=np.int64)
            self.track.take(wire.SampleBatch(one, one * 1e-3, np.array([self._u_V]), np.array([40.0])))
        self._k = stop

    def broken(self, *faults: FaultRecord) -> set[str]:
        observed = healthy()
        observed.faults += faults
        observed.seconds += [second for second in self.track.seconds if second.t_s >= 40.0]
        return {name for name in broken(verdict(observed)) if name.startswith("voltages")}


@pytest.fixture
def driven() -> Driven:
    driven = Driven()
    driven.now = 45.0
    driven.send(FIRST, 0.0, 1.0, 2.0)
    driven.run(FIRST + 3)
    return driven


def test_what_is_safe_breaks_nothing(driven: Driven) -> None:
    driven.send(FIRST + 3, 6.0, 10.0, 6.0)
    driven.run(FIRST + 6)
    assert driven.broken() == set()
    assert driven.track.seconds[-1].step_V == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("block", "name"),
    [
        ((2.0, 7.0, 7.0), "voltages_within_slew"),
        ((7.0, 7.0, 7.0), "voltages_within_slew"),
        ((6.0, 10.0, 10.5), "voltages_within_limits"),
        ((0.0, -2.01, 0.0), "voltages_within_limits"),
        ((2.0, float("nan"), 2.0), "voltages_finite"),
    ],
)  # fmt: skip
def test_what_the_stage_clamps_breaks_the_run_as_it_was_sent(
    driven: Driven, block: tuple[float, ...], name: str
) -> None:
    driven.send(FIRST + 3, *block)
    driven.run(FIRST + 3 + (0 if name == "voltages_finite" else len(block)))
    assert driven.broken() == {name}


def test_a_jump_at_a_take_over_is_one_of_what_was_sent(driven: Driven) -> None:
    driven.send(FIRST + 3, 8.0)
    driven.run(FIRST + 4)
    fault = FaultRecord("kill_primary", 44.5, 44.5)
    assert driven.broken(fault) == {"voltages_within_slew"}


def test_a_block_may_be_sent_anew_from_the_voltage_before_it(driven: Driven) -> None:
    driven.send(FIRST + 3, 6.0, 9.0)
    driven.send(FIRST + 3, -1.0, -2.0)
    driven.run(FIRST + 5)
    assert driven.broken() == set()
    driven.send(FIRST + 5, 9.0)
    assert driven.broken() == {"voltages_within_slew"}, "from what replaced the first, not from what it replaced"


def test_over_samples_without_a_command_the_stage_holds(driven: Driven) -> None:
    """A controller that gave a block up begins the next where the last one that it sent has ended."""
    driven.run(FIRST + 23)
    driven.send(FIRST + 23, 6.0)
    driven.run(FIRST + 24)
    assert driven.broken() == set()
    driven.run(FIRST + 40)
    driven.send(FIRST + 40, -1.0)
    driven.run(FIRST + 41)
    assert driven.broken() == {"voltages_within_slew"}


def test_while_no_router_is_there_what_was_sent_may_have_come_to_nobody(driven: Driven) -> None:
    driven.send(FIRST + 3, 6.0, 10.0, reaches=False, seen=False)
    driven.send(FIRST + 5, 9.0)
    driven.run(FIRST + 6)
    assert driven.broken(FaultRecord("restart_router", 44.5, 44.6)) == set()
    assert driven.broken() == {"voltages_within_slew"}


def test_the_first_block_of_a_life_follows_nothing(driven: Driven) -> None:
    driven.send(FIRST + 3, 6.0, 10.0)
    driven.run(FIRST + 5)
    driven.rest(7)
    driven.send(7, -1.0, -1.0)
    driven.run(9)
    assert driven.broken() == set()
    driven.send(9, 8.0)
    assert driven.broken() == {"voltages_within_slew"}


def test_a_command_that_cannot_be_read_is_no_safe_one(free_port: int) -> None:
    """NaN does not pass the wire's own decoder; that it was sent is what counts."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_router([endpoint]) as server:
        monitor = Monitor(endpoint, CONTROL, time.monotonic() - 45.0)
        try:
            key = f"dehyst/v1/{STAGE}/{AXIS}/command"
            good = wire.encode_command(FIRST, [0.0, 1.0])
            poisoned = good[:-8] + struct.pack("<d", float("nan"))
            _until(lambda: _sent(server, key, good) and bool(monitor.track.seconds))
            assert sum(s.not_finite for s in monitor.track.seconds) == 0
            server.put(key, poisoned)
            _until(lambda: monitor.malformed > 0)
            assert sum(s.not_finite for s in monitor.track.seconds) == 1
            observed: Observations = healthy()
            observed.seconds += monitor.track.seconds
            assert broken(verdict(observed)) == {"voltages_finite"}
        finally:
            monitor.close()


def _sent(session: Any, key: str, payload: bytes) -> bool:
    session.put(key, payload)
    return True


def _until(done: Callable[[], bool], patience_s: float = 10.0) -> None:
    end = time.monotonic() + patience_s
    while not done():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.02)
