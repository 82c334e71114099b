"""Trouble with samples or learner: seen, answered by the last good model, then the baseline, and over by itself."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.gates import DUPLICATE, OUT_OF_ORDER, OUTLIER
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.intake.sequence import AHEAD
from dehyst.service.protocol.keys import AUTO
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.query import STAND_IN, FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis, make_learner
from dehyst.service.server.learner_supervisor import UNUSABLE
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.online_models import SmoothingLearner
from tests.service.conftest import DT_S, make_models

LIMITS = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
CONFIG = AxisConfig("x", Path("x.npz"), LIMITS, served="lssvm_adaptive", compete=(), last_good_s=3.0)
NAME = "lssvm_adaptive"


def make_axis(factory: Any = make_learner, **changes: Any) -> Axis:
    bundle = Bundle(make_models(), BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))
    return load_axis("demo", replace(CONFIG, **changes), factory, bundle)


class Bench:
    """A moving stage whose sensor can be made to lie."""

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.k = 0

    def run(self, n: int, lie: Any = lambda k, y: y) -> None:
        k = np.arange(self.k, self.k + n)
        y = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * k * DT_S)
        self.axis.handle(SampleBatch(k, k * DT_S, (y - 1.0) / (11.0 * 0.95), lie(k, y)))
        self.k += n

    def ask(self) -> Any:
        one = np.array([40.0])
        memory = self.axis.newest.models[NAME].rest_memory(40.0)
        return self.axis.answer(FeedforwardQuery(one, 0 * one, 0 * one, memory))

    @property
    def u_V(self) -> float:
        return float(self.ask().u_V[0])

    @property
    def events(self) -> list[str]:
        return [e["event"] for e in self.axis.take_events()]


def frozen(k: FloatArray, y: FloatArray) -> FloatArray:
    return np.full(y.size, 52.125)


def poisoned(k: FloatArray, y: FloatArray) -> FloatArray:
    return np.where(k % 5 == 0, y, [math.nan, 1e12][int(k[0]) % 2])


@pytest.mark.parametrize(("lie", "name"), [(frozen, "sensor_frozen"), (poisoned, "samples_poisoned")])
def test_samples_that_lie_teach_nothing_and_the_model_from_before_is_served(lie: Any, name: str) -> None:
    bench = Bench(make_axis())
    bench.run(9000)
    before = bench.u_V
    assert bench.events == []
    assert bench.axis.answering() == "learnt"
    bench.run(1000, lie)
    assert bench.axis.newest.trouble == name
    assert bench.axis.answering() == "last_good"
    assert bench.events == ["trouble"]
    assert bench.u_V == pytest.approx(before, abs=0.2)
    told = fingerprint(bench.axis.newest.models[NAME])
    bench.run(1000, lie)
    assert fingerprint(bench.axis.newest.models[NAME]) == told
    assert bench.axis.newest.trust == 1.0
    # After that the last good model is too old to be believed, and the baseline takes over in a second.
    bench.run(1500, lie)
    assert 0.0 < bench.axis.newest.trust < 1.0
    assert bench.axis.answering() == "blended"
    bench.run(1500, lie)
    assert bench.axis.newest.trust == 0.0
    assert bench.axis.answering() == "stand_in"
    answer = bench.ask()
    assert answer.u_V[0] == pytest.approx(39.0 / 11.0)
    assert answer.flags[0] & STAND_IN
    assert answer.fallback
    assert answer.stand_in == "linear"
    # It comes back by itself, and learns.
    bench.run(2500)
    assert bench.events == ["learner_went_back", "recovered"]
    assert bench.axis.newest.trouble == ""
    assert bench.axis.newest.trust == 1.0
    assert bench.axis.answering() == "learnt"
    learnt = bench.axis.gates["learnt"]
    bench.run(500)
    assert bench.axis.gates["learnt"] > learnt
    assert bench.u_V == pytest.approx(before, abs=0.2)


@pytest.mark.parametrize("lie", [frozen, poisoned, lambda k, y: np.minimum(y, 50.0), lambda k, y: y * math.nan])
def test_going_back_forgets_what_was_learnt_and_not_where_the_stage_has_been(lie: Any) -> None:
    """Else the learner would go on with turning points of seconds ago, and every caller with other ones."""
    bench, twin = Bench(make_axis()), Bench(make_axis())
    for each in (bench, twin):
        each.run(9100)
    bench.run(900, lie)
    bench.run(1501)  # up to a snapshot
    twin.run(2401)
    assert "learner_went_back" in bench.events
    learner, other = bench.axis.learner, twin.axis.learner
    assert isinstance(learner, Learner)
    assert isinstance(other, Learner)
    assert np.max(np.abs(learner.memory() - other.memory())) < 0.5
    served = bench.axis.newest
    np.testing.assert_array_equal(served.memories[NAME], learner.memory_for(served.models[NAME]))


def test_the_learners_model_is_served_with_the_memory_that_it_was_learnt_with() -> None:
    """Readings that were not believed are not in it, whether the model is asked alone or as a contestant."""
    bench = Bench(make_axis(compete=("linear",), served="auto", snapshot_every=20))
    bench.run(3000)
    bench.run(41, lambda k, y: y + np.where(k % 10 == 3, 25.0, 0.0))
    served, learner = bench.axis.newest, bench.axis.learner
    own = learner.memory_for(served.models[NAME])
    np.testing.assert_array_equal(served.memories[NAME], own)
    champion = served.models["auto"]
    assert own.tobytes() in served.memories["auto"].tobytes()
    assert served.memories["auto"].size == champion.memory_size
    # A play is never further from the stage than its threshold.
    place = 45.0 + 30.0 * math.sin(2 * math.pi * 3.0 * served.seq * DT_S)
    assert abs(own[0] - place) < 2.0


def test_while_the_learner_distrusts_the_sensor_what_it_serves_is_served_alone_and_as_champion() -> None:
    """It has gone back by itself; the memory is the reckoned one."""
    bench = Bench(make_axis(compete=("linear",), served="auto", snapshot_every=20))
    bench.run(3000)
    bench.run(1201, lambda k, y: 90.0 - y)
    served, learner = bench.axis.newest, bench.axis.learner
    assert served.trouble == "sensor_sign"
    assert learner.distrusts
    assert served.models[NAME] is learner.snapshot()
    champion = served.models["auto"]
    assert champion.models[champion.names.index(NAME)] is served.models[NAME]
    np.testing.assert_array_equal(served.memories[NAME], learner.memory_for(served.models[NAME]))
    bench.run(2000)
    assert bench.axis.newest.trouble == ""
    assert not bench.axis.learner.distrusts


class Sick(SmoothingLearner):
    """A learner whose snapshots are mad for a while, or which raises."""

    def __init__(self, inner: OnlineModel, ill: range, raises: bool, alive: list[int]) -> None:
        assert isinstance(inner, Learner)
        super().__init__(inner)
        self.ill, self.raises = ill, raises
        alive.append(1)

    def handle(self, sample: Sample) -> str:
        if self.raises and sample.seq in self.ill:
            raise ZeroDivisionError("no")
        return super().handle(sample)

    def snapshot(self) -> InverseModel:
        model = self.inner.snapshot()
        assert isinstance(model, LssvmInverse)
        if not self.raises and self.seq in self.ill:
            return replace(model, beta=model.beta * 40.0)
        return model


def test_a_mad_model_is_never_served() -> None:
    made: list[int] = []
    axis = make_axis(lambda m, s, lim: Sick(make_learner(m, s, lim), range(2000, 3000), False, made))
    bench = Bench(axis)
    bench.run(1990)
    before = bench.u_V
    for _ in range(50):
        bench.run(20)
        assert abs(bench.u_V - before) < 0.3
    assert bench.axis.newest.trouble == "model_bad"
    bench.run(1000)
    assert bench.events == ["trouble", "recovered"]
    assert abs(bench.u_V - before) < 0.3


class Refusing(SmoothingLearner):
    """A learner that refuses every sample from number ``first`` on, after it has learnt something wrong."""

    def __init__(self, inner: OnlineModel, first: int) -> None:
        assert isinstance(inner, Learner)
        super().__init__(inner)
        self.first, self.at = first, -1

    def handle(self, sample: Sample) -> str:
        self.at = sample.seq
        return OUTLIER if self.at >= self.first else super().handle(sample)

    def snapshot(self) -> InverseModel:
        model = self.inner.snapshot()
        assert isinstance(model, LssvmInverse)
        beta = model.beta.copy()
        beta[-1 if beta.size == 1 else 0] *= 1.2 if self.at >= self.first - 100 else 1.0
        return replace(model, beta=beta)


@pytest.mark.parametrize("compete", [(), ("linear",)])
def test_while_everything_is_refused_the_model_that_fits_the_stage_is_served(compete: tuple[str, ...]) -> None:
    """Within half a second of motion; it did not learn the wrong thing yet."""
    axis = make_axis(lambda m, s, lim: Refusing(make_learner(m, s, lim), 3000), compete=compete)
    bench = Bench(axis)
    bench.run(2890)
    before = bench.u_V
    bench.run(600)
    assert abs(bench.u_V - before) > 0.3, "what was learnt last is wrong"
    bench.run(30)
    assert axis.newest.trouble == "nothing_learnt"
    assert axis.answering() == "last_good"
    assert abs(bench.u_V - before) < 0.05
    (event,) = axis.take_events()
    assert "no sample for 0.5 s, the last one refused as outlier" in event["detail"]
    if compete:
        champion = axis.newest.models[AUTO]
        assert isinstance(champion, ChampionInverse)
        assert dict(zip(champion.names, champion.models, strict=True))[NAME] is axis.newest.models[NAME]


@pytest.mark.parametrize("compete", [(), ("linear",)])
def test_a_learner_that_failed_is_begun_anew_from_the_last_good_model(compete: tuple[str, ...]) -> None:
    """Alone and as a contestant: one way, and one trouble."""
    made: list[int] = []
    axis = make_axis(
        lambda m, s, lim: Sick(make_learner(m, s, lim), range(2000, 2001), True, made), compete=compete
    )  # fmt: skip
    bench, there = Bench(axis), len(made)
    bench.run(1990)
    before = bench.u_V
    bench.run(4000)
    assert not axis.learning
    assert axis.newest.trouble == "learner_failed"
    assert bench.events == ["learner_failed"]
    bench.run(2000)
    assert axis.learning
    assert bench.events == ["learner_begun_anew", "recovered"]
    assert len(made) == there + 1
    bench.run(1000)
    assert axis.newest.trouble == ""
    assert abs(bench.u_V - before) < 0.1


@pytest.mark.parametrize("at", [2000, 2340, 2999])
def test_a_standby_goes_back_to_the_same_state(at: int) -> None:
    """Whenever it took the state over: else it would differ after each lie, and take the state over once more."""
    one, other = Bench(make_axis()), Bench(make_axis())
    one.run(at)
    other.axis.restore(one.axis.state_dict())
    other.k = one.k
    for bench in (one, other):
        bench.run(3511)
        bench.run(700, frozen)
        bench.run(1500)
        assert "learner_went_back" in bench.events
    assert one.axis.newest.seq == other.axis.newest.seq
    assert fingerprint(one.axis.newest.models[NAME]) == fingerprint(other.axis.newest.models[NAME])


# ---- what is refused changes nothing

#: What samples teach: the model, the place and the memories, how good the model has been, and what is served.
_TAUGHT = (
    "learner.filter.", "learner.window.", "learner.front.track.", "learner.judgement.", "learner.domain",
    "learner.rest", "learner.delay", "learner.mark", "tracker.", "memory.", "served.", "model.",
)  # fmt: skip
_numbers = st.one_of(st.floats(allow_nan=True, allow_infinity=True, width=64), st.floats(0.0, 90.0))


@functools.lru_cache(maxsize=1)
def _learnt() -> StateDict:
    bench = Bench(make_axis())
    bench.run(1010)
    return bench.axis.state_dict()


@settings(max_examples=60, deadline=None)
@given(
    seq=st.sampled_from((1010,) * 6 + (1009, 700, 10**9, 2**62)),
    t_s=st.one_of(st.just(1.010), st.just(1.010), _numbers), u_V=st.one_of(st.just(4.0), _numbers), y_um=_numbers,
)  # fmt: skip
def test_what_is_refused_teaches_and_moves_nothing(seq: int, t_s: float, u_V: float, y_um: float) -> None:
    axis = make_axis()
    axis.restore(dict(_learnt()))
    before = axis.state_dict()
    (verdict,) = axis.handle(SampleBatch(*(np.array([value]) for value in (seq, t_s, u_V, y_um))))
    after = axis.state_dict()
    event(verdict)
    if verdict not in UNUSABLE | {DUPLICATE, OUT_OF_ORDER, AHEAD}:
        return
    for name in before:
        # Counters of the window's numerics are in C; a state is made of a copy that counts the copying.
        if name.startswith(_TAUGHT) and name != "learner.window.C":
            assert np.array_equal(
                np.asarray(before[name]), np.asarray(after[name]), equal_nan=_is_float(before[name])
            ), name


def _is_float(value: Any) -> bool:
    return bool(np.asarray(value).dtype.kind == "f")


def test_a_stage_at_rest_is_no_frozen_sensor() -> None:
    bench = Bench(make_axis())
    bench.run(1000)
    k = np.arange(1000, 4000)
    bench.axis.handle(SampleBatch(k, k * DT_S, np.full(3000, 4.0), np.full(3000, 43.0)))
    assert bench.axis.newest.trouble == ""
    assert bench.events == []
