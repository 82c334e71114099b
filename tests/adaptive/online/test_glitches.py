"""Readings that surprise: long glitches are bridged, real jumps believed, and a jump that was none is undone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.gates import GLITCH, AdmissionConfig
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, Sample

DT, AT = 1e-3, 2500
Recording = tuple[np.ndarray, np.ndarray]
PERSISTENCE = AdmissionConfig().glitch_persistence


def feed(learner: Learner, u: FloatArray, y: FloatArray, start: int, stop: int) -> list[str]:
    return [learner.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def warm(model: LssvmInverse, recording: Recording) -> dict[str, object]:
    """State of a learner that has seen everything up to the first wrong reading."""
    learner = Learner.from_model(model)
    feed(learner, *recording, 0, AT)
    return learner.state_dict()


@pytest.mark.parametrize("count", [1, 2, 5, PERSISTENCE])
@pytest.mark.parametrize("size_um", [0.5, -2.0, 6.0, -40.0])
def test_a_run_of_wrong_readings_is_bridged(
    warm: dict[str, object], recording: Recording, count: int, size_um: float
) -> None:
    """Frame and estimate stay, and what was bridged is where the stage really was."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + count] += size_um
    learner, twin = Learner.from_state(warm), Learner.from_state(warm)
    outcomes = feed(learner, u, y, AT, AT + 80)
    feed(twin, u, clean, AT, AT + 80)
    assert outcomes[:count] == [GLITCH] * count
    assert learner.counters()["jumps"] == 0
    assert learner.features == twin.features
    motion = np.linspace(10.0, 70.0, 50)
    still = np.zeros(50)
    answers = [each.snapshot().feedforward(motion, still, still, twin.memory()).u_V for each in (learner, twin)]
    assert np.max(np.abs(answers[0] - answers[1])) < 5e-4 * learner.base.span_V
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.05)


def test_readings_that_are_none_are_bridged_by_their_voltages(warm: dict[str, object], recording: Recording) -> None:
    """More of them in a row than a gap may be long: no new start, as the voltages are known."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + 12] = math.nan
    y[AT + 5] = 1e6
    learner, twin = Learner.from_state(warm), Learner.from_state(warm)
    restarts = learner.counters()["restarts"]
    outcomes = feed(learner, u, y, AT, AT + 60)
    feed(twin, u, clean, AT, AT + 60)
    assert outcomes[:12] == ["not_finite"] * 5 + ["out_of_range"] + ["not_finite"] * 6
    assert learner.counters()["restarts"] == restarts
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.05)


@pytest.mark.parametrize("kind", ["gain", "offset", "small offset"])
def test_a_real_jump_is_believed_within_20_ms(warm: dict[str, object], recording: Recording, kind: str) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT:] = 0.94 * clean[AT:] if kind == "gain" else clean[AT:] + (0.4 if kind == "small offset" else 2.0)
    learner = Learner.from_state(warm)
    feed(learner, u, y, AT, AT + 20)
    assert learner.counters()["jumps"] == 1
    frame = learner.features
    now = clean[AT + 19]
    assert frame.offset_um + frame.gain * now == pytest.approx(y[AT + 19], abs=0.1)


def test_a_glitch_longer_than_patience_is_taken_and_undone(warm: dict[str, object], recording: Recording) -> None:
    u, clean = recording
    y = clean.copy()
    count = PERSISTENCE + 15
    y[AT : AT + count] += 3.0
    learner, twin = Learner.from_state(warm), Learner.from_state(warm)
    before = learner.features
    feed(learner, u, y, AT, AT + count)
    assert learner.features != before
    feed(learner, u, y, AT + count, AT + count + 60)
    feed(twin, u, clean, AT, AT + count + 60)
    assert learner.counters()["jumps_undone"] == 1
    assert learner.features == before
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.1)


def test_a_jump_back_within_half_a_second_undoes_frame_and_estimate(
    warm: dict[str, object], recording: Recording
) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT : AT + 300] += 3.0
    learner = Learner.from_state(warm)
    before, beta = learner.features, learner.parts.filter.beta
    feed(learner, u, y, AT, AT + 300)
    assert learner.counters()["jumps"] == 1
    assert learner.parts.window.counters()["steps"] == Learner.from_state(warm).parts.window.counters()["steps"]
    feed(learner, u, y, AT + 300, AT + 322)
    assert learner.features == before
    assert learner.counters()["jumps_undone"] == 1
    assert np.max(np.abs(learner.parts.filter.beta - beta)) < 0.02 * np.max(np.abs(beta))


def test_after_a_glitch_the_sensor_is_trusted_less(warm: dict[str, object], recording: Recording) -> None:
    """Where it has just been wrong, more readings are waited for before a jump is believed."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + 3] += 5.0
    y[AT + 100 :] += 2.0
    learner = Learner.from_state(warm)
    patience = AdmissionConfig().doubt_persistence
    feed(learner, u, y, AT, AT + 100 + patience)
    assert learner.counters()["jumps"] == 0
    feed(learner, u, y, AT + 100 + patience, AT + 101 + patience)
    assert learner.counters()["jumps"] == 1


def test_nothing_is_served_or_taught_while_undecided(warm: dict[str, object], recording: Recording) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT:] *= 0.94
    learner = Learner.from_state(warm)
    served, updates = learner.snapshot(), learner.parts.filter.state.updates
    feed(learner, u, y, AT, AT + PERSISTENCE)
    assert learner.snapshot() is served
    assert learner.parts.filter.state.updates == updates


@pytest.mark.parametrize("at", [3, PERSISTENCE + 4, PERSISTENCE + 40])
def test_state_goes_on_to_the_last_bit_while_held_and_on_probation(
    warm: dict[str, object], recording: Recording, at: int
) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT + 1] = math.nan
    y[AT : AT + PERSISTENCE + 50] += 3.0
    one = Learner.from_state(warm)
    feed(one, u, y, AT, AT + at)
    two = Learner.from_state(one.state_dict())
    stop = AT + 300
    assert feed(one, u, y, AT + at, stop) == feed(two, u, y, AT + at, stop)
    assert one.counters() == two.counters()
    np.testing.assert_array_equal(one.memory(), two.memory())
    np.testing.assert_array_equal(one.snapshot().beta, two.snapshot().beta)
    assert one.features == two.features


def test_patience_is_configurable(model: LssvmInverse, recording: Recording) -> None:
    u, y = recording[0], recording[1].copy()
    y[AT:] += 2.0
    learner = Learner.from_model(model, LearnerConfig(admission=AdmissionConfig(glitch_persistence=30)))
    feed(learner, u, y, 0, AT + 30)
    assert learner.counters()["jumps"] == 0
    feed(learner, u, y, AT + 30, AT + 31)
    assert learner.counters()["jumps"] == 1
