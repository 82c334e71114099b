"""Frozen is frozen to the last bit: what comes in changes no answer to a query with its own memory, until thaw."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.forged_states import DT_S, make_axis, recording
from dehyst.adaptive.types import FloatArray
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.storage.checkpoint import CheckpointMeta, decode_checkpoint, encode_checkpoint

LEARNT, STEP = 1500, 20


def feed(axis: Axis, first: int, n: int, change: str = "") -> None:
    """n samples; ``change``: what has happened to the stage or to its sensor."""
    for start in range(first, first + n, STEP):
        batch = recording(start, STEP, "stuck" if change == "stuck" else "")
        y_um: FloatArray = batch.y_um
        if change == "step":
            y_um = y_um + 20.0
        elif change == "gain":
            y_um = 0.75 * y_um
        elif change == "not finite":
            y_um = np.where(batch.seq // 10 % 2 == 0, np.nan, y_um)
        elif change == "wild":
            y_um = y_um * np.exp(np.random.default_rng(start).normal(0.0, 3.0, STEP))
        axis.handle(SampleBatch(batch.seq, batch.t_s, batch.u_V, y_um))


def answers(axis: Axis, memories: dict[str, FloatArray]) -> dict[str, Any]:
    """Answers of every model, inside of its domain and beyond, to queries with ``memories``; and the fingerprint."""
    y_um = np.linspace(2.0, 89.0, 40)
    got: dict[str, Any] = {"fingerprint": fingerprint(axis.newest.models["lssvm_adaptive"])}
    for name, memory in memories.items():
        for v in (0.0, 300.0, 1e5):
            reply = axis.answer(FeedforwardQuery(y_um, np.full(40, v), np.zeros(40), memory=memory, model=name))
            got[f"{name} {v:g}"] = (
                reply.u_V.tobytes(),
                reply.std_V.tobytes(),
                reply.memory.tobytes(),
                reply.flags.tobytes(),
            )
    return got


@pytest.mark.parametrize(
    ("alone", "change"),
    [*((True, change) for change in ("", "step", "gain", "stuck", "not finite", "wild")), (False, "wild")],
)
def test_frozen_is_frozen_to_the_last_bit(alone: bool, change: str) -> None:
    axis = make_axis(alone)
    feed(axis, 0, LEARNT)
    axis.freeze("alice")
    memories = {name: memory.copy() for name, memory in axis.newest.memories.items()}
    before = answers(axis, memories)
    first = LEARNT
    for _ in range(4):
        feed(axis, first, 500, change)
        first += 500
        assert answers(axis, memories) == before
    axis.update_age(1000.0)  # no samples for long: the model is none the worse
    assert {key: value[:3] for key, value in answers(axis, memories).items() if key != "fingerprint"} == {
        key: value[:3] for key, value in before.items() if key != "fingerprint"
    }
    axis.update_age(0.0)
    # What another process goes on from holds it too.
    other = make_axis(alone)
    meta = CheckpointMeta("demo", "x", DT_S, axis.handled_seq, axis.sequence.received)
    other.restore(decode_checkpoint(b"".join(encode_checkpoint(meta, axis.state_dict())))[1])
    assert other.frozen
    assert answers(other, memories) == before
    feed(other, first, 500, change)
    feed(axis, first, 500, change)
    assert answers(other, memories) == answers(axis, memories) == before
    for name, memory in axis.newest.memories.items():
        np.testing.assert_array_equal(memory, other.newest.memories[name])
    axis.thaw("alice")
    # The same stage moves more slowly: its gain, which the models do not know, is learnt.
    for start in range(first + 500, first + 4500, STEP):
        k = np.arange(start, start + STEP)
        slow_um = 45.0 + 25.0 * np.sin(2.0 * np.pi * 0.5 * k * DT_S)
        axis.handle(SampleBatch(k, k * DT_S, (slow_um - 1.0) / (11.0 * 0.95), slow_um))
    assert answers(axis, memories) != before


def test_a_memory_that_the_service_tracks_follows_the_stage_while_frozen() -> None:
    axis = make_axis(alone=True)
    feed(axis, 0, LEARNT)
    axis.freeze("alice")
    before = axis.newest.memories["lssvm_adaptive"]
    feed(axis, LEARNT, 130)
    assert not np.array_equal(before, axis.newest.memories["lssvm_adaptive"])
