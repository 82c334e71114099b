"""A followed model tells of each voltage what the service would: flags, deviation, and which model it came from."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import MemoryTracker
from dehyst.service.answers.guard import Limits
from dehyst.service.client.follower import Follower
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.model import Safety, decode_model, encode_model
from dehyst.service.protocol.query import (
    BLENDED,
    LIMITED_SLEW,
    LIMITED_VOLTAGE,
    OUTSIDE_DOMAIN,
    STALE,
    STAND_IN,
    FeedforwardQuery,
    Trajectory,
)
from dehyst.service.server.axis import Axis
from tests.service.conftest import make_models

LIMITS = Limits(0.0, 7.0, 2000.0, -50.0, 150.0)


class Session:
    """A session on which nothing is sent: what is published here is handed over by the test."""

    def declare_subscriber(self, key: str, heard: Any) -> Any:
        self.heard = heard
        return SimpleNamespace(undeclare=lambda: None)

    def publish(self, payload: bytes) -> None:
        self.heard(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


def make_axis(served: str = "lssvm_adaptive") -> Axis:
    return Axis(AxisConfig("x", Path("x.npz"), LIMITS, served=served, learn=""), make_models(), None, LIMITS)


def payload_of(axis: Axis, name: str) -> bytes:
    model, seq, memory = axis.model(name)
    return encode_model(name, model, seq, memory, axis.safety(name))


def one_by_one(axis: Axis, name: str, motion: tuple[FloatArray, FloatArray]) -> tuple[Follower, list[Any]]:
    """What the follower tells of each of the points, and what the service answers to them all."""
    follower = Follower(Session(), None, name, lambda: payload_of(axis, name), LIMITS)  # type: ignore[arg-type]
    told = []
    for y_um, v_um_per_s in zip(*(column.tolist() for column in motion), strict=True):
        u_V = follower.point(y_um, v_um_per_s)
        told.append((u_V, follower.last_flags, follower.last_std_V, follower.source))
    return follower, told


def asked(axis: Axis, name: str, motion: tuple[FloatArray, FloatArray]) -> Trajectory:
    return axis.answer(FeedforwardQuery(*motion, np.zeros(motion[0].size), model=name))


#: From within the learnt domain through all of the blend to the stand-in alone; and from one end of the range, where
#: the voltage limit lies, to the other faster than the slew limit.
MOTIONS = {
    "out of the domain": (np.full(60, 40.0), np.linspace(0.0, 70_000.0, 60)),
    "against the limits": (np.array([20.0, 20.0, 89.0, 89.0, 89.0, 3.0, 3.0, 60.0]), np.zeros(8)),
    "beyond the range": (np.linspace(60.0, 140.0, 50), np.zeros(50)),
}
#: What must have happened on the way, by model and motion; a line has no bounds of its own in velocity.
EXPECTED = {
    ("lssvm_adaptive", "out of the domain"): OUTSIDE_DOMAIN | BLENDED | STAND_IN,
    ("lssvm_adaptive", "against the limits"): LIMITED_VOLTAGE | LIMITED_SLEW,
    ("lssvm_adaptive", "beyond the range"): OUTSIDE_DOMAIN | BLENDED,
    ("linear", "out of the domain"): 0,
    ("linear", "against the limits"): LIMITED_VOLTAGE | LIMITED_SLEW,
    ("linear", "beyond the range"): OUTSIDE_DOMAIN | LIMITED_VOLTAGE,
}


@pytest.mark.parametrize("name", ["lssvm_adaptive", "linear"])
@pytest.mark.parametrize("motion", list(MOTIONS))
def test_each_point_is_flagged_as_the_service_flags_it(name: str, motion: str) -> None:
    axis = make_axis()
    reply = asked(axis, name, MOTIONS[motion])
    _, told = one_by_one(axis, name, MOTIONS[motion])
    np.testing.assert_array_equal([u for u, *_ in told], reply.u_V)
    np.testing.assert_array_equal([flags for _, flags, *_ in told], reply.flags)
    np.testing.assert_array_equal([std for *_, std, _ in told], reply.std_V)
    for _, flags, _, source in told:
        expected = "linear" if flags & STAND_IN else f"{name}+linear" if flags & BLENDED else name
        assert source == expected
    seen = int(np.bitwise_or.reduce(reply.flags))
    assert seen & EXPECTED[name, motion] == EXPECTED[name, motion]


def test_a_trajectory_leaves_all_of_its_answer_behind() -> None:
    axis = make_axis()
    motion = MOTIONS["out of the domain"]
    follower, _ = one_by_one(axis, "lssvm_adaptive", (np.empty(0), np.empty(0)))
    assert (follower.last_flags, follower.source, follower.last_trajectory) == (0, "", None)
    assert math.isnan(follower.last_std_V)
    u_V, flags = follower.trajectory(*motion, np.zeros(60))
    reply, got = asked(axis, "lssvm_adaptive", motion), follower.last_trajectory
    assert got is not None
    assert got.u_V is u_V
    assert got.flags is flags
    np.testing.assert_array_equal(got.std_V, reply.std_V)
    assert got.stand_in == reply.stand_in == "linear"
    assert (follower.last_flags, follower.last_std_V) == (reply.flags[-1], reply.std_V[-1])
    assert follower.source == "linear"


def test_of_a_competition_the_champion_is_named() -> None:
    models = make_models()
    for index, name in enumerate(models):
        champion = ChampionInverse(tuple(models), tuple(models.values()), index)
        payload = encode_model("auto", champion, 5, champion.rest_memory(40.0))
        follower = Follower(Session(), None, "auto", payload.__bytes__, LIMITS)  # type: ignore[arg-type]
        u_V = follower.point(40.0)
        assert follower.source == name
        assert follower.last_std_V == models[name].feedforward(
            np.array([40.0]), np.zeros(1), np.zeros(1), models[name].rest_memory(40.0)
        ).std_V.item(0)
        assert math.isfinite(u_V)


def test_a_snapshot_that_is_no_longer_renewed_is_told_point_by_point() -> None:
    model = make_models()["lssvm_adaptive"]
    safety = Safety(True, stale_s=2.0, last_good_s=60.0, stand_in=None)
    payload = encode_model("lssvm_adaptive", model, 5, model.rest_memory(40.0), safety)
    session = Session()
    follower = Follower(session, "key", "lssvm_adaptive", lambda: payload, LIMITS)  # type: ignore[arg-type]
    session.publish(payload)
    fresh = follower.point(40.0)
    assert (follower.received, follower.stale, follower.last_flags) == (2, False, 0)
    follower._newest = (decode_model(payload), time.monotonic() - 5.0)
    assert follower.stale
    assert follower.point(40.0) == pytest.approx(fresh, abs=0.1)
    assert follower.last_flags == STALE
    assert follower.source == "lssvm_adaptive"
    _, flags = follower.trajectory([40.0])
    assert flags.tolist() == [STALE]
    session.publish(payload)
    follower.point(40.0)
    assert follower.last_flags == 0


def moved(n: int) -> tuple[Any, FloatArray, FloatArray]:
    """(numbers, voltages, readings) of a stage that moves as it was told, with a turn on the way."""
    k = np.arange(n)
    y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * 1e-3)
    return k, (y - 1.0) / 11.0, y


def snapshot_after(model: Any, n: int) -> bytes:
    """What the service publishes once it has tracked the first n of the samples."""
    tracker = MemoryTracker(model.dt_s)
    for sample in zip(*(column[:n].tolist() for column in moved(n)), strict=True):
        tracker.add(*sample)
    memory = tracker.advance({"": model}, {"": np.empty(0)})[""]
    return encode_model("lssvm_adaptive", model, n - 1, memory)


def test_a_resynchronised_memory_is_that_of_the_service_after_the_same_samples() -> None:
    model = make_models()["lssvm_adaptive"]
    follower = Follower(Session(), None, "lssvm_adaptive", lambda: snapshot_after(model, 200), LIMITS)  # type: ignore[arg-type]
    seq, u_V, y_um = moved(320)
    follower.resynchronise(seq[150:], u_V[150:], y_um[150:])
    now = decode_model(snapshot_after(model, 320)).memory
    np.testing.assert_allclose(follower.memory, now, rtol=0, atol=1e-9)
    assert np.abs(follower.memory - decode_model(snapshot_after(model, 200)).memory).max() > 1e-3
    # Samples that are no numbers, and samples from before the snapshot alone, change nothing.
    with_a_hole = y_um.copy()
    with_a_hole[260] = math.nan
    follower.resynchronise(seq[150:], u_V[150:], with_a_hole[150:])
    np.testing.assert_allclose(follower.memory, now, rtol=0, atol=0.2)
    follower.resynchronise(seq[150:200], u_V[150:200], y_um[150:200])
    np.testing.assert_array_equal(follower.memory, decode_model(snapshot_after(model, 200)).memory)


@pytest.mark.parametrize("blocks", [False, True])
def test_what_resynchronising_changes_fades_in(blocks: bool) -> None:
    """The follower's memory went another way than the stage: the voltage approaches the right one without a step."""
    model = make_models()["lssvm_adaptive"]
    wide = Limits(-50.0, 50.0, math.inf, -50.0, 150.0)
    wrong, right = (
        Follower(Session(), None, "lssvm_adaptive", lambda: snapshot_after(model, 200), wide)  # type: ignore[arg-type]
        for _ in range(2)
    )
    seq, u_V, y_um = moved(300)
    for follower in (wrong, right):
        follower.resynchronise(seq[150:], u_V[150:], y_um[150:])
    y = float(y_um[-1])
    wrong.memory = wrong.memory + 3.0
    before = wrong.point(y)
    wrong.resynchronise(seq[150:], u_V[150:], y_um[150:])
    if blocks:
        got, wanted = wrong.trajectory(np.full(80, y))[0], right.trajectory(np.full(80, y))[0]
    else:
        got, wanted = (np.array([f.point(y) for _ in range(80)]) for f in (wrong, right))
    step = before - wanted[0]
    assert abs(step) > 1e-4
    difference = got - wanted
    assert difference[0] == pytest.approx(step * math.exp(-1 / 6), rel=0.05)
    assert (np.diff(np.abs(difference[:40])) < 0.0).all()
    assert abs(difference[-1]) < 1e-5 * abs(step) + 1e-8


def test_samples_that_do_not_belong_together_resynchronise_nothing() -> None:
    model = make_models()["lssvm_adaptive"]
    follower = Follower(Session(), None, "lssvm_adaptive", lambda: snapshot_after(model, 20), LIMITS)  # type: ignore[arg-type]
    before = follower.memory.copy()
    with pytest.raises(InputError, match="u_V, y_um"):
        follower.resynchronise([20, 21], [1.0, 1.0], [30.0])
    with pytest.raises(InputError, match="rising"):
        follower.resynchronise([21, 20], [1.0, 1.0], [30.0, 31.0])
    np.testing.assert_array_equal(follower.memory, before)


@pytest.mark.parametrize("wrong", ["40", None, [1.5], 10**400], ids=lambda value: repr(value)[:12])
def test_an_argument_of_a_follower_that_is_no_number_is_named_and_changes_nothing(wrong: Any) -> None:
    follower = Follower(
        Session(), None, "lssvm_adaptive", lambda: snapshot_after(make_models()["lssvm_adaptive"], 20), LIMITS
    )  # type: ignore[arg-type]
    before, expected = follower.memory.copy(), follower.point(40.0)
    follower.memory = before.copy()
    asked: list[tuple[str, Any]] = [
        ("y_um", lambda: follower.point(wrong)),
        ("v_um_per_s", lambda: follower.point(40.0, wrong)),
        ("a_um_per_s2", lambda: follower.point(40.0, 0.0, wrong)),
        ("timeout_s", lambda: follower.wait(0, wrong)),
        ("seq", lambda: follower.wait(wrong, 0.0)),
    ]
    if wrong is not None:
        asked += [
            ("seq", lambda: follower.point(40.0, seq=wrong)),
            ("seq", lambda: follower.trajectory([40.0], seq=wrong)),
        ]
    if not isinstance(wrong, list | np.ndarray | int):
        asked += [
            ("y_um", lambda: follower.trajectory(wrong)),
            ("seq", lambda: follower.resynchronise(wrong, 1.0, 40.0)),
        ]
    asked.append(("seq", lambda: follower.resynchronise([20, 21.5], [1.0, 1.0], [40.0, 40.0])))
    for field, ask in asked:
        with pytest.raises(InputError, match=f"^{field}: got "):
            ask()
    np.testing.assert_array_equal(follower.memory, before)
    assert follower.point(40.0) == expected


@pytest.mark.parametrize("memory", ["40", [1.0]], ids=repr)
def test_a_memory_that_does_not_fit_is_refused_by_name(memory: Any) -> None:
    model = make_models()["lssvm_adaptive"]
    with pytest.raises(InputError, match=r"^memory: got "):
        Follower(Session(), None, "lssvm_adaptive", lambda: snapshot_after(model, 20), LIMITS, memory)  # type: ignore[arg-type]
