"""Stated intervals hold their stated share on data that the model has not seen: before learning, and while it learns.

One stated deviation is to hold 68 % of the errors and 1.96 of them 95 %. Errors of a model last longer than a sample,
so that some ten thousand samples are a few hundred independent ones, and a share of them scatters by some percent. The
limits are what was measured with three seeds and that scatter, and so they tell where 68 % is not met: see
docs/measurements/scenarios.md, "Stated intervals".
"""

from __future__ import annotations

import os
from collections import deque
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.identification import identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.smoothing import SmootherConfig, smooth_recording
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample
from dehyst.baselines import fit_linear, fit_mpi
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.baselines.competition.competition import Competition
from dehyst.sim.signals.voltages import generalisation_input, multitone, training_input
from dehyst.sim.stage.config import ParameterChange
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.online_models import PlainLearner, SmoothingLearner

DT_S = 1e-3
DATA = Path(os.environ.get("DEHYST_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))
SEEDS = (1, 2)
GAIN_STEP: tuple[ParameterChange, ...] = ((6.0, {"gain_drift.gain": -0.06}),)
#: Factors of the stated deviation within which 68 % and 95 % of the errors are to lie.
ONE, INTERVAL_95 = 1.0, 1.96
#: (least, most) share within the one, and within the other.
Limits = tuple[tuple[float, float], tuple[float, float]]
TEST_SIGNAL: Limits = ((0.55, 0.66), (0.92, 0.975))
OTHER_BAND: Limits = ((0.69, 0.93), (0.94, 0.995))
SERVED_BASELINE: Limits = ((0.62, 0.81), (0.9, 1.0))
LEARNING: Limits = ((0.72, 0.86), (0.93, 0.992))
#: Of the measured stack; its held-out end is so like what was learnt that the interval is nearly twice too wide there.
HELD_OUT_END: Limits = ((0.85, 0.97), (0.97, 1.0))
OTHER_RECORDING: Limits = ((0.65, 0.84), (0.88, 0.97))


def rich(seed: int, u_V: FloatArray, changes: tuple[ParameterChange, ...] = ()) -> FloatArray:
    """Readings of the rich stage, to which ``changes`` happen."""
    stage = Stage(preset("rich", seed=seed, changes=changes))
    return np.asarray(stage.run(stage.initial_state(), u_V)[0])


def points_of(motion: FloatArray, part: slice) -> list[FloatArray]:
    return [np.ascontiguousarray(motion[part, i]) for i in range(3)]


def free_run(model: InverseModel, u_V: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(errors, stated deviations) of a model that is given the measured motion."""
    motion = smooth_recording(y_um, SmootherConfig.for_rate(model.dt_s))
    answer = model.feedforward(*points_of(motion, slice(None)), model.rest_memory(float(y_um[0])))
    return answer.u_V - u_V, answer.std_V


def foretold(online: OnlineModel, u_V: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same, each block of 20 samples foretold by the snapshot of three blocks before and then learnt."""
    first = online.snapshot()
    motion = smooth_recording(y_um, SmootherConfig.for_rate(first.dt_s))
    memory = first.rest_memory(float(y_um[0]))
    past: deque[InverseModel] = deque([first], maxlen=4)
    error_V, std_V = np.empty(u_V.size), np.empty(u_V.size)
    for start in range(0, u_V.size, 20):
        part = slice(start, start + 20)
        answer = past[0].feedforward(*points_of(motion, part), memory)
        memory = answer.memory
        error_V[part], std_V[part] = answer.u_V - u_V[part], answer.std_V
        for k in range(start, min(start + 20, u_V.size)):
            online.handle(Sample(k, k * first.dt_s, float(u_V[k]), float(y_um[k])))
        past.append(online.snapshot())
    return error_V, std_V


def shares(error_V: FloatArray, std_V: FloatArray, second: float = INTERVAL_95) -> tuple[float, float]:
    """Of the errors within one stated deviation, and within ``second`` of them."""
    ratio = np.abs(error_V) / std_V
    return float(np.mean(ratio <= ONE)), float(np.mean(ratio <= second))


def assert_calibrated(error_V: FloatArray, std_V: FloatArray, limits: Limits) -> None:
    for share, (least, most), stated in zip(shares(error_V, std_V), limits, (0.68, 0.95), strict=True):
        assert least <= share <= most, f"share in the interval of {stated:.0%}: {share:.3f}, not {least} to {most}"


@lru_cache(maxsize=8)
def model_of(seed: int) -> LssvmInverse:
    """Identified from the chapter's training signal, tuned."""
    u_V = training_input(DT_S, 10.0)[1]
    return identify_lssvm(u_V, rich(seed, u_V), DT_S)[0]


@pytest.fixture(scope="module")
def identified() -> tuple[int, LssvmInverse]:
    return 1, model_of(1)


@pytest.mark.parametrize("seed", SEEDS)
def test_before_learning_on_the_chapters_test_signal(seed: int) -> None:
    u_V = generalisation_input(DT_S, 10.0)[1]
    assert_calibrated(*free_run(model_of(seed), u_V, rich(seed, u_V)), TEST_SIGNAL)


def excitation(seed: int, duration_s: float) -> FloatArray:
    """Several tones between 0.5 and 20 Hz, from rest."""
    u_V = multitone(duration_s, DT_S, seed=seed)[1]
    u_V[:500] *= np.linspace(0.0, 1.0, 500)
    return np.asarray(u_V)


@pytest.mark.parametrize("seed", SEEDS)
def test_before_learning_on_another_band(seed: int) -> None:
    """Half of it is faster than anything in the training signal: the interval has to widen there, and does."""
    model = model_of(seed)
    u_V = excitation(seed, 30.0)
    error_V, std_V = free_run(model, u_V, rich(seed, u_V))
    assert_calibrated(error_V, std_V, OTHER_BAND)
    assert np.mean(std_V) > 2.0 * np.sqrt(model.noise_variance)


@pytest.mark.parametrize("seed", SEEDS)
def test_while_learning(seed: int) -> None:
    model = model_of(seed)
    u_V = excitation(seed, 12.0)
    error_V, std_V = foretold(Learner.from_model(model), u_V, rich(seed, u_V))
    settled = slice(2000, None)
    assert_calibrated(error_V[settled], std_V[settled], LEARNING)
    # It has learnt, and says so: smaller errors, and smaller stated ones.
    before_V, stated_before_V = free_run(model, u_V, rich(seed, u_V))
    assert np.mean(np.abs(error_V[settled])) < 0.7 * np.mean(np.abs(before_V[settled]))
    assert np.mean(std_V[settled]) < 0.7 * np.mean(stated_before_V[settled])


def test_while_learning_a_stage_that_changes(identified: tuple[int, LssvmInverse]) -> None:
    """Where the model is wrong for a while, it says so: the stated deviation grows with the error."""
    seed, model = identified
    u_V = excitation(seed, 12.0)
    error_V, std_V = foretold(Learner.from_model(model), u_V, rich(seed, u_V, GAIN_STEP))
    quiet, changed = slice(4000, 5900), slice(6100, 6300)
    assert np.mean(std_V[changed]) > 1.5 * np.mean(std_V[quiet])
    assert_calibrated(error_V[8000:], std_V[8000:], LEARNING)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_served_by_default_while_learning_a_stage_that_changes(seed: int) -> None:
    """``auto``: the deviation that the champion of the competition states, before a gain step and after it."""
    model = model_of(seed)
    training_V = training_input(DT_S, 10.0)[1]
    training_um = rich(seed, training_V)
    others: dict[str, InverseModel] = {
        "linear": fit_linear(training_V, training_um, DT_S)[0],
        "mpi": fit_mpi(training_V, training_um, DT_S)[0],
    }
    competition = Competition.from_models("lssvm_adaptive", Learner.from_model(model), model, others)
    u_V = excitation(seed, 12.0)
    error_V, std_V = foretold(competition, u_V, rich(seed, u_V, GAIN_STEP))
    champion = competition.champion_model()
    assert (type(champion), champion.name) == (ChampionInverse, "auto")
    for part in (slice(2000, 6000), slice(8000, None)):
        assert_calibrated(error_V[part], std_V[part], LEARNING)


class ByChampion(PlainLearner):
    """A competition of which the champion is asked."""

    inner: Competition

    def snapshot(self) -> InverseModel:
        return self.inner.champion_model()


class Poor(SmoothingLearner):
    """Serves a model whose voltages are half as large as they should be."""

    def snapshot(self) -> InverseModel:
        model = self.inner.snapshot()
        return replace(model, beta=0.5 * model.beta)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_baseline_that_is_served_states_what_it_is_wrong_by(seed: int) -> None:
    """MPI as champion: not the residuals of its own fit but the errors of its answers, the gain step's too."""
    training_V = training_input(DT_S, 10.0)[1]
    mpi = fit_mpi(training_V, rich(seed, training_V), DT_S)[0]
    model = model_of(seed)
    competition = Competition.from_models("lssvm_adaptive", Poor(Learner.from_model(model)), model, {"mpi": mpi})
    u_V = excitation(seed, 12.0)
    error_V, std_V = foretold(ByChampion(competition), u_V, rich(seed, u_V, GAIN_STEP))
    assert competition.champion == "mpi"
    for part in (slice(2000, 6000), slice(8000, None)):
        assert_calibrated(error_V[part], std_V[part], SERVED_BASELINE)


@pytest.mark.parametrize("learning", [False, True])
def test_outside_the_learnt_range(identified: tuple[int, LssvmInverse], learning: bool) -> None:
    """Strokes that grow to a fifth of the range beyond it: what is stated there grows with what is wrong."""
    seed, model = identified
    u_V = training_input(DT_S, 10.0)[1]
    middle_V, half_V = 0.5 * (u_V.max() + u_V.min()), 0.5 * (u_V.max() - u_V.min())
    t = np.arange(0.0, 20.0, DT_S)
    swing = np.sin(2.0 * np.pi * 1.3 * t) * (0.6 + 0.4 * np.sin(2.0 * np.pi * 0.11 * t))
    grown_V = (middle_V + half_V * np.linspace(0.6, 1.5, t.size) * swing) * np.minimum(1.0, t / 0.5)
    y_um = rich(seed, grown_V)
    error_V, std_V = foretold(Learner.from_model(model), grown_V, y_um) if learning else free_run(model, grown_V, y_um)
    low, high = model.domain[0], model.domain[1]
    outside = np.maximum(low - y_um, y_um - high) / (high - low)
    inside = (outside <= 0.0) & (t > 1.0)
    for least, most in ((0.0, 0.1), (0.1, 0.2)):
        there = (outside > least) & (outside <= most)
        assert np.count_nonzero(there) > 200
        rms_V, stated_V = (float(np.sqrt(np.mean(x[there] ** 2))) for x in (error_V, std_V))
        assert rms_V < 1.65 * stated_V, (least, rms_V, stated_V)
        assert shares(error_V[there], std_V[there], 2.0)[1] >= 0.6
        assert stated_V > 1.05 * float(np.sqrt(np.mean(std_V[inside] ** 2)))


def measured(name: str) -> tuple[FloatArray, FloatArray]:
    path = DATA / "picma_stack" / name
    if not path.exists():
        pytest.skip(f"measured data missing: {path.name}; set DEHYST_DATA to the folder that holds picma_stack")
    columns = np.genfromtxt(path, delimiter=",", names=True)
    # The sensor's column lies one sample late in these files.
    return columns["u_V"][:-1].copy(), columns["y_um"][1:].copy()


def test_measured_stack_on_the_held_out_end_of_its_recording() -> None:
    u_V, y_um = measured("model_sine_1hz.csv")
    split = 6000
    model, _ = identify_lssvm(u_V[:split], y_um[:split], 5e-3)
    error_V, std_V = free_run(model, u_V, y_um)
    assert_calibrated(error_V[split:], std_V[split:], HELD_OUT_END)


@lru_cache(maxsize=1)
def measured_model() -> LssvmInverse:
    return identify_lssvm(*measured("model_sine_1hz.csv"), 5e-3)[0]


def test_measured_stack_while_learning_another_recording() -> None:
    model = measured_model()
    u_V, y_um = measured("test_ramped_sine_ff.csv")
    error_V, std_V = foretold(Learner.from_model(model), u_V, y_um)
    assert_calibrated(error_V[2000:], std_V[2000:], OTHER_RECORDING)


def test_good_readings_of_a_slow_recording_are_no_glitches() -> None:
    """At 200 Hz the smoother's predictions are off by what is a glitch at 1 kHz."""
    u_V, y_um = measured("model_sine_1hz.csv")
    learner = Learner.from_model(measured_model())
    for k in range(u_V.size):
        learner.handle(Sample(k, k * 5e-3, float(u_V[k]), float(y_um[k])))
    counters = learner.counters()
    assert (counters["glitch"], counters["jumps"], counters["restarts"]) == (0, 0, 1)
    assert counters["learnt"] > 0.45 * u_V.size
