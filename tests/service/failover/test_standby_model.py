"""A standby before, while and after it is given the state; what it goes on from where it was given none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dehyst.adaptive.errors import ModelFileError
from dehyst.service.failover.standby_model import NOT_SYNCED, StandbyModel, newer_than, standby_folder
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loop import AxisLoop
from dehyst.service.storage.checkpoint import encode_checkpoint
from dehyst.service.storage.recorder import Recorder, RecorderConfig
from tests.service.axes import loop_of
from tests.service.storage.test_stored_files import make_axis, meta, recording, same


class Sink:
    """Keeps what a recorder is given."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, str]] = []
        self.index = -1

    def put(self, seq: Any, t_s: Any, u_V: Any, y_um: Any, reason: str | list[str]) -> bool:
        words = [reason] * len(seq) if isinstance(reason, str) else reason
        self.rows += zip(seq.tolist(), words, strict=True)
        return True

    def put_aside(self, seq: Any, t_s: Any, u_V: Any, y_um: Any, reason: str | list[str]) -> bool:
        return True

    def rebase(self, index: int) -> None:
        self.index = index

    def counters(self) -> dict[str, Any]:
        return {}

    def close(self, timeout_s: float = 0.0) -> bool:
        return True


def standby(kept: int = 30_000, on_gap: Callable[[], None] = lambda: None) -> tuple[Axis, StandbyModel, Sink, AxisLoop]:
    axis, sink = make_axis(), Sink()
    loop = loop_of(axis, sink)
    model = StandbyModel(axis, sink, kept, on_gap=on_gap)
    loop.set_gate(model.gate)
    return axis, model, sink, loop


def state_of(of: Axis, **changes: Any) -> bytes:
    return b"".join(encode_checkpoint(meta(of, **changes), of.state_dict()))


def test_every_sample_is_recorded_once_and_the_model_is_the_same_to_the_last_bit() -> None:
    serving = make_axis()
    axis, model, sink, loop = standby()
    serving.handle(recording(0, 400))
    for first in range(300, 500, 5):
        loop.handle(recording(first, 5))
    assert [seq for seq, _ in sink.rows] == list(range(300, 500))
    assert {word for _, word in sink.rows} == {NOT_SYNCED}
    assert (axis.handled_seq, model.synced) == (-1, False)

    model.take_state(state_of(serving))
    serving.handle(recording(400, 100))
    assert model.synced
    assert same(serving, axis)
    assert sink.index == axis.sequence.received == 500
    for first in range(500, 600, 5):
        serving.handle(recording(first, 5))
        loop.handle(recording(first, 5))
    assert same(serving, axis)
    assert [seq for seq, _ in sink.rows] == list(range(300, 600))
    assert NOT_SYNCED not in {word for seq, word in sink.rows if seq >= 500}


def test_a_stage_that_began_anew_while_samples_were_held_back_does_not_confuse_them() -> None:
    """Its numbers are lower than before: what came before the state is told by the order, not by the number."""
    serving = make_axis()
    axis, model, _, loop = standby()
    serving.handle(recording(10_000, 300))
    for first in (*range(10_200, 10_300, 5), *range(0, 400, 5)):
        loop.handle(recording(first, 5))
    for first in range(0, 300, 5):
        serving.handle(recording(first, 5))
    assert serving.sequence.restarts == 1
    model.take_state(state_of(serving))
    for first in range(300, 400, 5):
        serving.handle(recording(first, 5))
    assert axis.sequence.counters() == serving.sequence.counters()
    assert same(serving, axis)


@pytest.mark.parametrize("late", [range(380, 420, 5), range(383, 423, 5)])
def test_a_state_that_overtakes_samples_that_it_includes_counts_them_once(late: range) -> None:
    """Each in its message, and with one message half in the state."""
    serving = make_axis()
    axis, model, _, loop = standby()
    serving.handle(recording(0, 400))
    for first in range(300, late[0], 5):
        loop.handle(recording(first, min(5, late[0] - first)))
    model.take_state(state_of(serving))
    for first in late:
        loop.handle(recording(first, 5))
    serving.handle(recording(400, late[-1] - 395))
    assert axis.sequence.counters() == serving.sequence.counters()
    assert axis.gates == serving.gates
    assert same(serving, axis)


def test_a_stage_that_begins_anew_right_after_the_state_is_heard() -> None:
    serving = make_axis()
    axis, model, _, loop = standby()
    serving.handle(recording(10_000, 400))
    loop.handle(recording(10_300, 50))
    model.take_state(state_of(serving))
    for first in range(0, 300, 5):
        serving.handle(recording(first, 5))
        loop.handle(recording(first, 5))
    assert axis.sequence.restarts == serving.sequence.restarts == 1
    assert same(serving, axis)


@given(st.lists(st.integers(0, 30), min_size=1, max_size=20, unique=True), st.integers(1, 4), st.integers(-1, 31))
def test_behind_is_what_came_after(numbers: list[int], size: int, seq: int) -> None:
    cuts = [np.array(numbers[i : i + size], dtype=np.int64) for i in range(0, len(numbers), size)]
    batches = [SampleBatch(cut, *(cut.astype(float) for _ in range(3))) for cut in cuts]
    found = [int(n) for batch in newer_than(batches, seq) for n in batch.seq]
    at = numbers.index(seq) + 1 if seq in numbers else None
    assert found == (numbers[at:] if at is not None else [n for n in numbers if n > seq])


@pytest.mark.parametrize(("first", "expected"), [(400, 0), (405, 1)])
def test_a_sample_that_is_neither_in_the_state_nor_behind_it_is_noticed(first: int, expected: int) -> None:
    gaps: list[int] = []
    serving = make_axis()
    serving.handle(recording(0, 400))
    _, model, _, loop = standby(on_gap=lambda: gaps.append(1))
    model.take_state(state_of(serving))
    loop.handle(recording(first, 5))
    loop.handle(recording(first + 50, 5))  # a gap later on is the stage's own
    assert len(gaps) == expected


def test_a_state_of_another_axis_is_refused_and_the_samples_are_still_recorded() -> None:
    serving = make_axis()
    serving.handle(recording(0, 100))
    _, model, sink, loop = standby()
    with pytest.raises(ModelFileError, match="axis is 'y'"):
        model.take_state(state_of(serving, axis="y"))
    loop.handle(recording(100, 5))
    assert not model.synced
    assert len(sink.rows) == 5


def test_without_a_state_it_learns_all_that_was_held_back() -> None:
    axis, model, sink, loop = standby()
    for first in range(0, 300, 5):
        loop.handle(recording(first, 5))
    told = model.take_over()
    assert "the model file, then 300 samples" in told
    assert model.take_over() == ""
    alone = make_axis()
    alone.handle(recording(0, 300))
    assert same(axis, alone)
    assert len(sink.rows) == 300


def test_what_is_no_longer_remembered_is_learnt_from_the_journal(tmp_path: Path) -> None:
    axis = make_axis()
    axis.config = replace(axis.config, recorder=tmp_path)
    with Recorder(RecorderConfig(tmp_path, flush_s=0.005)) as recorder:
        loop = loop_of(axis, recorder)
        model = StandbyModel(axis, recorder, kept=50)
        loop.set_gate(model.gate)
        for first in range(0, 600, 5):
            loop.handle(recording(first, 5))
        while recorder.counters()["written"] < 600:
            pass
        model.take_over()
    alone = make_axis()
    alone.handle(recording(0, 600))
    assert axis.handled_seq == 599
    assert axis.sequence.lost == 0
    assert same(axis, alone)


def test_the_standby_keeps_its_files_beside_those_of_the_other() -> None:
    assert standby_folder(Path("a/rec")) == Path("a/rec-standby")
    assert standby_folder(None) is None
