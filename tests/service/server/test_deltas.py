"""The changes of a followed model: near the newest snapshot, small, and nothing depends on who follows."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import InverseModel
from dehyst.service.client.follower import Follower
from dehyst.service.protocol.model import decode_model
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import DELTA, MODEL, SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.server.moves import WHOLE_S
from tests.service.server.test_axis import LIMITS, make_axis

DT_S = 1e-3


def batches(n: int, size: int = 5, jump_at: int = 1500) -> Iterator[SampleBatch]:
    """n samples of a stage whose gain is 5 % less than the models believe, and 6 % less again from a moment on."""
    k = np.arange(n)
    u = (45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S) - 1.0) / (11.0 * 0.95)
    y = np.where(k < jump_at, 1.0, 0.94) * (11.0 * 0.95 * u + 1.0)
    for i in range(0, n, size):
        yield SampleBatch(k[i : i + size], k[i : i + size] * DT_S, u[i : i + size], y[i : i + size])


class Wire:
    """Streams of an axis, and a follower that gets their messages."""

    def __init__(self, axis: Axis, name: str) -> None:
        self.axis, self.name, self.sent = axis, name, list[bytes]()
        self.streams = DeltaStreams(axis)
        self.streams.publish(name, self.sent.append, lambda: True)
        self.now_s = 0.0
        payload = self.tick()[0]
        assert payload == self.streams.payload(name)
        session: Any = self
        self.follower = Follower(session, "delta", name, lambda: payload, LIMITS, keep=8)

    def declare_subscriber(self, key: str, deliver: Any) -> Any:
        self.deliver = deliver
        return SimpleNamespace(undeclare=lambda: None)

    def tick(self) -> list[bytes]:
        """The messages of one round."""
        self.now_s += 0.005
        self.streams.tick(self.now_s)
        sent, self.sent[:] = list(self.sent), []
        return sent

    def learn(self, batch: SampleBatch) -> list[bytes]:
        """Learn a batch, and pass on what is sent."""
        self.axis.handle(batch)
        sent = self.tick()
        for payload in sent:
            self.deliver(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda payload=payload: payload)))
        return sent


QUESTION = FeedforwardQuery(40.0 + 0.1 * np.arange(30), np.full(30, 100.0), np.zeros(30))


@pytest.mark.parametrize(("name", "compete"), [("lssvm_adaptive", ()), ("auto", ("linear",))])
def test_a_follower_is_at_the_last_batch_and_near_the_newest_snapshot(
    models: dict[str, InverseModel], name: str, compete: tuple[str, ...]
) -> None:
    axis = make_axis(models, compete=compete)
    wire = Wire(axis, name)
    follower = wire.follower
    small, seen, off_V, volts, whole = [], [], [], [], 0
    still = np.zeros(1)
    for batch in batches(3000):
        for payload in wire.learn(batch):
            whole += payload[1] == MODEL
            small += [len(payload)] if payload[1] == DELTA else []
        seen.append(follower.snapshot_seq)
        model: Any = follower.model
        learnt = model.models[0] if compete else model
        volts.append(learnt.feedforward(still + 60.0, still, still, learnt.rest_memory(60.0)).u_V[0])
        if axis.newest.seq == batch.seq[-1] - 4:  # a snapshot, and four samples more
            snapshot, _, memory = axis.model(name)
            expected = snapshot.feedforward(QUESTION.y_um, QUESTION.v_um_per_s, QUESTION.a_um_per_s2, memory)
            off_V.append(np.abs(follower.answer(QUESTION).u_V - expected.u_V).max())
    assert (follower.lost, follower.refused) == (0, 0)
    assert max(small) <= 1024
    assert whole <= 3.0 / WHOLE_S + 4
    behind = np.arange(4, 3000, 5) - np.array(seen)
    assert np.mean(behind == 0) > 0.9, "a change with every batch that was learnt"
    assert np.median(off_V) < 2e-3
    assert volts[-1] > 1.04 * volts[280], "the change of the gain came by changes"


def test_a_whole_model_is_the_snapshot_that_queries_are_answered_from(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    wire = Wire(axis, "lssvm_adaptive")
    wholes = 0
    for batch in batches(1001, 1):
        if any(payload[1] == MODEL for payload in wire.learn(batch)) and wire.follower.snapshot_seq == axis.newest.seq:
            wholes += 1
            asked = axis.answer(QUESTION._replace(model="lssvm_adaptive"))
            np.testing.assert_array_equal(wire.follower.answer(QUESTION).u_V, asked.u_V)
    assert wholes >= 1


def test_what_an_operator_changes_is_sent_whole_within_a_tenth_of_a_second(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    wire = Wire(axis, "lssvm_adaptive")
    for batch in batches(500):
        wire.learn(batch)
    for change in (axis.freeze, axis.thaw, lambda: axis.restore(axis.state_dict())):
        change()
        *_, payload = dict.fromkeys(payload for _ in range(21) for payload in wire.tick())
        assert decode_model(payload).snapshot_seq == axis.newest.seq


def test_the_last_message_is_sent_once_more_where_none_follows(models: dict[str, InverseModel]) -> None:
    """Zenoh may drop it on the way, and the stage may rest from then on."""
    axis = make_axis(models, compete=())
    wire = Wire(axis, "lssvm_adaptive")
    *learnt, last = batches(500)
    for batch in learnt:
        wire.learn(batch)
    axis.handle(last)
    assert wire.tick()  # lost
    assert wire.follower.snapshot_seq < last.seq[-1]
    again = [payload for _ in range(200) for payload in wire.tick()]
    assert len(again) == 1
    wire.deliver(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: again[0])))
    assert wire.follower.snapshot_seq == last.seq[-1]


def test_what_is_learnt_and_answered_does_not_depend_on_who_follows(models: dict[str, InverseModel]) -> None:
    followed, alone = make_axis(models, compete=("linear",)), make_axis(models, compete=("linear",))
    wire = Wire(followed, "auto")
    for batch in batches(1700):
        followed.handle(batch)
        alone.handle(batch)
        wire.tick()
        assert not alone.moves.waiting
    mine, others = followed.state_dict(), alone.state_dict()
    assert mine.keys() == others.keys()
    for name, value in mine.items():
        np.testing.assert_array_equal(value, others[name], err_msg=name)
