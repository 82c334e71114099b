"""The changes of a followed model: their sum is the model, they are small, and nothing depends on who follows."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.client.follower import Follower
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.delta import FollowedState, decode_delta
from dehyst.service.protocol.model import check_model
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.security.access import access_control
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis, make_learner
from dehyst.service.server.deltas import DeltaStreams
from dehyst.service.storage.model_file import Bundle, BundleMeta

DT_S = 1e-3
LIMITS = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
META = BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0)


def make_axis(models: dict[str, InverseModel], compete: tuple[str, ...]) -> Axis:
    config = AxisConfig("x", Path("x.npz"), LIMITS, compete=compete)
    return load_axis("demo", config, make_learner, Bundle(models, META))


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
        self.axis, self.sent = axis, list[bytes]()
        self.streams = DeltaStreams(axis)
        self.streams.publish(name, self.sent.append, lambda: True)
        self.now_s = 0.0
        self.tick()
        session: Any = self
        payload = self.streams.payload(name)
        assert payload is not None
        self.follower = Follower(session, "delta", name, lambda: payload, LIMITS, deltas=True, keep=8)

    def declare_subscriber(self, key: str, deliver: Any) -> Any:
        self.deliver = deliver
        return SimpleNamespace(undeclare=lambda: None)

    def tick(self) -> list[bytes]:
        self.now_s += 0.005
        self.streams.tick(self.now_s)
        sent, self.sent[:] = list(self.sent), []
        return sent

    def pass_on(self, payload: bytes) -> None:
        self.deliver(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


@pytest.mark.parametrize(("name", "compete"), [("lssvm_adaptive", ()), ("auto", ("linear",))])
def test_the_sum_is_the_model_to_the_last_bit(
    models: dict[str, InverseModel], name: str, compete: tuple[str, ...]
) -> None:
    axis = make_axis(models, compete)
    wire = Wire(axis, name)
    follower = wire.follower
    small, seen, volts = [], [], []
    still = np.zeros(1)
    for batch in batches(3000):
        axis.handle(batch)
        for payload in wire.tick():
            message = decode_delta(payload)
            snapshot = axis.newest.seq in batch.seq
            if not message.model and not snapshot:
                small.append(len(payload))
            wire.pass_on(payload)
        seen.append(follower.snapshot_seq)
        model: Any = follower.model
        learnt = model.models[0] if compete else model
        volts.append(learnt.feedforward(still + 60.0, still, still, learnt.rest_memory(60.0)).u_V[0])
        if seen[-1] % 500 == 499:
            whole = FollowedState.decode(wire.streams.payload(name) or b"").message()
            y, v, a = 40.0 + 0.1 * np.arange(30), np.full(30, 100.0), np.zeros(30)
            got = follower.answer(FeedforwardQuery(y, v, a))
            np.testing.assert_array_equal(got.u_V, whole.model.feedforward(y, v, a, whole.memory).u_V)
            np.testing.assert_array_equal(got.std_V, whole.model.feedforward(y, v, a, whole.memory).std_V)
    changes = follower.changes
    assert changes is not None
    assert (changes.lost, changes.mismatches, changes.refused, changes.repairs) == (0, 0, 0, 0)
    assert max(small) <= 2048
    behind = np.arange(4, 3000, 5) - np.array(seen)
    assert np.mean(behind == 0) > 0.9, "a change with every batch that was learnt"
    assert volts[-1] > 1.04 * volts[280], "the change of the gain came by changes"


def test_a_snapshot_is_passed_exactly(models: dict[str, InverseModel]) -> None:
    """Where nothing has moved since, the sum is the snapshot that queries are answered from."""
    axis = make_axis(models, ())
    wire = Wire(axis, "lssvm_adaptive")
    for batch in batches(421, 1):
        axis.handle(batch)
        for payload in wire.tick():
            wire.pass_on(payload)
    assert wire.follower.snapshot_seq == axis.newest.seq == 420
    model, _, memory = axis.model("lssvm_adaptive")
    y, v, a = 40.0 + 0.1 * np.arange(30), np.full(30, 100.0), np.zeros(30)
    got, expected = wire.follower.answer(FeedforwardQuery(y, v, a)), model.feedforward(y, v, a, memory)
    np.testing.assert_array_equal(got.u_V, expected.u_V)
    asked = axis.answer(FeedforwardQuery(y, v, a, model="lssvm_adaptive"))
    np.testing.assert_array_equal(got.u_V, asked.u_V)


def test_what_is_learnt_and_answered_does_not_depend_on_who_follows(models: dict[str, InverseModel]) -> None:
    followed, alone = make_axis(models, ("linear",)), make_axis(models, ("linear",))
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


def test_long_messages_move_at_the_same_samples(models: dict[str, InverseModel]) -> None:
    """A message that the stage sends late holds more samples; what a controller plans by numbers stays the same."""
    seen = []
    for size in (5, 10, 40):
        axis = make_axis(models, ())
        axis.moves.want(frozenset(("lssvm_adaptive",)))
        numbers = []
        for batch in batches(1200, size):
            axis.handle(batch)
            numbers += [move.seq for move in axis.moves.drain()]
        seen.append(numbers)
    assert seen[0] == seen[1] == seen[2]
    assert len(seen[0]) > 200


def test_a_reader_that_gets_other_numbers_does_not_fetch_the_model_for_ever(
    models: dict[str, InverseModel], caplog: pytest.LogCaptureFixture
) -> None:
    """As one of JSON that does not round to the nearest double: no fingerprint of a fetched model is the service's."""
    axis = make_axis(models, ())
    wire = Wire(axis, "lssvm_adaptive")
    changes = wire.follower.changes
    assert changes is not None
    fetches, rounds = 0, False

    def fetch() -> bytes:
        nonlocal fetches
        fetches += 1
        payload = wire.streams.payload("lssvm_adaptive") or b""
        if rounds:
            return payload
        header, arrays, seq = check_model(payload)
        values = dict(header["values"])
        values["span_V"] = math.nextafter(values["span_V"], math.inf)
        return FollowedState.of({**header, "values": values}, arrays, seq).payload()

    changes._fetch = fetch
    changes._state = FollowedState.decode(fetch())
    begin_s, until_s = time.monotonic(), math.inf
    for batch in itertools.islice(batches(60_000), 12_000):
        axis.handle(batch)
        for payload in wire.tick():
            wire.pass_on(payload)
        time.sleep(2e-3)
        now_s = time.monotonic()
        if now_s - begin_s > 2.0 and not rounds:
            # 10, 20, 40 ... ms: the ninth is due after 1.27 s, and the tenth after 2.55 s.
            assert 3 <= fetches <= 10
            assert [r.getMessage() for r in caplog.records if "fingerprint: got others" in r.getMessage()] == [
                changes.last_error
            ]
            rounds, until_s = True, now_s + 5.0
        if now_s > until_s or (rounds and changes.changes > 3):
            break
    assert changes.changes > 3
    assert changes.fruitless == 0
    assert len([r for r in caplog.records if "fingerprint" in r.getMessage()]) == 1


def test_only_a_service_may_publish_changes() -> None:
    users = {role: role for role in ("client", "controller", "stage", "operator", "service")}
    control = access_control(users, {"stage": "*"})
    rules = {rule["id"]: rule for rule in control["rules"]}
    puts = {
        policy["id"]: [
            key for rule in policy["rules"] if "put" in rules[rule]["messages"] and rules[rule]["flows"] == ["ingress"]
            and rules[rule]["permission"] == "allow" for key in rules[rule]["key_exprs"]
        ]
        for policy in control["policies"]
    }  # fmt: skip
    for role, keys in puts.items():
        may = any(key.endswith(("**", "_delta")) for key in keys)
        assert may == (role == "service"), role
