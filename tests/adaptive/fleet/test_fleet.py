"""Each axis of a fleet equals a single learner on the same samples, and its state is a single learner's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.fleet.fleet import NO_SAMPLE, Fleet, FleetConfig
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import OUTCOMES, AdmissionConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.sensor_trust import SENSOR_STUCK
from dehyst.adaptive.types import Sample
from dehyst.adaptive.window.window import SolverConfig
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT = 1e-3
ALIKE = 1e-9


def drive(n: int, seed: int) -> np.ndarray:
    """(n,) voltages, V: eight tones up to 12 Hz."""
    rng, t_s = np.random.default_rng(seed), np.arange(n) * DT
    hz = rng.uniform(0.3, 12.0, 8)
    tones = np.sin(2.0 * np.pi * hz[:, None] * t_s + rng.uniform(0.0, 6.28, (8, 1))) / np.sqrt(hz)[:, None]
    wave = tones.sum(0) / np.abs(tones.sum(0)).max()
    return (4.0 + 3.5 * wave) * np.minimum(1.0, t_s / 0.2)


@pytest.fixture(scope="module")
def models() -> list[LssvmInverse]:
    """Of both presets, in turn, each axis with a gain of its own."""
    made = []
    for name in ("rich", "bouc_wen"):
        stage = Stage(preset(name, seed=1))
        _, u = training_input(DT, 10.0)
        y, _ = stage.run(stage.initial_state(), u)
        config = IdentifyConfig(tune=False, n=60, gamma=1e3)
        made.append(identify_lssvm(u, y, DT, config=config)[0])
    two = [made[axis % 2] for axis in range(4)]
    return [replace(m, features=replace(m.features, gain=1.0 + 0.01 * axis)) for axis, m in enumerate(two)]


def samples(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(4, n) voltages and readings: glitches and NaN everywhere, jumps, a change of gain, a rest, a stuck sensor."""
    u, y = np.empty((4, n)), np.empty((4, n))
    for axis in range(4):
        stage = Stage(preset(("rich", "bouc_wen")[axis % 2], seed=axis))
        u[axis] = drive(n, 5 + axis)
        if axis == 2:
            u[axis, n // 2 : n // 2 + 800] = u[axis, n // 2]
        y[axis] = (1.0 + 0.01 * axis) * stage.run(stage.initial_state(), u[axis])[0]
        rng = np.random.default_rng(axis)
        y[axis, rng.integers(400, n, 8)] += rng.normal(0.0, 8.0, 8)
        y[axis, rng.integers(400, n, 5)] = np.nan
    y[1, n // 3 :] += 4.0
    y[3, 2 * n // 3 :] *= 0.93
    stuck = y[0, n // 4 : n // 4 + 600]
    stuck[:] = stuck[0] + 0.005 * np.random.default_rng(9).standard_normal(stuck.size)
    return u, y


def compare(
    fleet: Fleet, singles: list[Learner], first: int, u: np.ndarray, y: np.ndarray, every: int, gaps: bool = True
) -> None:
    """Feed both with samples (4, n) from number ``first`` on; assert that they stay alike.

    ``gaps`` : some samples do not come, and some numbers are repeated.
    """
    n = u.shape[1]
    seq, present = first + np.arange(n)[None].repeat(4, 0), np.ones((4, n), dtype=np.bool_)
    if gaps:
        rng = np.random.default_rng(first)
        present = rng.random((4, n)) > 0.001
        present[3, n // 2 : n // 2 + 40] = False
        seq[rng.integers(0, 4, 6), rng.integers(10, n, 6)] -= 1
    t_s = seq * DT
    at_um = np.linspace(12.0, 50.0, 3)[None].repeat(4, 0)
    speed, still = np.full_like(at_um, 40.0), np.zeros_like(at_um)
    for k in range(n):
        said = fleet.step(seq[:, k], t_s[:, k], u[:, k], y[:, k], present[:, k])
        for axis, single in enumerate(singles):
            if not present[axis, k]:
                assert said[axis] == NO_SAMPLE
                continue
            sample = Sample(int(seq[axis, k]), float(t_s[axis, k]), float(u[axis, k]), float(y[axis, k]))
            assert OUTCOMES[said[axis]] == single.handle(sample), (axis, k)
        if k % every == every - 1:
            snapshot, memory = fleet.snapshot(), fleet.memory()
            answers = snapshot.feedforward(at_um, speed, still, memory)
            for axis, single in enumerate(singles):
                model = single.snapshot()
                kept = single.memory_for(model)
                assert kept is not None
                expected = model.feedforward(at_um[axis], speed[axis], still[axis], kept)
                np.testing.assert_allclose(answers.u_V[axis], expected.u_V, atol=ALIKE, rtol=0, err_msg=f"{axis} {k}")
                np.testing.assert_allclose(answers.std_V[axis], expected.std_V, atol=1e-7, rtol=0)
                np.testing.assert_array_equal(answers.inside[axis], expected.inside)
                assert snapshot.valid[axis] == model.valid
                # A single learner keeps its snapshot while nothing is learnt, with the number it had then.
                assert snapshot.seq[axis] >= model.seq
            troubles = fleet.troubles()
            assert [troubles.get(axis, "") for axis in range(4)] == [single.trouble for single in singles]


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_each_axis_equals_the_single_learner(models: list[LssvmInverse]) -> None:
    config = LearnerConfig(window=60)
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    u, y = samples(10_000)
    compare(fleet, singles, 0, u, y, 250)
    for axis, single in enumerate(singles):
        got, expected = fleet.learner_of(axis).counters(), single.counters()
        # When a step is refined depends on the last bits.
        rounding = ("window_residuals_exceeded", "window_refinements")
        assert {n: v for n, v in got.items() if n not in rounding} == {
            n: v for n, v in expected.items() if n not in rounding
        }
    # The comparison has seen what it is for.
    total = {name: sum(single.counters()[name] for single in singles) for name in singles[0].counters()}
    wanted = ("glitch", "jumps", "trials", "bursts", "unexcited", "not_finite", "gap", "duplicate")
    assert [name for name in wanted if not total[name]] == []


def test_axes_equal_single_learners_while_stages_drift_beside_the_voltage(models: list[LssvmInverse]) -> None:
    config = LearnerConfig(window=60)
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    n = 4000
    u, y = np.empty((4, n)), np.empty((4, n))
    for axis in range(4):
        stage = Stage(preset(("rich", "bouc_wen")[axis % 2], seed=axis))
        u[axis] = 4.0 + 1.5 * np.sin(2.0 * np.pi * (0.8 + 0.3 * axis) * np.arange(n) * DT)
        y[axis] = (1.0 + 0.01 * axis) * stage.run(stage.initial_state(), u[axis])[0]
        y[axis] += 18.0 * axis * np.clip((np.arange(n) - 1500) * DT, 0.0, 1.0)
    compare(fleet, singles, 0, u, y, 250)
    # The sums of the sensor check have followed, and some of them stand for a drift.
    rates = [learner.parts.intake.following.drift_V_per_s for learner in singles]
    assert max(map(abs, rates)) > 0.0
    got = [fleet.learner_of(axis).parts.intake.following.drift_V_per_s for axis in range(4)]
    # Differences of sums over marks, so that rounding counts more than in the voltages.
    np.testing.assert_allclose(got, rates, rtol=1e-4, atol=1e-9)


def test_axes_equal_single_learners_while_sensors_lie(models: list[LssvmInverse]) -> None:
    """Stuck with noise; three times a small motion, which surprises nothing, with a trial before the learnt gain is
    beyond its bound; the same two without credit, where the models may not judge the sensor."""
    config, n, at = LearnerConfig(window=60), 3000, 1500
    t_s = np.arange(n) * DT
    u, y = np.empty((4, n)), np.empty((4, n))
    for axis in range(4):
        stage = Stage(preset(("rich", "bouc_wen")[axis % 2], seed=axis))
        small = np.where(t_s < 0.5 * at * DT, 1.0, 0.1) if axis % 2 else np.ones(n)
        u[axis] = 4.0 + small * 1.5 * np.sin(2.0 * np.pi * (1.1 + 0.3 * axis) * t_s)
        y[axis] = (1.0 + 0.01 * axis) * stage.run(stage.initial_state(), u[axis])[0]
        if axis % 2:
            y[axis, at:] = y[axis, at] + 3.0 * (y[axis, at:] - y[axis, at])
        else:
            y[axis, at:] = y[axis, at] + 1e-4 * np.random.default_rng(axis).standard_normal(n - at)
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    compare(fleet, singles, 0, u[:, :at], y[:, :at], 250)
    for axis in (2, 3):
        doubtful = singles[axis].state_dict() | {"front.credit": -3, "front.until_control": 10_000}
        singles[axis] = Learner.from_state(doubtful)
        fleet.load_axis(axis, doubtful)
    compare(fleet, singles, at, u[:, at:], y[:, at:], 10)
    assert [single.counters()["trials"] > 0 for single in singles][:3] == [True, True, True]
    assert singles[2].trouble == SENSOR_STUCK


def small_motion(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(4, n) voltages and readings: one slow tone each, nothing wrong."""
    u, y = np.empty((4, n)), np.empty((4, n))
    for axis in range(4):
        stage = Stage(preset(("rich", "bouc_wen")[axis % 2], seed=axis))
        u[axis] = 4.0 + 1.5 * np.sin(2.0 * np.pi * (1.1 + 0.3 * axis) * np.arange(n) * DT)
        y[axis] = (1.0 + 0.01 * axis) * stage.run(stage.initial_state(), u[axis])[0]
    return u, y


def doctor(fleet: Fleet, singles: list[Learner], axis: int, beta: np.ndarray) -> None:
    """Another estimate of the linear part, in both; frozen, or they would find their way by themselves, slowly."""
    doctored = singles[axis].state_dict() | {"filter.beta": beta, "frozen": True}
    singles[axis] = Learner.from_state(doctored)
    fleet.load_axis(axis, doctored)


def test_a_spoilt_model_gives_way_to_the_identified_one_as_in_a_single_learner(
    models: list[LssvmInverse],
) -> None:
    config, at = LearnerConfig(window=60), 2500
    u, y = small_motion(4000)
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    compare(fleet, singles, 0, u[:, :at], y[:, :at], 250)
    beta = singles[1].parts.filter.beta
    beta[0] += 0.6 * models[1].span_V
    doctor(fleet, singles, 1, beta)
    compare(fleet, singles, at, u[:, at : at + 50], y[:, at : at + 50], 51, gaps=False)
    compare(fleet, singles, at + 50, u[:, at + 50 : at + 150], y[:, at + 50 : at + 150], 101, gaps=False)
    assert [bool(fleet.learner_of(axis).diagnostics()["fallback"]) for axis in range(4)] == [False, True, False, False]
    fleet.freeze([1], False)
    singles[1].thaw()
    compare(fleet, singles, at + 150, u[:, at + 150 :], y[:, at + 150 :], 50)
    assert fleet.troubles() == {}


def test_axes_equal_single_learners_at_a_limit_and_where_the_model_fails(models: list[LssvmInverse]) -> None:
    """Saturated samples, and stages that change so much that the identified model is served, or an estimate undone."""
    config = LearnerConfig(window=60, admission=AdmissionConfig(u_min_V=0.0, u_max_V=5.5))
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    u, y = samples(4000)
    u = np.minimum(u, 5.5)
    for axis in range(4):
        stage = Stage(preset(("rich", "bouc_wen")[axis % 2], seed=axis))
        y[axis] = (1.0 + 0.01 * axis) * stage.run(stage.initial_state(), u[axis])[0]
    # The voltage shows less and less of the motion: what was learnt last is of no use for what comes.
    wave = np.sin(2.0 * np.pi * 5.0 * np.arange(4000) * DT) * np.clip((np.arange(4000) - 1500) * 1e-3, 0.0, 1.0)
    y[0] += 3.0 * wave
    y[1, 2000:2600] = y[1, 2000] + 0.6 * (y[1, 2000:2600] - y[1, 2000])
    compare(fleet, singles, 0, u, y, 100)
    total = {name: sum(single.counters()[name] for single in singles) for name in singles[0].counters()}
    assert [name for name in ("saturated", "fallbacks", "rollbacks") if not total[name]] == [], total


def test_a_refused_step_is_the_single_learners_and_costs_no_other_axis(models: list[LssvmInverse]) -> None:
    config = LearnerConfig(window=60, solver=SolverConfig(form="inverse"))
    fleet, singles = Fleet(models, FleetConfig(config)), [Learner(model, config) for model in models]
    u, y = samples(1200)
    compare(fleet, singles, 0, u[:, :700], y[:, :700], 100)
    # An inverse that is wrong: the next row's residual shows it.
    state = singles[1].state_dict()
    state["window.PR"] = state["window.PR"] * np.where(np.tri(60, 61, dtype=np.bool_), 3.0, 1.0)
    singles[1] = Learner.from_state(state)
    fleet.load_axis(1, state)
    compare(fleet, singles, 700, u[:, 700:], y[:, 700:], 50)
    refused = [single.counters()["window_ill_conditioned"] for single in singles]
    assert refused[1] > 0
    assert refused[0] == refused[2] == refused[3] == 0
    assert [fleet.learner_of(axis).counters()["window_ill_conditioned"] for axis in range(4)] == refused


def test_axes_with_twelve_inputs_equal_single_learners() -> None:
    stage = Stage(preset("rich", seed=1))
    _, u = training_input(DT, 6.0)
    y, _ = stage.run(stage.initial_state(), u)
    model = identify_lssvm(u, y, DT, config=IdentifyConfig(tune=False, n=60, gamma=1e3, kernel_plays=10))[0]
    assert model.features.kernel_size == 12
    config = LearnerConfig(window=80)
    fleet, singles = Fleet([model] * 4, FleetConfig(config)), [Learner(model, config) for _ in range(4)]
    u, y = samples(1000)
    compare(fleet, singles, 0, u, y, 100)


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_a_state_moves_between_fleet_and_single_learner(models: list[LssvmInverse], device: str) -> None:
    config = LearnerConfig(window=60, solver=SolverConfig(form="inverse"))
    fleet = Fleet(models, FleetConfig(config, device))
    singles = [Learner(model, config) for model in models]
    u, y = samples(1500)
    compare(fleet, singles, 0, u[:, :700], y[:, :700], 100)
    # Out of the fleet, and into it: the axes change places with the single learners.
    out = [Learner.from_state(fleet.learner_of(axis).state_dict()) for axis in range(4)]
    for axis, single in enumerate(singles):
        fleet.load_axis(axis, single.state_dict())
    compare(fleet, out, 700, u[:, 700:], y[:, 700:], 100)


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_axes_with_kept_samples_and_fifo_equal_single_learners(models: list[LssvmInverse], device: str) -> None:
    config = LearnerConfig(window=60, eviction="fifo", solver=SolverConfig(form="inverse"))
    fleet = Fleet(models, FleetConfig(config, device))
    singles = [Learner(model, config) for model in models]
    u, y = samples(1200)
    compare(fleet, singles, 0, u, y, 100)
    assert min(single.counters()["window_steps"] for single in singles) > 20


def test_axes_that_begin_as_one_window_learn_apart(models: list[LssvmInverse]) -> None:
    config = LearnerConfig(window=60)
    # One control trial at a time: one of the axes has its first step within the batch.
    fleet = Fleet([models[0]] * 900, FleetConfig(config, checks=1))
    u, y = samples(700)
    moving = {3: Learner(models[0], config), 899: Learner(models[0], config)}
    present = np.isin(np.arange(900), list(moving))
    for k in range(700):
        fleet.step(k, k * DT, u[0, k], np.where(np.arange(900) == 3, y[0, k], 1.01 * y[0, k]), present)
        for axis, single in moving.items():
            single.handle(Sample(k, k * DT, float(u[0, k]), float(y[0, k] if axis == 3 else 1.01 * y[0, k])))
    begun = Learner(models[0], config).state_dict()
    states = [fleet.learner_of(axis).state_dict() for axis in (3, 899, 2, 898)]
    for name in ("window.PR", "window.P", "window.R", "window.V"):
        for axis, state in zip(moving, states, strict=False):
            if name in state:
                np.testing.assert_allclose(state[name], moving[axis].state_dict()[name], atol=1e-9, rtol=1e-9)
        for state in states[2:]:
            assert name not in state or np.array_equal(state[name], begun[name])
    assert min(single.counters()["window_steps"] for single in moving.values()) > 5


def test_bad_values_are_refused_for_their_axis_alone(models: list[LssvmInverse]) -> None:
    fleet = Fleet(models, FleetConfig(LearnerConfig(window=60)))
    u, y = samples(500)
    for k in range(300):
        fleet.step(k, k * DT, u[:, k], y[:, k])
    before = fleet.outcomes()
    said = fleet.step([299, 300, 250, 300], [0.299, np.inf, 0.25, 0.3], u[:, 300], y[:, 300])
    assert [OUTCOMES[code] for code in said[:3]] == ["duplicate", "not_finite", "out_of_order"]
    assert OUTCOMES[said[3]] in ("learnt", "passed")
    assert (fleet.outcomes() - before).sum() == 4


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_a_frozen_axis_learns_nothing(models: list[LssvmInverse], device: str) -> None:
    config = LearnerConfig(window=60, solver=SolverConfig(form="inverse"))
    fleet = Fleet(models, FleetConfig(config, device))
    u, y = samples(1200)
    for k in range(600):
        fleet.step(k, k * DT, u[:, k], y[:, k])
    learnt = fleet.snapshot()
    fleet.freeze([2])
    before = fleet.snapshot()
    np.testing.assert_allclose(before.linear, learnt.linear, rtol=1e-14)
    # Its stage changes, so that the identified model would be served, and the axis is apart for a while.
    y[2, 650:] = 0.5 * y[2, 650:]
    apart = False
    for k in range(600, 1200):
        fleet.step(k, k * DT, u[:, k], y[:, k])
        apart = apart or 2 in fleet.apart
    after = fleet.snapshot()
    changed = [not np.array_equal(before.linear[axis], after.linear[axis]) for axis in range(4)]
    assert changed[1:] == [True, False, True]
    assert apart
    assert fleet.learner_of(2).counters()["frozen"] > 0
    # To the last bit, stated deviations too.
    at_um, memory = np.full((4, 1), 40.0), before.rest_memory()
    answers = [one.feedforward(at_um, 0.0 * at_um, 0.0 * at_um, memory) for one in (before, after)]
    assert answers[0].u_V[2] == answers[1].u_V[2]
    assert answers[0].std_V[2] == answers[1].std_V[2]
    assert before.valid[2] == after.valid[2]
    # Its model on demand is what it serves.
    alone = fleet.model_of(2).feedforward(at_um[2], 0.0 * at_um[2], 0.0 * at_um[2], memory[2])
    assert alone.u_V[0] == answers[1].u_V[2, 0]
    fleet.freeze([2], False)
    assert fleet.snapshot().feedforward(at_um, 0.0 * at_um, 0.0 * at_um, memory).std_V[2] != answers[1].std_V[2]


def test_what_does_not_fit_is_refused_by_name(models: list[LssvmInverse]) -> None:
    config = FleetConfig(LearnerConfig(window=60))
    fleet = Fleet(models, config)
    with pytest.raises(InputError, match=r"u_V: got shape \(3,\), expected \(4,\)"):
        fleet.step(0, 0.0, [1.0, 2.0, 3.0], 0.0)
    with pytest.raises(ModelFileError, match="axis 1: the state is of another model"):
        fleet.load_axis(1, fleet.learner_of(0).state_dict())
    for window in (61, 2**20):  # the second one's arrays would take 8 TiB
        with pytest.raises(ModelFileError, match="axis 1: the state is of another configuration"):
            fleet.load_axis(1, fleet.learner_of(1).state_dict() | {"config.window": window})
    other = replace(models[1], features=replace(models[1].features, dt_s=2e-3))
    with pytest.raises(InputError, match=r"models\[1\].dt_s: got 0.002, expected 0.001"):
        Fleet([models[0], other], config)
    with pytest.raises(InputError, match="'inverse', which device 'cpu:0' has"):
        FleetConfig(LearnerConfig(window=60), "cpu:0")
