"""The competition and the re-tuning as an axis has them: a degraded learner is replaced, tuned again, and replayed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.tuning.config import RetuneConfig
from dehyst.adaptive.types import FloatArray, Hyperparameters, InverseModel
from dehyst.baselines import fit_linear, fit_mpi
from dehyst.service.answers.guard import Limits
from dehyst.service.background.adoptions import ADOPTIONS_FILE, Adoptions, Retuned, append_adoption, read_adoptions
from dehyst.service.background.retuner import Retuner
from dehyst.service.background.retuning_worker import start_job
from dehyst.service.background.settings import RetuningConfig
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.online_models import PlainModel

DT_S = 1e-3
LIMITS = Limits(-2.0, 10.0, 4000.0)
ABSURD = Hyperparameters(1e7, (0.02,) * 5)


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, np.ndarray]:
    """(u_V, y_um) of 14 s on the rich stage: the chapter's signal, then tones."""
    stage = Stage(preset("rich", seed=4))
    t_s = np.arange(8000) * DT_S
    tones = 3.4 + 1.1 * np.sin(2 * np.pi * 1.7 * t_s) + 0.9 * np.sin(2 * np.pi * 4.3 * t_s + 1.0)
    u_V = np.concatenate([training_input(DT_S, 6.0)[1], tones])
    y_um, _ = stage.run(stage.initial_state(), u_V)
    return u_V, y_um


@pytest.fixture(scope="module")
def bundle(recorded: tuple[np.ndarray, np.ndarray]) -> Bundle:
    from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm

    u_V, y_um = (column[:6000] for column in recorded)
    found: dict[str, InverseModel] = {
        "lssvm_adaptive": identify_lssvm(u_V, y_um, DT_S, config=IdentifyConfig(tune=False, n=200))[0],
        "mpi": fit_mpi(u_V, y_um, DT_S)[0],
        "linear": fit_linear(u_V, y_um, DT_S)[0],
    }
    return Bundle(found, BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))


def axis_of(bundle: Bundle, **more: Any) -> Axis:
    config = AxisConfig("x", Path("x.npz"), LIMITS, learner={"window": 200}, **more)
    return load_axis("demo", config, bundle=bundle)


def give(
    axis: Axis,
    recorded: tuple[np.ndarray, np.ndarray],
    start: int,
    stop: int,
    retuner: Retuner | None = None,
    size: int = 20,
) -> None:
    u_V, y_um = recorded
    for k in range(start, stop, size):
        seq = np.arange(k, min(stop, k + size))
        t_s: FloatArray = (seq * DT_S).astype(np.float64)
        axis.handle(SampleBatch(seq, t_s, u_V[seq], y_um[seq]))
        if retuner is not None:
            retuner.step(axis)


def ask(axis: Axis, name: str = "") -> Any:
    zero = np.zeros(5)
    return axis.answer(FeedforwardQuery(np.full(5, 40.0), zero, zero, None, name))


def degrade(axis: Axis, by_V: float) -> None:
    """Poison the learner: what its linear part gives is off by ``by_V``, whatever it learns."""
    learner: Any = axis.learner
    favourite = learner.favourite
    inner = favourite.snapshot

    def snapshot() -> InverseModel:
        model = inner()
        beta = model.beta.copy()
        beta[0] += by_V
        worse: InverseModel = replace(model, beta=beta)
        return worse

    favourite.snapshot = inner if by_V == 0.0 else snapshot


def test_the_champion_answers_by_default_and_is_the_learner_while_that_is_best(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray]
) -> None:
    axis = axis_of(bundle)
    assert axis.served == "auto"
    give(axis, recorded, 0, 4000)
    default, own = ask(axis), ask(axis, "lssvm_adaptive")
    assert default.model == "auto"
    np.testing.assert_array_equal(default.u_V, own.u_V)
    learner: Any = axis.learner
    standing = learner.standing()
    assert standing["champion"] == "lssvm_adaptive"
    assert set(standing["contestants"]) == {"lssvm_adaptive", "linear", "mpi"}
    assert "competition_mpi_rms_pct" in learner.diagnostics()
    json.dumps(standing)


def test_a_poisoned_learner_is_replaced_by_a_baseline_and_comes_back(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray]
) -> None:
    axis = axis_of(bundle)
    give(axis, recorded, 0, 3000)
    learner: Any = axis.learner
    inner = learner.favourite.snapshot
    degrade(axis, 0.6)
    give(axis, recorded, 3000, 5000)
    assert learner.champion == "mpi"
    assert axis.answering() == "rival"
    assert [event["event"] for event in axis.take_events()].count("champion_changed") == 1
    bad, served, baseline = (ask(axis, name).u_V[-1] for name in ("lssvm_adaptive", "", "mpi"))
    assert abs(served - baseline) < 0.15 < 0.4 < abs(bad - served)
    learner.favourite.snapshot = inner
    give(axis, recorded, 5000, 9000)
    assert learner.champion == "lssvm_adaptive"
    assert axis.answering() == "learnt"
    np.testing.assert_array_equal(ask(axis).u_V, ask(axis, "lssvm_adaptive").u_V)


def test_a_state_goes_on_to_the_last_bit_with_adoptions_to_come(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray]
) -> None:
    one = axis_of(bundle)
    give(one, recorded, 0, 2500)
    hyper = Hyperparameters(500.0, tuple(1.3 * w for w in hyper_of(one).widths))
    one.adopt_at(Retuned(2800, hyper.gamma, hyper.widths))
    state = one.state_dict()
    two = axis_of(bundle)
    two.restore(state)
    for axis in (one, two):
        give(axis, recorded, 2500, 4000)
    assert [e["event"] for e in one.take_events() if e["event"].startswith("retun")] == [
        e["event"] for e in two.take_events() if e["event"].startswith("retun")
    ]
    for name in ("auto", "lssvm_adaptive"):
        np.testing.assert_array_equal(ask(one, name).u_V, ask(two, name).u_V)


# ---- re-tuning


@pytest.fixture
def retuner(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Retuner]:
    settings: dict[str, Any] = {"period_s": 0.0, "fresh": 80, "lead_s": 0.1}
    # A short search: where kernels are far too wide, any descent finds it.
    settings["search"] = RetuneConfig(starts=2, rows=100, iterations=15)
    made = Retuner(RetuningConfig(**{**settings, **getattr(request, "param", {})}), tmp_path)
    yield made
    made.close()


def wait_for(retuner: Retuner) -> None:
    until = time.monotonic() + 120.0
    while retuner._job is not None and retuner._job.result is None and time.monotonic() < until:
        time.sleep(0.02)


@pytest.fixture(scope="module")
def rippled(recorded: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The same with what a sensor's interpolation error adds: a ripple that kernels as wide as the range can't follow,
    and that the linear part does not span. What was identified knows nothing of it."""
    u_V, y_um = recorded
    return u_V, y_um + 0.3 * np.sin(2.0 * np.pi * y_um / 15.0)


def tunable(bundle: Bundle) -> Axis:
    """An axis whose model was identified without tuning: the same wide kernel for all inputs."""
    config = AxisConfig("x", Path("x.npz"), LIMITS, learner={"window": 200, "learn_every": 5}, compete=())
    return load_axis("demo", config, bundle=bundle)


def hyper_of(axis: Axis) -> Hyperparameters:
    assert axis.learner is not None
    data = axis.learner.window_data()
    assert data is not None
    return data.hyper


def retuned_from_7700(axis: Axis, recorded: tuple[np.ndarray, np.ndarray], retuner: Retuner) -> list[dict[str, Any]]:
    """Ask at sample 7700, go on to 12500; the events."""
    give(axis, recorded, 6000, 7700, retuner)
    assert retuner.request({}) == {"started": True, "job": 1}
    assert retuner.request({})["started"] is False
    for k in range(7700, 12500, 100):
        give(axis, recorded, k, k + 100, retuner)
        wait_for(retuner)
    return axis.take_events()


def prequential_mV(axis: Axis, recorded: tuple[np.ndarray, np.ndarray], start: int, stop: int) -> float:
    """rms error, mV, of what was served, at the age of an answer, on samples that had taught nothing."""
    learner: Any = axis.learner
    errors_V = []
    for k in range(start, stop, 2):
        give(axis, recorded, k, k + 2)
        errors_V.append(learner.parts.judgement.error_V)
    return 1e3 * float(np.sqrt(np.mean(np.square(errors_V))))


@pytest.mark.alone
def test_kernels_far_too_wide_are_tuned_predict_better_and_a_replay_does_the_same(
    bundle: Bundle, rippled: tuple[np.ndarray, np.ndarray], retuner: Retuner, tmp_path: Path
) -> None:
    axis = tunable(bundle)
    before = hyper_of(axis)
    events = {event["event"]: event for event in retuned_from_7700(axis, rippled, retuner)}
    last = retuner.status()["last"]
    assert last["outcome"] == "better", last
    assert last["after_V"] < 0.9 * last["before_V"]
    assert min(last["widths"]) < 0.1 * min(before.widths)
    assert "retuning_refused" not in events
    announced, done = events["retuning_adopted"], events["retuned"]
    assert announced["retuned"] == done["retuned"]
    # Announced a lead ahead, taken over right after the sample that was named.
    at = announced["retuned"]["seq"]
    assert (at - announced["seq"], done["seq"]) == (100, at)
    assert hyper_of(axis) == Retuned.from_json(done["retuned"]).hyper != before
    tuned_mV = prequential_mV(axis, rippled, 12500, 14000)
    until = time.monotonic() + 10.0
    while not read_adoptions(tmp_path) and time.monotonic() < until:
        time.sleep(0.01)
    again, without = tunable(bundle), tunable(bundle)
    again.adopt_at(*read_adoptions(tmp_path))
    for other in (again, without):
        give(other, rippled, 6000, 12500, size=37)
    untuned_mV = prequential_mV(without, rippled, 12500, 14000)
    assert tuned_mV < 0.75 * untuned_mV
    assert prequential_mV(again, rippled, 12500, 14000) == tuned_mV
    for key, value in axis.newest.models["lssvm_adaptive"].state_dict().items():
        np.testing.assert_array_equal(value, again.newest.models["lssvm_adaptive"].state_dict()[key])


@pytest.mark.alone
def test_a_bad_proposal_is_found_out_by_its_trial(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray], retuner: Retuner, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Misled:
        """Proposes nonsense; the trial is the real one."""

        def __init__(self) -> None:
            self.result = {"changed": True, "gamma": ABSURD.gamma, "widths": list(ABSURD.widths)}

        def cancel(self) -> None: ...

    def job(order: dict[str, Any], *rest: Any) -> Any:
        return Misled() if order["kind"] == "propose" else start_job(order, *rest)

    monkeypatch.setattr("dehyst.service.background.retuner.start_job", job)
    axis = tunable(bundle)
    before = hyper_of(axis)
    events = [event["event"] for event in retuned_from_7700(axis, recorded, retuner)]
    last = retuner.status()["last"]
    assert last["outcome"] == "worse", last
    assert last["after_V"] > last["before_V"]
    assert not [event for event in events if event.startswith("retun")]
    assert hyper_of(axis) == before
    assert retuner.status()["state"] == "idle"


def test_a_bad_adoption_is_refused_by_the_learner_and_changes_nothing(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray]
) -> None:
    told, quiet = tunable(bundle), tunable(bundle)
    told.adopt_at(Retuned(7000, ABSURD.gamma, ABSURD.widths))
    for axis in (told, quiet):
        give(axis, recorded, 6000, 8000)
    assert [event["event"] for event in told.take_events() if event["event"].startswith("retun")] == [
        "retuning_refused"
    ]
    for key, value in quiet.newest.models["lssvm_adaptive"].state_dict().items():
        np.testing.assert_array_equal(value, told.newest.models["lssvm_adaptive"].state_dict()[key])


@pytest.mark.parametrize("retuner", [{"timeout_s": 0.05}], indirect=True)
def test_what_takes_too_long_is_ended_and_counted(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray], retuner: Retuner
) -> None:
    axis = axis_of(bundle, compete=())
    give(axis, recorded, 0, 1000, retuner)
    retuner.request({})
    give(axis, recorded, 1000, 1020, retuner)
    wait_for(retuner)
    give(axis, recorded, 1020, 1040, retuner)
    status = retuner.status()
    assert (status["timeouts"], status["state"]) == (1, "idle")
    assert "timeout_s" in status["last"]["detail"]


@pytest.mark.parametrize("retuner", [{"period_s": 1.0, "fresh": 200}], indirect=True)
def test_it_begins_by_itself_while_the_stage_moves_and_not_at_rest(
    bundle: Bundle, recorded: tuple[np.ndarray, np.ndarray], retuner: Retuner
) -> None:
    axis = axis_of(bundle, compete=())
    u_V, y_um = recorded
    rest = np.full(3000, u_V[0]), y_um[0] + 0.003 * np.random.default_rng(1).normal(size=3000)
    give(axis, rest, 0, 3000, retuner)
    assert retuner.status()["started"] == 0
    give(axis, (np.concatenate([rest[0], u_V]), np.concatenate([rest[1], y_um])), 3000, 6000, retuner)
    assert retuner.status()["started"] == 1


def test_adoptions_are_made_once_in_order_at_their_sample(bundle: Bundle, tmp_path: Path) -> None:
    class Taker(PlainModel):
        def __init__(self) -> None:
            super().__init__(bundle.models["linear"])
            self.taken: list[float] = []

        def adopt(self, hyper: Hyperparameters) -> str:
            self.taken.append(hyper.gamma)
            return "worse: no" if hyper.gamma > 2.5 else ""

    adoptions, learner = Adoptions(), Taker()
    adoptions.add(Retuned(30, 3.0, (1.0,)), Retuned(10, 1.0, (1.0,)))
    adoptions.add(Retuned(20, 2.0, (1.0,)))
    made = {seq: [entry.seq for entry, _ in adoptions.apply(seq, learner)] for seq in range(9, 40)}
    assert {seq: entries for seq, entries in made.items() if entries} == {10: [10], 20: [20], 30: [30]}
    assert learner.taken == [1.0, 2.0, 3.0]
    assert (adoptions.adopted, adoptions.refused, adoptions.pending) == (2, 1, ())
    for retuned in (Retuned(3, 0.1 + 0.2, (1 / 3, 7.0)), Retuned(5, 1e7, (0.5,))):
        append_adoption(tmp_path, retuned)
    assert list(read_adoptions(tmp_path)) == [Retuned(3, 0.1 + 0.2, (1 / 3, 7.0)), Retuned(5, 1e7, (0.5,))]
    with (tmp_path / ADOPTIONS_FILE).open("a") as file:
        file.write('{"seq": 7, "gam')
    assert len(read_adoptions(tmp_path)) == 2
    (tmp_path / ADOPTIONS_FILE).write_text('{"seq": 1, "gamma": -1, "widths": [1]}\n')
    with pytest.raises(InputError, match="gamma"):
        read_adoptions(tmp_path)
