"""One suite for every online model, the learner and the adaptive baselines: what each must do whatever it learns."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import InverseModel, OnlineModel, Sample
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse
from dehyst.baselines.bouc_wen.online import BoucWenOnline
from dehyst.baselines.common import Domain
from dehyst.baselines.competition.competition import Competition
from dehyst.baselines.linear import LinearInverse, LinearOnline, LinearParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline

DT, N = 1e-3, 1500
PACKAGES = ("dehyst.adaptive", "dehyst.baselines")
Recording = tuple[np.ndarray, np.ndarray]
Maker = Callable[[Recording, LssvmInverse], Any]


def two_inputs(recording: Recording, model: LssvmInverse) -> Learner:
    return Learner(identify_lssvm(*recording, DT, "two", IdentifyConfig(tune=False, n=100))[0])


SEEN = Domain(0.0, 90.0, 2000.0)
MPI = MpiParameters(
    tuple(float(r) for r in np.arange(7) * 0.6), (7.0, 1.5, 1.0, 0.5, 0.5, 0.2, 0.1), (0.0, 30.0), (1.0, -0.1)
)


def linear(recording: Recording, model: LssvmInverse) -> Any:
    return LinearOnline(LinearInverse(LinearParameters(11.0), DT, SEEN, 0.1))


def mpi(recording: Recording, model: LssvmInverse) -> Any:
    return MpiOnline(MpiInverse(MPI, DT, SEEN, 0.01))


def bouc_wen(recording: Recording, model: LssvmInverse) -> Any:
    return BoucWenOnline(BoucWenInverse(TABLE_2_1, DT, SEEN, 0.01))


def competition(recording: Recording, model: LssvmInverse) -> Any:
    others: dict[str, InverseModel] = {
        "linear": LinearInverse(LinearParameters(11.0), DT, SEEN, 0.1),
        "mpi": MpiInverse(MPI, DT, SEEN, 0.01),
        "bouc_wen": BoucWenInverse(TABLE_2_1, DT, SEEN, 0.01),
    }
    return Competition.from_models("lssvm", Learner(model), model, others)


MAKERS: dict[str, Maker] = {
    "learner": lambda recording, model: Learner(model),
    "learner_fifo": lambda recording, model: Learner(model, LearnerConfig(eviction="fifo", window=100)),
    "learner_two_inputs": two_inputs,
    "linear": linear,
    "mpi": mpi,
    "bouc_wen": bouc_wen,
    "competition": competition,
}


@pytest.fixture(scope="module", params=list(MAKERS))
def template(request: pytest.FixtureRequest, recording: Recording, model: LssvmInverse) -> Any:
    """A fresh online model; tests take clones of it, so that identification runs once."""
    return MAKERS[request.param](recording, model)


def clone(online: Any) -> Any:
    return online.restored(online.state_dict())


def feed(online: OnlineModel, recording: Recording, start: int = 0, stop: int = N) -> list[str]:
    u, y = recording
    return [online.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


def motion(n: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t, w = np.arange(n) * DT, 2 * np.pi * 3
    return 40 + 20 * np.sin(w * t), 20 * w * np.cos(w * t), -20 * w * w * np.sin(w * t)


def answer(snapshot: InverseModel) -> np.ndarray:
    return snapshot.feedforward(*motion(), snapshot.rest_memory(40.0)).u_V


def test_answers_before_any_sample(template: Any) -> None:
    fresh = clone(template)
    assert fresh.seq == -1
    assert isinstance(fresh.snapshot(), InverseModel)
    assert np.all(np.isfinite(answer(fresh.snapshot())))
    assert not any(fresh.counters().values()) or fresh.counters()["learnt"] == 0


def test_learns_and_numbers_what_it_has_seen(template: Any, recording: Recording) -> None:
    online = clone(template)
    outcomes = feed(online, recording)
    assert "learnt" in outcomes
    assert online.seq == N - 1
    counters = online.counters()
    assert sum(counters[name] for name in set(outcomes)) == N


def test_same_samples_same_answers_to_the_last_bit(template: Any, recording: Recording) -> None:
    one, two = clone(template), clone(template)
    assert feed(one, recording) == feed(two, recording)
    np.testing.assert_array_equal(answer(one.snapshot()), answer(two.snapshot()))
    assert one.counters() == two.counters()


def test_a_clone_in_the_middle_goes_on_alike_and_apart(template: Any, recording: Recording) -> None:
    one = clone(template)
    feed(one, recording, 0, 900)
    two = clone(one)
    before = answer(two.snapshot())
    assert feed(one, recording, 900, N)
    np.testing.assert_array_equal(answer(two.snapshot()), before)
    feed(two, recording, 900, N)
    np.testing.assert_array_equal(answer(one.snapshot()), answer(two.snapshot()))


def test_a_snapshot_never_changes(template: Any, recording: Recording) -> None:
    online = clone(template)
    feed(online, recording, 0, 700)
    snapshot = online.snapshot()
    before = answer(snapshot)
    feed(online, recording, 700, N)
    np.testing.assert_array_equal(answer(snapshot), before)


def test_feedforward_changes_no_input(template: Any) -> None:
    snapshot = template.snapshot()
    y, v, a = motion()
    memory = snapshot.rest_memory(40.0)
    kept = [x.copy() for x in (y, v, a, memory)]
    snapshot.feedforward(y, v, a, memory)
    for x, old in zip((y, v, a, memory), kept, strict=True):
        np.testing.assert_array_equal(x, old)


@pytest.mark.parametrize(
    "bad",
    [
        Sample(700, 0.7, math.nan, 40.0),
        Sample(700, 0.7, 4.0, math.inf),
        Sample(700, math.nan, 4.0, 40.0),
        Sample(700, 0.7, 1e300, -1e300),
        Sample(699, 0.699, 4.0, 40.0),
        Sample(10, 0.010, 4.0, 40.0),
        Sample(-5, -1.0, 4.0, 40.0),
        Sample(700, 5.0, 4.0, 40.0),
    ],
    ids=["nan", "inf", "time", "absurd", "duplicate", "old", "negative", "clock"],
)
def test_a_bad_sample_is_refused_and_changes_nothing(template: Any, recording: Recording, bad: Sample) -> None:
    online = clone(template)
    feed(online, recording, 0, 700)
    before = answer(online.snapshot())
    outcome = online.handle(bad)
    assert outcome not in ("learnt", "passed")
    np.testing.assert_array_equal(answer(online.snapshot()), before)
    assert online.seq == 699
    assert online.counters()[outcome] >= 1


def test_survives_anything_and_stays_finite(template: Any, recording: Recording) -> None:
    online = clone(template)
    feed(online, recording, 0, 300)
    rng = np.random.default_rng(0)
    for k in range(300, 1500):
        u, y = rng.normal(4, 40), rng.normal(40, 400)
        online.handle(Sample(k + int(rng.integers(-3, 4)), k * DT, float(u), float(y)))
        assert np.all(np.isfinite(answer(online.snapshot()))) or k % 50
    assert np.all(np.isfinite(answer(online.snapshot())))


def test_memory_is_bounded(template: Any, recording: Recording) -> None:
    online = clone(template)
    feed(online, recording, 0, 1000)

    def size() -> int:
        return sum(np.asarray(value).nbytes for value in online.state_dict().values() if not isinstance(value, str))

    before = size()
    feed(online, recording, 1000, 4000)
    assert size() <= before * 1.01 + 256


def test_what_is_let_go_is_freed_at_once(template: Any, recording: Recording) -> None:
    """No circles of references: a service that goes back to a kept state lets a model of megabytes go each time."""
    gc.collect()
    gc.disable()
    try:
        online = clone(template)
        feed(online, recording, 0, 700)
        online.snapshot()
        del online
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        found = {type(left).__qualname__ for left in gc.garbage if type(left).__module__.startswith(PACKAGES)}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert found == set()
