"""The one closed loop: what is asked for when, and how one answer continues the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dehyst.lab.loop import Asker, stepped, turns
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.service.conftest import DT_S, make_models

LIMITS = Limits(0.0, 10.0, 2000.0)
BLOCK = 20


@given(blocks=st.integers(0, 40), ahead=st.integers(0, 6))
def test_a_block_is_asked_for_when_those_before_the_blocks_under_way_have_run(blocks: int, ahead: int) -> None:
    run: list[int] = []
    asked: list[int] = []
    for done, due in turns(blocks, ahead):
        if done is not None:
            assert done in asked
            run.append(done)
        if due is not None:
            assert run == list(range(max(0, due - ahead)))
            asked.append(due)
    assert run == asked == list(range(blocks))


@pytest.mark.parametrize("age", [1, 3])
def test_step_by_step_a_reading_comes_so_many_samples_late(age: int) -> None:
    told: list[tuple[int, float, float, int]] = []

    class Noting:
        at = -1

        def read(self, k: int, u_V: float, y_um: float) -> None:
            told.append((k, u_V, y_um, self.at))

        def voltage(self, k: int) -> float:
            self.at = k
            return float(k)

    got = stepped(Noting(), 6, age, lambda k, u_V: (10.0 * u_V.item(), 10.0 * u_V.item() + 1.0))
    # Before voltage k comes the reading of sample k - age, with the voltage that it got.
    assert told == [(k - age, k - age, 10.0 * (k - age) + 1.0, k - 1) for k in range(age, 6)]
    assert got.u_V.tolist() == list(range(6))
    assert got.true_um.tolist() == [10.0 * k for k in range(6)]
    assert got.read_um.tolist() == [10.0 * k + 1.0 for k in range(6)]


def an_axis() -> Axis:
    bundle = Bundle(make_models(), BundleMeta("loop", "x", DT_S))
    return load_axis("loop", AxisConfig("x", Path("model"), LIMITS, snapshot_every=BLOCK), bundle=bundle)


@pytest.mark.parametrize("tracked", [True, False])
def test_each_answer_continues_the_one_before(tracked: bool) -> None:
    """In voltage, by the slew limit, and in memory: the answer for a point depends on the way to it."""
    axis = an_axis()
    ask = Asker(axis, tracked=tracked, u_before_V=0.0)
    level, still = np.full(BLOCK, 30.0), np.zeros(BLOCK)
    step_V = LIMITS.slew_V_per_s * DT_S * (1.0 + 1e-9)
    before_V, ends = 0.0, []
    for block, y_um in enumerate((level, level + 20.0, level)):
        answer = ask(block * BLOCK, (y_um, still, still))
        assert np.abs(np.diff(answer.u_V, prepend=before_V)).max() <= step_V
        before_V = float(answer.u_V[-1])
        ends.append(before_V)
    assert ends[2] < ends[0] < ends[1], "hysteresis: the way back needs less voltage"
    alone = Asker(axis, tracked=tracked, u_before_V=0.0)(0, (level, still, still))
    assert float(alone.u_V[-1]) == ends[0]
