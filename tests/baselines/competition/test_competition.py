"""The competition: scored on fresh motion, the better one served, no jump at the change, back when it has recovered."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import FloatArray, InverseModel, Sample
from dehyst.baselines.bouc_wen.model import BoucWenInverse, BoucWenParameters
from dehyst.baselines.common import Domain
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.baselines.competition.competition import (
    ChampionChoice,
    Competition,
)
from dehyst.baselines.competition.config import CompetitionConfig
from dehyst.baselines.linear import LinearInverse, LinearParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline
from tests.online_models import SmoothingLearner

DT, GAIN, SPAN_V, RANGE_UM = 1e-3, 11.0, 7.0, 77.0
SEEN = Domain(0.0, 80.0, 2000.0)
BOUC_WEN = BoucWenParameters(
    m_kg=0.015,
    b_N_s_per_m=4.8e4,
    k_N_per_m=1.9e7,
    d_um_per_V=11.35,
    alpha=0.4754,
    beta_per_V=0.8649,
    gamma_per_V=0.9630,
)
MPI = MpiParameters((0.0, 0.6, 1.2), (8.0, 2.0, 1.0), (0.0, 30.0), (1.0, -0.1))


def line(gain: float = GAIN, offset_um: float = 0.0) -> LinearInverse:
    return LinearInverse(LinearParameters(gain, offset_um), DT, SEEN, 0.1)


class Fixed(SmoothingLearner):
    """An online model that serves a line; its gain is set from outside, and it may be told to fail."""

    def __init__(self, gain: float) -> None:
        super().__init__(Learner(replace(lssvm(), span_V=SPAN_V)))
        self.gain = gain
        self.fails = False

    def handle(self, sample: Sample) -> str:
        if self.fails:
            raise RuntimeError("out of order")
        return super().handle(sample)

    def snapshot(self) -> InverseModel:
        return line(self.gain) if math.isfinite(self.gain) else Broken(line())

    def counters(self) -> dict[str, int]:
        return {"learnt": self.seq + 1}


class Broken:
    """A line that answers NaN."""

    def __init__(self, inner: LinearInverse) -> None:
        self.inner, self.name, self.dt_s, self.memory_size = inner, "broken", inner.dt_s, inner.memory_size

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def feedforward(self, y: FloatArray, v: FloatArray, a: FloatArray, memory: FloatArray) -> object:
        said = self.inner.feedforward(y, v, a, memory)
        return said._replace(u_V=np.full(y.size, np.nan))


def motion(n: int, first: int = 0) -> tuple[FloatArray, FloatArray]:
    """(u_V, y_um) of a line of 11 µm/V."""
    t = np.arange(first, first + n) * DT
    u = 3.5 + 2.5 * np.sin(2 * np.pi * 1.3 * t)
    return u, GAIN * u


def feed(model: Competition, n: int, first: int) -> list[str]:
    u, y = motion(n, first)
    return [
        model.handle(Sample(first + k, (first + k) * DT, float(u[k]), float(y[k]))) for k in range(n)
    ]  # fmt: skip


def contest(
    favourite: float, other: float, config: CompetitionConfig | None = None
) -> tuple[Competition, Fixed, Fixed]:
    one, two = Fixed(favourite), Fixed(other)
    return Competition({"one": one, "two": two}, SPAN_V, config), one, two


def test_the_better_one_is_served_after_a_while_and_the_favourite_comes_back() -> None:
    model, one, _ = contest(GAIN, 1.03 * GAIN)
    feed(model, 2000, 0)
    assert model.champion == "one"
    one.gain = 1.2 * GAIN
    feed(model, 400, 2000)
    assert model.champion == "one"  # not at once
    feed(model, 1600, 2400)
    assert model.champion == "two"
    assert [name for name, _ in model.take_events()] == ["champion_changed"]
    one.gain = GAIN
    feed(model, 4000, 4000)
    assert model.champion == "one"
    assert model.standing()["changes"] == 2 == model.counters()["champion_changes"]


def test_a_baseline_states_what_its_answers_were_wrong_by() -> None:
    """Not less than its own fit says, and only as champion; a state goes on with it."""
    model, one, _ = contest(1.1 * GAIN, 1.3 * GAIN)
    assert [m.voltage_std_V for m in model.champion_model().models] == [0.1, 0.1]
    feed(model, 4000, 0)
    rms_V = model.standing()["contestants"]["one"]["rms_V"]
    assert [m.voltage_std_V for m in model.champion_model().models] == [rms_V, 0.1]
    assert rms_V > 0.2
    at = np.array([40.0])
    still = np.zeros(1)
    served = model.champion_model()
    assert served.feedforward(at, still, still, served.rest_memory(40.0)).std_V == rms_V
    one.gain = GAIN
    feed(model, 20_000, 4000)
    assert [m.voltage_std_V for m in model.champion_model().models] == [0.1, 0.1]


def test_rest_does_not_count() -> None:
    model, one, _ = contest(GAIN, 1.02 * GAIN)
    feed(model, 3000, 0)
    one.gain = 2.0 * GAIN
    u, y = motion(1, 3000)
    rng = np.random.default_rng(0)
    for k in range(3000):
        model.handle(Sample(3000 + k, (3000 + k) * DT, float(u[0]), float(y[0] + 0.005 * rng.normal())))
    assert model.champion == "one"
    feed(model, 2000, 6000)
    assert model.champion == "two"


def reign(errors_V: tuple[float, ...], champion: int = 0, **config: float) -> ChampionChoice:
    """One second of motion with the same errors, judged 50 times."""
    made = ChampionChoice(CompetitionConfig(**{"patience_s": 0.5, **config}), SPAN_V, champion)  # type: ignore[arg-type]
    for _ in range(50):
        made.choose(errors_V, 0.02)
    return made


def test_a_challenger_needs_margin_and_floor_and_the_favourite_neither() -> None:
    assert reign((0.126, 0.1), margin=1.25, floor=0.0).champion == 1
    assert reign((0.124, 0.1), margin=1.25, floor=0.0).champion == 0
    # Twice as good, but both so good that it does not matter: 0.001 of 7 V.
    assert reign((0.012, 0.006), margin=1.25, floor=0.001).champion == 0
    assert reign((0.016, 0.006), margin=1.25, floor=0.001).champion == 1
    assert reign((0.0999, 0.1, 0.3), champion=1, margin=1.25, floor=0.001).champion == 0
    assert reign((0.2, 0.11, 0.1), champion=1).champion == 1


def test_callers_go_over_without_a_jump_each_in_its_own_stream() -> None:
    names, models = ("one", "two"), (line(GAIN), line(1.2 * GAIN))
    before = ChampionInverse(names, models, 0, blend_s=0.05)
    after = ChampionInverse(names, models, 1, blend_s=0.05)
    y, zero = np.full(10, 44.0), np.zeros(10)
    told, memory = [], before.rest_memory(44.0)
    for model in (before, after, after, after, after, after, after):
        answer = model.feedforward(y, zero, zero, memory)
        told.append(answer.u_V)
        memory = answer.memory
    u = np.concatenate(told)
    assert u[9] == 44.0 / GAIN
    assert u[-1] == 44.0 / (1.2 * GAIN)
    whole = 44.0 / GAIN - u[-1]
    assert np.max(np.abs(np.diff(u))) == pytest.approx(whole * DT / 0.05)
    assert np.all(np.diff(u) <= 1e-15)
    # The same question gets the same answer, in one piece or in many.
    long = after.feedforward(np.full(60, 44.0), np.zeros(60), np.zeros(60), before.rest_memory(44.0))
    np.testing.assert_allclose(long.u_V, u[10:], atol=1e-12)
    # Between the two the deviation holds their disagreement.
    assert long.std_V[20] > 0.5 * whole * 0.4


def test_a_champion_that_is_not_finite_is_replaced_at_once() -> None:
    model, one, _ = contest(GAIN, 1.05 * GAIN)
    feed(model, 2000, 0)
    one.gain = math.nan
    feed(model, 160, 2000)  # the age of an answer, a block, and the smoother's lag
    assert model.champion == "two"
    y, zero = np.full(3, 40.0), np.zeros(3)
    served = model.champion_model()
    assert np.isfinite(served.feedforward(y, zero, zero, served.rest_memory(40.0)).u_V).all()


def test_one_that_raises_is_out_and_what_the_favourite_raises_is_raised() -> None:
    """Whoever watches the learner handles its failure, alone or in a competition."""
    model, one, two = contest(GAIN, 1.05 * GAIN)
    feed(model, 1000, 0)
    two.fails = True
    feed(model, 100, 1000)
    assert [name for name, _ in model.take_events()] == ["contestant_failed"]
    assert model.counters()["contestants_failed"] == 1
    assert model.champion == "one"
    one.fails = True
    with pytest.raises(RuntimeError):
        feed(model, 1, 1100)


@pytest.mark.parametrize("share", [0.01, 0.004])
def test_motion_is_the_learners_so_spikes_are_in_no_score_and_what_is_between_them_is(share: float) -> None:
    """Spikes of a share of the range, ten a second: each is in no score, and they hide no model that has gone wrong."""
    model, one, _ = contest(GAIN, 1.05 * GAIN)
    feed(model, 2000, 0)
    u, y = motion(4000, 2000)
    y += share * RANGE_UM * (np.arange(4000) % 97 == 0)
    said = []
    for k in range(4000):
        if k == 1000:
            assert model.standing()["contestants"]["one"]["rms_V"] < 1e-6
            one.gain = 1.2 * GAIN
        said.append(model.handle(Sample(2000 + k, (2000 + k) * DT, float(u[k]), float(y[k]))))
    assert said.count("glitch") > 30
    assert model.champion == "two"


def test_one_that_knows_its_own_memory_is_judged_by_it() -> None:
    """Over samples without a reading where the stage has been is a guess; the learner has a better one."""
    learner = Learner(replace(lssvm(), span_V=SPAN_V))
    model = Competition({"learner": learner, "line": Fixed(GAIN)}, SPAN_V)
    u = motion(3000)[0]
    # The strokes become small while nothing is read: what they turned at last stays in the memory for long.
    u[1500:] = 3.5 + (u[1500:] - 3.5) * np.exp(-np.arange(1500) * DT / 0.15)
    y = GAIN * u
    y[1500:1900] = math.nan
    compared = 0
    for k in range(3000):
        model.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
        if k % model.config.block == 0 and k > 2000 and not learner.parts.intake.holds:
            compared += 1
            np.testing.assert_array_equal(model.judge.scores[0].memory, learner.memory())
    assert compared > 20


def test_state_of_other_contestants_is_refused() -> None:
    def made(*names: str) -> Competition:
        mpi = {name: MpiOnline(MpiInverse(MPI, DT, SEEN, 0.01)) for name in names}
        return Competition({"learner": Learner(replace(lssvm(), span_V=SPAN_V)), **mpi}, SPAN_V)

    one = made("mpi")
    feed(one, 1010, 0)
    state = one.state_dict()
    two = made("mpi").restored(state)
    for model in (one, two):
        feed(model, 1000, 1010)
    assert [f"{score.square_V2!r}" for score in one.judge.scores] == [f"{s.square_V2!r}" for s in two.judge.scores]
    for bad in (
        {**state, "names": "learner,other"},
        {name: value for name, value in state.items() if name != "champion"},
        {name: value for name, value in state.items() if not name.startswith("model.mpi.")},
        {**state, "past_seq": np.empty(0, dtype=np.int64)},
    ):
        with pytest.raises(ModelFileError):
            made("mpi").restored(bad)
    with pytest.raises(ModelFileError):
        made("mpi", "more").restored(state)
    with pytest.raises(InputError, match="learner"):
        Competition({"mpi": MpiOnline(MpiInverse(MPI, DT, SEEN, 0.01))}, SPAN_V)


def test_a_champion_model_is_stored_and_refuses_what_does_not_fit() -> None:
    served = ChampionInverse(("mpi", "linear"), (MpiInverse(MPI, DT, SEEN, 0.01), line()), 1)
    again = ChampionInverse.from_state(served.state_dict())
    y, zero = np.linspace(5.0, 50.0, 40), np.zeros(40)
    memory = served.rest_memory(5.0)
    np.testing.assert_array_equal(
        again.feedforward(y, zero, zero, memory).u_V, served.feedforward(y, zero, zero, memory).u_V
    )
    with pytest.raises(InputError, match="memory"):
        served.feedforward(y, zero, zero, memory[:-1])
    with pytest.raises(InputError, match="champion"):
        ChampionInverse(("mpi",), (line(),), 1)
    nonsense = memory.copy()
    nonsense[:2] = np.nan
    np.testing.assert_array_equal(
        served.feedforward(y, zero, zero, nonsense).u_V, served.feedforward(y, zero, zero, memory).u_V
    )


@pytest.mark.parametrize(
    "bad", [{"block": 0}, {"margin": 0.9}, {"horizon_s": 0.0}, {"patience_s": -1.0}, {"floor": 2.0}]
)
def test_bad_settings_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError):
        CompetitionConfig(**bad)  # type: ignore[arg-type]


def test_who_has_no_share_follows_what_is_answered_and_who_has_one_answers_itself() -> None:
    mpi = MpiInverse(MPI, DT, SEEN, 0.1)
    bouc_wen = BoucWenInverse(BOUC_WEN, DT, SEEN, 0.1)
    auto = ChampionInverse(("line", "mpi", "bouc_wen"), (line(), mpi, bouc_wen), 0)
    y = 40.0 + 20.0 * np.sin(np.arange(60) * 0.1)
    still = np.zeros(y.size)
    memory = auto.rest_memory(40.0)
    whole = auto.feedforward(y, still, still, memory)
    np.testing.assert_array_equal(whole.u_V, line().feedforward(y, still, still, np.zeros(0)).u_V)
    parts = np.split(whole.memory, np.cumsum([3, 0, mpi.memory_size])[:3])
    for model, part in ((mpi, parts[2]), (bouc_wen, parts[3])):
        np.testing.assert_array_equal(part, model.track(y, still, still, whole.u_V, model.rest_memory(40.0)))
    # The long way, by shares that are the champion's but for what rounding left of another, comes to the same.
    almost = memory.copy()
    almost[:3] = (1.0, -0.0, 0.0)
    for name in ("u_V", "std_V", "inside", "memory"):
        np.testing.assert_array_equal(getattr(auto.feedforward(y, still, still, almost), name), getattr(whole, name))
    shared = memory.copy()
    shared[:3] = (0.5, 0.5, 0.0)
    blended = auto.feedforward(y, still, still, shared)
    own = mpi.feedforward(y, still, still, mpi.rest_memory(40.0)).memory
    np.testing.assert_array_equal(np.split(blended.memory, np.cumsum([3, 0, mpi.memory_size])[:3])[2], own)


def lssvm(gain: float = GAIN) -> LssvmInverse:
    """The inverse of a straight line, as a window without samples makes it."""
    features = FeatureMap(DT, 0.0, 80.0, 2000.0, 1e5, (2.0, 8.0), (), (), (0,))
    beta = np.zeros(features.basis_size)
    beta[:2] = 40.0 / gain, 40.0 / gain
    count = features.kernel_size
    return LssvmInverse(
        "lssvm", features, beta, np.zeros((4, count)), np.zeros(4), np.ones(count), 10.0,
        np.array([0.0, 80.0, -2e3, 2e3, -1e9, 1e9]),
    )  # fmt: skip


def test_the_quick_way_of_one_point_is_the_long_one() -> None:
    mpi, bouc_wen = MpiInverse(MPI, DT, SEEN, 0.01), BoucWenInverse(BOUC_WEN, DT, SEEN, 0.01)
    auto = ChampionInverse(("lssvm", "mpi", "bouc_wen"), (lssvm(), mpi, bouc_wen), 0)
    long = quick = auto.rest_memory(5.0)
    one = np.empty(1), np.empty(1)
    for y_um in 20.0 + 15.0 * np.sin(np.arange(80) * 0.2):
        point = np.array([y_um]), np.array([30.0]), np.zeros(1)
        slow = auto.feedforward(*point, long)
        after = quick.copy()
        answer = auto.evaluate_point(float(y_um), 30.0, 0.0, after, one)
        assert answer == (slow.u_V[0], slow.std_V[0], slow.inside[0])
        np.testing.assert_array_equal(after, slow.memory)
        long, quick = slow.memory, after


def test_frozen_the_champion_stays_and_nobody_learns() -> None:
    model, one, two = contest(GAIN, 1.02 * GAIN)
    feed(model, 1000, 0)
    model.freeze()
    one.gain = 2.0 * GAIN
    feed(model, 3000, 1000)
    assert (model.champion, two.seq) == ("one", 999)
    model.thaw()
    feed(model, 1500, 4000)
    assert model.champion == "two"
