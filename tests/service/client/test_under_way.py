"""What is under way: a query goes on from where the samples say that the stage has been, along what was commanded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.fallback import FADE_S
from dehyst.service.client.client import Client, pending_before, with_pending
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.query import Answer, FeedforwardQuery, Pending, Trajectory
from tests.service.server.test_axis import make_axis, parts, recording


def motion(first: int, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As ``recording`` moves."""
    t = 1e-3 * np.arange(first, first + n)
    w = 2 * np.pi * 3.0
    return 45.0 + 30.0 * np.sin(w * t), 30.0 * w * np.cos(w * t), -30.0 * w * w * np.sin(w * t)


@pytest.mark.parametrize("name", ["lssvm_adaptive", "auto"])
def test_the_memory_is_that_of_the_samples_carried_along_what_is_pending_before(
    models: dict[str, InverseModel], name: str
) -> None:
    """Of what is under way only that counts which the answering snapshot has not seen; the age is then of no matter."""
    axis = make_axis(models, compete=("linear",))
    for part in parts(recording(1001), 20):
        axis.handle(part)
    assert axis.newest.seq == 1000
    y, v, a = motion(1060, 20)
    under = motion(961, 99)[0]
    pending = Pending(961, under, (under - 1.0) / 10.45 + 0.02)
    got = axis.answer(FeedforwardQuery(y, v, a, None, name, pending=pending))
    assert got.tracked_memory
    model, _, memory = axis.model(name)
    # From the last point under way on: what the model asks for more there than was commanded fades.
    still = np.zeros(58)
    carried = model.track(under[40:-1], still, still, pending.u_V[40:-1], memory)
    # Of the motions that the last one may have had, that with the nearest voltage: this one, by the polynomial.
    jerk = 6.0 * (y[0] - 1e-3 * v[0] + 0.5e-6 * a[0] - under[-1]) / 1e-9
    last_v, last_a = v[0] - 1e-3 * a[0] + 0.5e-6 * jerk, a[0] - 1e-3 * jerk
    ways = [(last_v, last_a), ((under[-1] - under[-2]) / 1e-3, 0.0)]
    ways.append(((y[0] - under[-2]) / 2e-3, (v[0] - (under[-1] - under[-3]) / 2e-3) / 2e-3))
    asked = np.array([np.inf])
    for one_v, one_a in ways:
        last = np.concatenate([[under[-1]], y]), np.concatenate([[one_v], v]), np.concatenate([[one_a], a])
        other = model.feedforward(*last, carried).u_V
        asked = other if abs(other[0] - pending.u_V[-1]) < abs(asked[0] - pending.u_V[-1]) else asked
    more_V = pending.u_V[-1] - asked[0]
    assert abs(more_V) > 1e-3
    expected = asked[1:] + more_V * np.exp(-np.arange(1, 21) * (1e-3 / FADE_S))
    np.testing.assert_allclose(got.u_V, expected, atol=1e-12)
    # What was all seen, or nothing, changes nothing.
    old = Pending(900, *(column[:20] for column in pending[1:]))
    for none in (None, old):
        plain = axis.answer(FeedforwardQuery(y, v, a, None, name, pending=none))
        np.testing.assert_array_equal(plain.u_V, axis.answer(FeedforwardQuery(y, v, a, memory, name)).u_V)


def test_what_no_answer_can_have_been_for_is_refused(models: dict[str, InverseModel]) -> None:
    axis = make_axis(models)
    with pytest.raises(FieldError) as refused:
        axis.answer(FeedforwardQuery(*motion(0, 1), pending=Pending(0, np.array([40.0, 99.0]), np.array([4.0, 4.0]))))
    assert refused.value.field == "pending.y_um[1]"


def answer_of(begin: int, y: FloatArray, before: Trajectory | None = None, seen: int = 0) -> Trajectory:
    reply = Answer(0.1 * y, y, np.zeros(y.size, dtype=np.uint8), y, seen, "m", tracked_memory=True)
    return with_pending(reply, pending_before(before, begin), begin, y)


def test_answers_put_what_is_under_way_together() -> None:
    one = answer_of(100, np.arange(20.0))
    two = answer_of(120, 20.0 + np.arange(20.0), one)
    assert two.pending is not None
    assert two.pending.first == 100
    np.testing.assert_array_equal(two.pending.y_um, np.arange(40.0))
    np.testing.assert_allclose(two.pending.u_V, 0.1 * np.arange(40.0))
    # Where nothing was commanded the stage holds its voltage.
    after_a_hole = pending_before(two, 145)
    assert after_a_hole is not None
    assert after_a_hole.y_um.tolist()[-6:] == [39.0] * 6
    # An answer that replaces the end of another one goes on from there.
    replaced = pending_before(two, 130)
    assert replaced is not None
    assert replaced.y_um.tolist() == list(range(30))
    assert (
        pending_before(two, 100)
        is pending_before(two, 7)
        is pending_before(None, 5)
        is pending_before(two, 10_000)
        is None
    )


@pytest.mark.e2e
def test_a_client_that_says_when_its_points_are_due(shared_service: Any) -> None:
    with Client.connect(shared_service.endpoint, timeout_s=5.0) as client:
        first = (int(client.status()["seq"]) // 20 + 100) * 20
        y, v, a = motion(first, 60)
        one = client.trajectory(y[:20], v[:20], a[:20], begin=first)
        two = client.trajectory(y[20:], v[20:], a[20:], begin=first + 20, after=one)
        assert one.tracked_memory
        assert two.tracked_memory
        # Nothing of it was seen: as if the memory had travelled.
        same = client.trajectory(y[20:], v[20:], a[20:], after=one)
        np.testing.assert_allclose(two.u_V, same.u_V, atol=5e-4)
        point = client.point(y[59], v[59], a[59], begin=first + 59, after=two)
        assert point.pending is not None
        assert point.pending.y_um.size == 60
        assert point.u_V == pytest.approx(two.u_V[-1], abs=5e-4)
        with pytest.raises(FieldError, match="begin"):
            client.point(40.0, begin=first, memory=one.memory)


def test_what_begins_far_ahead_of_the_stage_is_answered_and_told(models: dict[str, InverseModel]) -> None:
    """The stage's counter may have jumped; the answer goes on from the snapshot, and nobody can miss it."""
    axis = make_axis(models)
    for part in parts(recording(1001), 20):
        axis.handle(part)

    def ask(first: int) -> FloatArray:
        query = FeedforwardQuery(*motion(0, 1), pending=Pending(first, np.array([40.0]), np.array([4.0])))
        return axis.answer(query).u_V

    ask(100_000)  # nothing has come since the start: the stage may be anywhere
    axis.update_age(0.0)
    near = ask(1001 + 1000 + 4096)
    assert axis.far_ahead == 0
    axis.take_events()
    for first in (1001 + 1000 + 4097, 100_000, 2**61):
        assert np.array_equal(ask(first), near)
    assert axis.far_ahead == 3
    assert [event["event"] for event in axis.take_events()] == ["under_way_ahead"]
    axis.update_age(60.0)  # while no samples come, the controller goes on commanding
    ask(61_000)
    assert axis.far_ahead == 3
    with pytest.raises(FieldError) as refused:
        ask(2**62 + 1)
    assert refused.value.field == "pending.first"


def test_a_turning_point_between_two_blocks_is_no_difference_of_the_models(models: dict[str, InverseModel]) -> None:
    """The voltages of a triangle asked for in blocks are those of the triangle asked for at once."""
    axis = make_axis(models)
    slope = 2000.0
    k = np.arange(40)
    y = 45.0 + slope * 1e-3 * np.where(k < 20, k - 20.0, 20.0 - k)
    v = np.where(k < 20, slope, -slope)
    model, _, memory = axis.model("lssvm_adaptive")
    whole = model.feedforward(y, v, 0.0 * y, memory)
    before = Pending(0, y[:20], whole.u_V[:20])
    got = axis.answer(FeedforwardQuery(y[20:], v[20:], 0.0 * y[20:], None, "lssvm_adaptive", pending=before))
    np.testing.assert_allclose(got.u_V, whole.u_V[20:], atol=1e-9)
