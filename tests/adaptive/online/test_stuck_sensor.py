"""A sensor that repeats itself, is at its end or says nothing: the learner follows by the voltages, and stays as is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive.inverse_model import LssvmInverse
from adaptive.online.gates import AdmissionState, watch_reading
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, Sample
from sim.signals.voltages import training_input
from sim.stage.presets import preset
from sim.stage.stage import Stage

DT, SPAN_V = 1e-3, 8.0
Recording = tuple[FloatArray, FloatArray]


def feed(learner: Learner, u: FloatArray, y: FloatArray, start: int, stop: int) -> list[str]:
    return [learner.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def warm(model: LssvmInverse, all_strokes: Recording) -> dict[int, dict[str, object]]:
    """States of a learner at some instants."""
    learner, states, before = Learner.from_model(model), {}, 0
    for at in (4000, 4123, 4371, 4600):
        feed(learner, *all_strokes, before, at)
        states[at], before = learner.state_dict(), at
    return states


def wrong(kind: str, y: FloatArray, at: int, n: int) -> FloatArray:
    """(N,) readings with ``n`` of them, from ``at`` on, as the sensor would have them."""
    y, part = y.copy(), slice(at, at + n)
    if kind == "frozen":
        y[part] = y[at - 1]
    elif kind == "at its end":
        y[part] = np.minimum(y[part], np.median(y[part]))
    else:
        y[part] = math.nan
    return y


@pytest.mark.parametrize("at", [4000, 4123, 4371, 4600])
@pytest.mark.parametrize("kind", ["frozen", "at its end", "silent"])
@pytest.mark.parametrize("n", [30, 300, 1500])
def test_what_was_learnt_and_where_the_stage_is_stay_known(
    warm: dict[int, dict[str, object]], all_strokes: Recording, kind: str, n: int, at: int
) -> None:
    u, clean = all_strokes
    y = wrong(kind, clean, at, n)
    learner, twin = Learner.from_state(warm[at]), Learner.from_state(warm[at])
    before = learner.counters()
    feed(learner, u, y, at, at + n)
    # A reading that has stood still for longer than 0.1 s has to follow the drive for 0.15 s before it is trusted.
    feed(learner, u, clean, at + n, at + n + 300)
    feed(twin, u, clean, at, at + n + 300)
    after = learner.counters()
    assert [after[name] - before[name] for name in ("jumps", "rollbacks")] == [0, 0]
    assert learner.trouble == ""
    # Reckoning over 1.5 s is off by some tenths of a µm; to forget the turning points would be off by many.
    assert np.max(np.abs(learner.memory()[:20] - twin.memory()[:20])) < 1.5
    points = np.linspace(15.0, 65.0, 40), np.zeros(40), np.zeros(40)
    told, wanted = (each.snapshot().feedforward(*points, twin.memory()).u_V for each in (learner, twin))
    assert np.max(np.abs(told - wanted)) < 5e-3 * SPAN_V


def test_who_has_lost_the_place_still_knows_the_turning_points(
    warm: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """A sensor that comes back with another zero, after strokes that nobody has read."""
    at, n = 4123, 1000
    y = wrong("silent", all_strokes[1], at, n)
    y[at + n :] += 6.0
    learner, twin = Learner.from_state(warm[at]), Learner.from_state(warm[at])
    before = learner.counters()["jumps"]
    feed(learner, all_strokes[0], y, at, at + n + 20)
    feed(twin, *all_strokes, at, at + n + 20)
    assert learner.counters()["jumps"] == before + 1
    wide = np.array(learner.base.features.thresholds_um) > 8.0
    assert np.count_nonzero(wide) > 3
    off = (learner.memory() - twin.memory())[: wide.size][wide]
    assert np.max(np.abs(off)) < 1.5


def test_state_goes_on_to_the_last_bit_while_the_sensor_is_stuck(
    warm: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    at = 4123
    y = wrong("frozen", all_strokes[1], at, 400)
    one = Learner.from_state(warm[at])
    feed(one, all_strokes[0], y, at, at + 200)
    two = Learner.from_state(one.state_dict())
    assert feed(one, all_strokes[0], y, at + 200, at + 900) == feed(two, all_strokes[0], y, at + 200, at + 900)
    np.testing.assert_array_equal(one.memory(), two.memory())
    np.testing.assert_array_equal(one.snapshot().beta, two.snapshot().beta)


def test_a_coarse_sensor_at_rest_is_not_stuck_and_its_jump_is_believed(model: LssvmInverse) -> None:
    """Readings that stay equal under a voltage that stays are what a coarse sensor shows, before and after a jump."""
    stage = Stage(preset("rich", seed=7))
    u = np.concatenate([training_input(DT, 2.0)[1], np.full(1200, 4.0)])
    y = np.round(stage.run(stage.initial_state(), u)[0], 1)
    y[2000:] = np.round(y[2200], 1)
    y[2900:] += 2.0
    learner = Learner.from_model(model)
    feed(learner, u, y, 0, 2930)
    assert learner.counters()["jumps"] == 1


def test_what_a_sensor_repeats_counts_only_while_the_voltage_moves() -> None:
    state = AdmissionState()
    assert not any(watch_reading(state, 4.0 + 1e-3 * k, 40.0, SPAN_V) for k in range(4))
    assert [watch_reading(state, 4.0 + 1e-2 * k, 40.0, SPAN_V) for k in range(4)] == [False, False, True, True]
    assert not watch_reading(state, 4.5, 40.001, SPAN_V)
    assert not any(watch_reading(state, 4.5, 40.001, SPAN_V) for _ in range(1000))


def test_a_jump_that_never_was_is_taken_back_when_the_model_of_the_beginning_is_right(
    warm: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """As where a gap hides the way back from the gates: the frame must not stay wrong for good."""
    at = 4123
    learner = Learner.from_state(warm[at])
    lied = all_strokes[1].copy()
    lied[at : at + 150] += 8.0
    feed(learner, all_strokes[0], lied, at, at + 150)
    assert learner.counters()["jumps"] == 1
    feed(learner, *all_strokes, at + 200, at + 2800)
    assert learner.features == learner.base.features
    assert learner.diagnostics()["valid"]


def test_the_memory_to_serve_with_is_the_one_that_was_learnt_with(
    warm: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """It is the learner's own, carried along the readings since the smoother's instant: also over a jump and a hold."""
    at = 4123
    u, clean = all_strokes
    y = clean.copy()
    y[at + 100 :] += 2.0
    learner = Learner.from_state(warm[at])
    for stop in (at + 50, at + 105, at + 118, at + 300):
        feed(learner, u, y, learner.seq + 1, stop)
        served = learner.snapshot()
        own = learner.memory_for(served)
        assert own is not None
        # The smallest play is at most its threshold away from where the stage is in the frame that is served.
        frame = served.features
        place = (y[stop - 1] - frame.offset_um) / frame.gain
        if not learner.parts.intake.holds:
            assert abs(own[0] - place) <= frame.thresholds_um[0] + 1e-9
        np.testing.assert_allclose(own[5:20], learner.memory()[5:20], atol=3.0)
    # The frozen model, which fallback serves, knows of no jump.
    frozen = learner.memory_for(learner.base)
    assert frozen is not None
    assert np.max(np.abs(frozen - own)) > 1.5
    untouched = Learner.from_model(learner.base)
    assert untouched.memory_for(untouched.snapshot()) is None
