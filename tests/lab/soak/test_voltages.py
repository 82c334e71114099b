"""A soak judges the voltages that were sent: a stage that keeps to its own limits hides what it was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.lab.soak.controller import ControlTask
from dehyst.lab.soak.observed import FaultRecord, SampleTracker
from dehyst.service.protocol import samples as wire
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


def test_a_block_may_be_sent_anew_from_the_voltage_before_it(driven: Driven) -> None:
    driven.send(FIRST + 3, 6.0, 9.0)
    driven.send(FIRST + 3, -1.0, -2.0)
    driven.run(FIRST + 5)
    assert driven.broken() == set()
    driven.send(FIRST + 5, 9.0)
    assert driven.broken() == {"voltages_within_slew"}, "from what replaced the first, not from what it replaced"
