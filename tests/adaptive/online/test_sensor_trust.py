"""Trust in the sensor: the check that always runs, the trial, and sensors that stick."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.gates import AdmissionConfig, EnvelopeConfig
from dehyst.adaptive.online.glitch_or_jump import Circumstances
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.sensor_trust import (
    CREEP_PER_S,
    FOLLOWING_SLOPES,
    LOOKS,
    OF_VOLTAGE,
    SENSOR_FAULTS,
    SENSOR_FOREIGN,
    SENSOR_GAIN,
    SENSOR_SIGN,
    SENSOR_STUCK,
    STEP_S,
    STEP_SIGMA,
    STILL_STEPS,
    VALUES,
    Decision,
    Following,
    Outcome,
    Trial,
    bends_otherwise,
    slope_of,
)
from dehyst.adaptive.online.track import Reckoning
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import FloatArray, Sample, StateDict
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- Does the sensor follow the drive? The steps of the voltage against those that the model asks for at the readings.

SPAN_V = 10.0
#: Between two pairs, s.
EVERY_S = 4e-3


def asked(
    following: Following, u: FloatArray, p: FloatArray, every_s: float = EVERY_S, span_V: float = SPAN_V
) -> list[bool]:
    """What it says of (n,) voltages that were applied and those that the model asks for."""
    return [following.take(float(a), float(b), span_V, every_s) for a, b in zip(u, p.astype(np.float64), strict=True)]


def strokes(seconds: float, hertz: float = 1.0, share: float = 0.3) -> FloatArray:
    """(n,) V: a sine about the middle with an amplitude of a share of the span."""
    t_s = np.arange(round(seconds / EVERY_S)) * EVERY_S
    return SPAN_V * (0.5 + share * np.sin(2.0 * math.pi * hertz * t_s))


def first(said: list[bool]) -> int:
    return said.index(True) if True in said else -1


@pytest.mark.parametrize("slope", [1.05 * FOLLOWING_SLOPES[0], 0.9, 1.0, 1.35, 0.95 * FOLLOWING_SLOPES[1]])
@pytest.mark.parametrize("offset_V", [0.0, -6.0])
def test_a_sensor_that_follows_is_no_fault(slope: float, offset_V: float) -> None:
    """Whatever its offset, and with a gain that a stage and a model of another amplitude may have."""
    for hertz in (0.2, 1.0, 5.0):
        u = strokes(10.0, hertz)
        following = Following()
        assert not any(asked(following, u, slope * u + offset_V))
        assert following.good > 20


def test_hysteresis_and_turning_points_are_no_fault() -> None:
    """A model that knows no hysteresis at all: a loop as wide as a fifth of the stroke."""
    u = strokes(20.0, 1.0)
    p = u + 0.1 * np.ptp(u) * np.sign(np.gradient(u))
    assert not any(asked(Following(), u, p))


@pytest.mark.parametrize("slope", [-1.0, -0.3, 0.02, 0.3, 0.8 * FOLLOWING_SLOPES[0], 1.3 * FOLLOWING_SLOPES[1], 5.0])
def test_another_slope_or_sign_is_a_fault_within_a_tenth_of_the_span(slope: float) -> None:
    u = np.linspace(2.0, 8.0, 600)
    assert not FOLLOWING_SLOPES[0] <= slope <= FOLLOWING_SLOPES[1]
    following = Following()
    said = asked(following, u, slope * u)
    assert first(said) > 0
    assert abs(u[first(said)] - u[0]) < 0.1 * SPAN_V
    assert following.good == 0


def test_a_sensor_that_stops_is_found_after_some_steps_however_long_it_had_followed() -> None:
    u = strokes(20.0, 1.0)
    at = round(10.1 / EVERY_S)
    p = u.copy()
    p[at:] = p[at]
    following = Following()
    said = asked(following, u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(0.1 / EVERY_S)
    # Not after fewer than these: the model may be wrong about one stroke.
    following = Following()
    asked(following, u[:at], p[:at])
    still = 0
    for a, b in zip(u[at:], p[at:], strict=True):
        fault = following.take(float(a), float(b), SPAN_V, EVERY_S)
        still = max(still, following.still)
        if fault:
            break
    assert still == STILL_STEPS


def test_readings_that_have_nothing_to_do_with_the_voltage_are_a_fault() -> None:
    t_s = np.arange(1000) * EVERY_S
    u = SPAN_V * (0.5 + 0.3 * np.sin(2.0 * math.pi * 1.0 * t_s))
    p = SPAN_V * (0.5 + 0.3 * np.sin(2.0 * math.pi * 1.7 * t_s + 1.0))
    assert first(asked(Following(), u, p)) > 0


def test_readings_that_go_too_far_and_not_at_all_in_turns_are_a_fault() -> None:
    """On average they go as far as the voltage asks for; but that is no straight line."""
    u = 2.0 + 0.1 * np.arange(40)
    p = 2.0 + np.cumsum(np.tile([0.25, 0.25, 0.25, 0.25, -0.03], 8))
    following = Following()
    straight = []
    for a, b in zip(u, p, strict=True):
        fault = following.take(float(a), float(b), SPAN_V, STEP_S)
        if following.uu > 0.0 and FOLLOWING_SLOPES[0] < following.up / following.uu < FOLLOWING_SLOPES[1]:
            straight.append(fault)
    assert any(straight)


@pytest.mark.parametrize("seconds", [1.0, 60.0])
def test_a_gain_that_breaks_down_is_found_as_soon_after_a_minute_as_after_a_second(seconds: float) -> None:
    u = strokes(seconds + 1.0, 1.0)
    at = round(seconds / EVERY_S)
    p = np.where(np.arange(u.size) < at, u, u[at] + 0.35 * (u - u[at]))
    said = asked(Following(), u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(0.35 / EVERY_S)


def test_what_moves_while_the_voltage_rests_is_a_matter_of_surprise_and_not_of_following() -> None:
    """Somebody moves the table: readings go, the voltage does not. Nothing is said of the sensor."""
    u = np.full(1000, 5.0)
    p = 5.0 + 2.0 * np.sin(np.arange(1000) * 0.05)
    following = Following()
    assert not any(asked(following, u, p))
    assert following.uu < OF_VOLTAGE * following.count


@pytest.mark.parametrize("noise_share", [1e-4, 1e-3, 5e-3])
def test_noise_makes_the_steps_longer_and_no_fault(noise_share: float) -> None:
    """Of the model's answer, up to 0.5 % of the span; the steps that are compared become so many times as large."""
    u = strokes(60.0, 0.7)
    noise_V = noise_share * SPAN_V
    following = Following()
    rng = np.random.default_rng(1)
    steps: list[float] = []
    for a in u:
        before = following.u_V
        assert not following.take(float(a), float(a + noise_V * rng.standard_normal()), SPAN_V, EVERY_S)
        if following.u_V != before and not math.isnan(before):
            steps.append(abs(following.u_V - before))
    # The change from one pair to the next has twice the variance of the noise.
    assert math.sqrt(following.noise2) == pytest.approx(math.sqrt(2.0) * noise_V, rel=0.25)
    settled = steps[len(steps) // 2 :]
    assert np.median(settled) > 0.8 * STEP_SIGMA * noise_V
    assert following.count > 2.0


@pytest.mark.parametrize(("noise_share", "within_s"), [(1e-4, 0.1), (1e-3, 0.2), (5e-3, 1.0)])
def test_noise_does_not_hide_a_sensor_that_stands_still(noise_share: float, within_s: float) -> None:
    u = strokes(20.0, 0.7)
    rng = np.random.default_rng(2)
    noise = noise_share * SPAN_V * rng.standard_normal(u.size)
    at = u.size // 2
    p = u + noise
    p[at:] = p[at] + noise[at:]
    said = asked(Following(), u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(within_s / EVERY_S)


def test_a_single_wild_answer_does_not_make_it_deaf() -> None:
    """The noise is an average in which one pair counts for little: the steps stay short."""
    following = Following()
    u = strokes(4.0)
    p = u.copy()
    p[200] += 5.0 * SPAN_V
    asked(following, u[:240], p[:240])
    assert STEP_SIGMA * math.sqrt(following.noise2) < 0.05 * SPAN_V


@pytest.mark.parametrize("per_s", [0.2, 0.9])
def test_a_voltage_that_holds_a_creeping_stage_in_place_is_no_fault(per_s: float) -> None:
    """Readings stand still while the voltage goes on, slower than a stage is moved: for a minute, however far."""
    u = 3.0 + per_s * CREEP_PER_S * SPAN_V * np.arange(round(15.0 / EVERY_S)) * EVERY_S
    following = Following()
    assert not any(asked(following, u, np.full(u.size, 3.0)))
    assert following.count == 0.0
    # Faster than that it is one.
    u = 3.0 + 3.0 * CREEP_PER_S * SPAN_V * np.arange(round(3.0 / EVERY_S)) * EVERY_S
    assert any(asked(Following(), u, np.full(u.size, 3.0)))


def test_steps_are_no_shorter_than_ringing_lasts() -> None:
    """A voltage that swings with a mode of the stage, both within less time than a step takes: hardly compared."""
    every_s = 1e-3
    k = np.arange(2000)
    u = 5.0 + 0.5 * np.sin(2.0 * math.pi * 300.0 * k * every_s)
    following = Following()
    ends = 0
    for a in u:
        before = following.u_V
        following.take(float(a), 10.0 - float(a), SPAN_V, every_s)
        ends += following.u_V != before
    assert ends <= 2000 * every_s / STEP_S + 1


@pytest.mark.parametrize("hertz", [110.0, 125.0, 150.0, 280.0])
def test_ringing_while_the_voltage_turns_is_no_fault(hertz: float) -> None:
    """The gain has jumped, and a mode rings by more than the voltage moves: nothing to compare until it has died."""
    t_s = np.arange(100) * EVERY_S
    u = 6.3 - 0.8 * (1.0 - np.cos(2.0 * math.pi * 1.5 * t_s))
    p = 1.08 * u + 0.35 * np.exp(-t_s / 0.075) * np.cos(2.0 * math.pi * hertz * t_s)
    following = Following()
    assert not any(asked(following, u, p))
    assert following.count > 2.0


def test_a_slope_far_from_possible_is_found_sooner_where_no_drift_explains_it() -> None:
    u = np.linspace(2.0, 8.0, 600)
    fast, slow = Following(), Following()
    steps = []
    for following, drift_V_per_s in ((fast, 0.5), (slow, 100.0)):
        said = [following.take(a, 0.4 * a, SPAN_V, EVERY_S, drift_V_per_s) for a in u.tolist()]
        steps.append((u[first(said)] - u[0]) / (0.004 * SPAN_V))
    assert 4.0 < steps[0] < 8.0
    assert 9.0 < steps[1] < 15.0


def test_a_span_of_any_size_is_asked_alike() -> None:
    u = np.linspace(0.2, 0.8, 600)
    said = [first(asked(Following(), span * u, 0.2 * span * u, span_V=span)) for span in (1e-3, 1.0, 10.0, 1000.0)]
    assert len(set(said)) == 1
    assert said[0] > 0


def test_what_is_no_number_is_no_answer_and_begins_anew() -> None:
    following = Following()
    u = strokes(4.0)
    p = u.copy()
    p[300:310] = math.nan
    assert not any(asked(following, u, p))
    assert following.count > 2.0
    assert math.isfinite(following.noise2)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_stage_whose_zero_drifts_beside_a_slow_voltage_is_no_fault(sign: float) -> None:
    """For 0.2 s the stage moves by half its range per second, several times as fast as the voltage moves it."""
    n, seconds = round(0.2 / EVERY_S), EVERY_S * np.arange(750)
    speed_V_per_s = np.full(seconds.size, 0.3 * SPAN_V)
    speed_V_per_s[250 : 250 + n] = -sign * 0.12 * SPAN_V
    drift_V_per_s = np.where((seconds >= 1.0) & (seconds < 1.2), sign * 0.5 * SPAN_V, 0.0)
    u = np.cumsum(speed_V_per_s) * EVERY_S
    p = u + np.cumsum(drift_V_per_s) * EVERY_S

    def faults(fastest_V_per_s: float) -> list[bool]:
        following = Following()
        return [following.take(a, b, SPAN_V, EVERY_S, fastest_V_per_s) for a, b in zip(u, p, strict=True)]

    assert not any(faults(0.8 * SPAN_V))
    # Faster than the envelope allows, it is a fault; not after the drift is over.
    assert 250 < first(faults(0.4 * SPAN_V)) <= 250 + n


@pytest.mark.parametrize(("slope", "bent"), [(1.0, False), (1.08, False), (2.0, True), (-1.0, True)])
def test_two_motions_of_the_same_speed_are_told_apart_by_their_bends(slope: float, bent: bool) -> None:
    """A straight way of 3 µm with a bend of 0.1 µm; the readings go the same way, and bend ``slope`` times as much."""
    t = np.linspace(0.0, 1.0, 40)
    bend_um = 0.1 * np.sin(2.0 * np.pi * t)
    noise_um = 0.01 * np.random.default_rng(3).standard_normal(t.size)
    assert bends_otherwise(3.0 * t + bend_um, 3.0 * t + slope * bend_um + 5.0 + noise_um, 0.01) is bent
    # Without a bend nothing is told.
    assert not bends_otherwise(3.0 * t, 3.0 * t + slope * bend_um, 0.01)


def test_to_forget_is_to_begin_anew_but_for_the_noise() -> None:
    following, fresh = Following(), Following()
    u = strokes(3.0)
    asked(following, u, u + 0.02 * np.random.default_rng(3).standard_normal(u.size))
    noise2 = following.noise2
    following.forget()
    assert following.noise2 == noise2
    for name in save(fresh):
        if name != "noise2":
            now, then = (getattr(each, name) for each in (following, fresh))
            assert now == then or (math.isnan(now) and math.isnan(then))
    # A stage in another frame: nothing of the step is across the two.
    assert not any(asked(following, u, u + 7.0))


def test_state_of_the_check_goes_on_to_the_last_bit() -> None:
    u = strokes(10.0)
    p = np.where(np.arange(u.size) < 1800, u, u[1800]) + 0.01 * np.random.default_rng(4).standard_normal(u.size)
    one = Following()
    cut = 1812
    asked(one, u[:cut], p[:cut])
    assert 0 < one.still < STILL_STEPS
    two = load(Following, save(one))
    assert two == one
    said = asked(one, u[cut:], p[cut:])
    assert True in said
    assert asked(two, u[cut:], p[cut:]) == said
    assert one == two
    with pytest.raises(ModelFileError, match="p_V: got nothing"):
        load(Following, {"u_V": 1.0})


# --- A sensor that is wrong has a name within half a second, teaches nothing, and earns its trust back; a good one has
# it.
#
# The readings are those of the simulated stage under a voltage of its own, made wrong from outside.

DT_S = 1e-3
Recording = tuple[FloatArray, FloatArray]
#: When a sensor goes wrong, and for how many samples.
ATS, WRONG = (2500, 3133, 3766), 600
#: Samples of motion within which it has its name, and within which good readings are learnt from again.
NAMED, BACK = 500, 1000
#: Samples from one look at what was learnt to the next; steps of the window are counted, so that none is missed.
EVERY = 20
FAULTS = {
    "stuck_1e-9": {SENSOR_STUCK},
    "stuck_1e-5": {SENSOR_STUCK},
    "stuck_3e-4": {SENSOR_STUCK},
    "gain_0.01": {SENSOR_GAIN},
    "gain_0.3": {SENSOR_GAIN},
    "gain_2.0": {SENSOR_GAIN},
    "gain_3.0": {SENSOR_GAIN},
    "sign_rest": {SENSOR_SIGN},
    "sign_middle": {SENSOR_SIGN},
    # By chance another stage goes the other way, or further, for a while.
    "foreign": {SENSOR_FOREIGN, SENSOR_SIGN, SENSOR_GAIN, SENSOR_STUCK},
}


def simulated(seed: int, u_V: FloatArray) -> Recording:
    stage = Stage(preset("rich", seed=seed))
    return u_V, stage.run(stage.initial_state(), u_V)[0]


@pytest.fixture(scope="module")
def motions() -> dict[str, Recording]:
    """(u_V, y_um) of 7 s each: strokes of all sizes up to 7.7 Hz, a sine, and a triangle with its turning points."""
    t_s = np.arange(7000) * DT_S
    begin = np.minimum(t_s / 0.5, 1.0)
    tones = ((1.6, 0.7), (1.0, 1.9), (0.6, 4.3), (0.3, 7.7))
    return {
        "tones": simulated(6, begin * (4.0 + sum(v * np.sin(2 * np.pi * hz * t_s + hz) for v, hz in tones))),
        "sine": simulated(5, begin * (4.0 - 3.0 * np.cos(2 * np.pi * t_s))),
        "triangle": simulated(9, begin * (1.0 + 6.0 * np.abs((0.7 * t_s) % 1.0 * 2.0 - 1.0))),
    }


@pytest.fixture(scope="module")
def warm(model: LssvmInverse, motions: dict[str, Recording]) -> dict[tuple[str, int], StateDict]:
    """States of a learner by motion and instant."""
    states = {}
    for name, recording in motions.items():
        learner, before = Learner.from_model(model), 0
        for at in ATS:
            feed(learner, recording, before, at)
            assert learner.trouble == ""
            states[name, at], before = learner.state_dict(), at
    return states


def feed(learner: Learner, recording: Recording, start: int, stop: int) -> list[str]:
    u, y = recording
    return [learner.handle(Sample(k, k * DT_S, float(u[k]), float(y[k]))) for k in range(start, stop)]


def range_of(model: LssvmInverse) -> float:
    return model.features.y_max_um - model.features.y_min_um


def wrong(fault: str, clean: FloatArray, at: int, range_um: float, n: int = WRONG) -> FloatArray:
    """(N,) readings with ``n`` of them, from ``at`` on, as a sensor with that fault shows them."""
    y, part, rng = clean.copy(), slice(at, at + n), np.random.default_rng([at, len(fault)])
    kind, _, size = fault.partition("_")
    if kind == "stuck":
        y[part] = clean[at - 1] + float(size) * range_um * rng.standard_normal(n)
    elif kind == "gain":
        y[part] *= float(size)
    elif kind == "sign":
        y[part] = (range_um if size == "middle" else 0.0) - y[part]
    else:
        t_s = np.arange(n) * DT_S
        tones_Hz, phase = np.exp(rng.uniform(math.log(0.5), math.log(5.0), 4)), rng.uniform(0.0, 6.3, 4)
        wave = np.sin(2.0 * math.pi * np.multiply.outer(t_s, tones_Hz) + phase).mean(axis=1)
        y[part] = range_um * (0.5 + 0.6 * wave + 1e-4 * rng.standard_normal(n))
    return y


def shown(learner: Learner, place_um: float) -> float:
    """What the sensor shows at a place that it showed as ``place_um`` when the model was identified, µm."""
    return learner.features.offset_um + learner.features.gain * place_um


def learnt(learner: Learner) -> tuple[bytes, ...]:
    """All that the readings may teach: the filter's estimate, the window, and the frame."""
    window = learner.parts.window
    return (
        learner.parts.filter.beta.tobytes(), *(array.tobytes() for array in learner.window_samples()),
        str(window.counters()["steps"]).encode(), repr(learner.features).encode(),
    )  # fmt: skip


# ---- what is wrong has a name


@pytest.mark.parametrize("motion", ["tones", "sine", "triangle"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_has_its_name_teaches_nothing_and_good_readings_lead_back(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], motion: str, fault: str
) -> None:
    u, clean = motions[motion]
    for at in ATS:
        y = wrong(fault, clean, at, range_of(model))
        learner = Learner.from_state(warm[motion, at])
        before, frame = learner.counters(), learner.features
        named = -1
        kept: tuple[bytes, ...] = ()
        for k in range(at, at + WRONG):
            feed(learner, (u, y), k, k + 1)
            if learner.trouble:
                named = k - at if named < 0 else named
                assert learner.trouble in FAULTS[fault]
            # From the moment on at which the readings are distrusted; that is looked at now and then.
            if learner.parts.intake.trials > before["trials"] and (not kept or k % EVERY == 0):
                kept = kept or learnt(learner)
                assert learnt(learner) == kept
        assert learnt(learner) == kept
        assert 0 <= named < NAMED
        assert learner.trouble
        assert learner.counters()["trials"] == before["trials"] + 1
        assert learner.features == frame
        assert not learner.snapshot().valid
        said = feed(learner, (u, clean), at + WRONG, at + WRONG + BACK)
        assert learner.trouble == ""
        assert "learnt" in said
        assert said[-100:].count("learnt") >= 45
        assert learner.counters()["jumps"] == before["jumps"]
        assert learner.snapshot().valid
        assert learner.diagnostics()["recent_rms_error_pct"] < 0.6


@pytest.mark.parametrize("fault", ["stuck_1e-5", "gain_0.3", "sign_rest", "foreign"])
def test_what_is_served_meanwhile_is_the_model_from_before(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], fault: str
) -> None:
    """Of the filter nothing is kept that was learnt just before the fault was found: its first readings are in it."""
    at = ATS[1]
    u, clean = motions["tones"]
    learner = Learner.from_state(warm["tones", at])
    place = np.linspace(10.0, 70.0, 50)
    still, memory = np.zeros(50), learner.memory()
    before_V = learner.snapshot().feedforward(place, still, still, memory).u_V
    feed(learner, (u, wrong(fault, clean, at, range_of(model))), at, at + WRONG)
    after_V = learner.snapshot().feedforward(place, still, still, memory).u_V
    assert np.abs(after_V - before_V).max() < 4e-3 * model.span_V
    # And where the stage is, is known by the voltage.
    reckoned = learner.memory_for(learner.snapshot())
    assert reckoned is not None
    assert abs(reckoned[0] - clean[at + WRONG - 1]) < 0.03 * range_of(model)


@pytest.mark.parametrize(("motion", "at"), [("sine", 2500), ("triangle", 3133), ("tones", 2500)])
def test_what_was_learnt_since_readings_certainly_followed_is_forgotten(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], motion: str, at: int
) -> None:
    """A sensor that stops gently, within 0.3 s: its first readings have taught something. The filter goes back."""
    u, clean = motions[motion]
    fading = np.clip((np.arange(clean.size) - at) * DT_S / 0.3, 0.0, 1.0)
    y = clean[at] + (1.0 - fading) * (clean - clean[at])
    learner = Learner.from_state(warm[motion, at])
    trials = learner.counters()["trials"]
    for k in range(at, at + 900):
        good, last = learner.parts.mark.beta.copy(), learner.parts.filter.beta
        feed(learner, (u, y), k, k + 1)
        if learner.counters()["trials"] > trials:
            break
    np.testing.assert_array_equal(learner.parts.filter.beta, good)
    assert not np.array_equal(last, good)
    assert learner.counters()["distrusts"] == 1


def test_a_fault_that_lasts_keeps_its_name(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    u, clean = motions["sine"]
    at = ATS[0]
    learner = Learner.from_state(warm["sine", at])
    y = wrong("gain_0.3", clean, at, range_of(model), 4000)
    feed(learner, (u, y), at, at + NAMED)
    names = set()
    for k in range(at + NAMED, at + 4000):
        feed(learner, (u, y), k, k + 1)
        names.add(learner.trouble)
    assert names == {SENSOR_GAIN}


def test_one_fault_after_another_leads_back_too(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    u, y = motions["tones"][0], motions["tones"][1]
    at, mixed = ATS[0], motions["tones"][1]
    for i, fault in enumerate(("sign_rest", "stuck_1e-5", "gain_3.0", "foreign")):
        mixed = np.where(np.arange(y.size) >= at + 300 * i, wrong(fault, y, at + 300 * i, range_of(model), 300), mixed)
    mixed[at + 1200 :] = y[at + 1200 :]
    learner = Learner.from_state(warm["tones", at])
    feed(learner, (u, mixed), at, at + 1200)
    assert learner.trouble in SENSOR_FAULTS
    said = feed(learner, (u, mixed), at + 1200, at + 1200 + BACK)
    assert learner.trouble == ""
    assert "learnt" in said[-50:]
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.6


# ---- what is sound is never called wrong


def assert_never_in_trouble(learner: Learner, recording: Recording, start: int = 0) -> None:
    u, y = recording
    for k in range(start, u.size):
        learner.handle(Sample(k, k * DT_S, float(u[k]), float(y[k])))
        assert learner.trouble == "", f"at {k * DT_S:g} s"


@pytest.mark.parametrize("motion", ["tones", "sine", "triangle"])
@pytest.mark.parametrize("noise_share", [0.0, 5e-4])
def test_turning_points_and_noise_are_no_trouble(
    model: LssvmInverse, motions: dict[str, Recording], motion: str, noise_share: float
) -> None:
    """Noise of 0.05 % of the range; the readings of the same stage without it are from -2 to 90 µm."""
    u, y = motions[motion]
    learner = Learner.from_model(model)
    assert_never_in_trouble(
        learner, (u, y + noise_share * range_of(model) * np.random.default_rng(1).standard_normal(y.size))
    )
    assert learner.counters()["trials"] == 0
    assert learner.counters()["learnt"] > 2500


@pytest.mark.parametrize("gain", [-0.12, -0.06, 0.06, 0.12])
@pytest.mark.parametrize("motion", ["tones", "sine", "triangle"])
def test_a_step_of_the_gain_is_no_trouble(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], motion: str, gain: float
) -> None:
    u, clean = motions[motion]
    for at in ATS[1:]:
        y = clean.copy()
        y[at:] *= 1.0 + gain
        learner = Learner.from_state(warm[motion, at])
        assert_never_in_trouble(learner, (u[: at + 1200], y), at)
        assert "learnt" in feed(learner, (u, y), at + 1200, at + 1250)
        assert learner.diagnostics()["recent_rms_error_pct"] < 1.0


@pytest.mark.parametrize("place", [0.3, 0.8])
def test_twenty_seconds_in_one_place_are_no_trouble_nor_is_what_comes_after(model: LssvmInverse, place: float) -> None:
    """A closed loop holds the stage: it creeps, so the voltage goes on slowly, and readings stand still."""
    stage = Stage(preset("rich", seed=12))
    state = stage.initial_state()
    rng, noise_um = np.random.default_rng(3), 1e-4 * range_of(model)
    learner = Learner.from_model(model)
    per_um = 0.02 * model.span_V / range_of(model)
    u_V, read_um, held_V = 0.0, 0.0, []
    for k in range(26_000):
        if k < 2500:
            u_V = min(k / 500.0, 1.0) * (4.0 + 2.0 * math.sin(2.0 * math.pi * 0.9 * k * DT_S))
        elif k < 23_000:
            u_V = min(u_V + per_um * max(-1.0, min(1.0, place * range_of(model) - read_um)), 8.0)
        else:
            u_V += 0.012 * math.sin(2.0 * math.pi * 1.1 * (k - 23_000) * DT_S)
        read_um = float(stage.run(state, np.array([u_V]))[0][0]) + noise_um * rng.standard_normal()
        learner.handle(Sample(k, k * DT_S, u_V, read_um))
        assert learner.trouble == "", f"at {k * DT_S:g} s"
        if k in (4000, 22_999):
            held_V.append(u_V)
    # The voltage has gone on, and learning too.
    assert abs(held_V[1] - held_V[0]) > 0.002 * model.span_V
    assert learner.counters()["trials"] == 0
    assert learner.diagnostics()["recent_rms_error_pct"] < 1.0


@pytest.mark.parametrize("share", [0.01, 0.04])
def test_a_stage_that_creeps_much_under_a_loop_that_holds_it_is_no_trouble(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], share: float
) -> None:
    """For 20 s the readings stand still but for noise; the voltage goes away by up to 4 % of the span, ever slower."""
    at = ATS[2]
    u, y = motions["sine"]
    passed_s = np.arange(20_000) * DT_S
    creep_V = share * model.span_V * np.log1p(passed_s) / math.log(21.0)
    stays = y[at - 1] + 1e-4 * range_of(model) * np.random.default_rng(5).standard_normal(passed_s.size)
    held = np.concatenate([u[:at], u[at - 1] + creep_V]), np.concatenate([y[:at], stays])
    learner = Learner.from_state(warm["sine", at])
    assert_never_in_trouble(learner, held, at)


# ---- the trial itself


def circumstances(model: LssvmInverse) -> Circumstances:
    range_um = range_of(model)
    config = AdmissionConfig().at(DT_S)
    usual_um = config.surprise_share * range_um
    f = model.features
    return Circumstances(
        config=config, envelope=EnvelopeConfig(), dt_s=DT_S, range_um=range_um,
        noise_um=usual_um / config.surprise_sigma, usual_um=usual_um, rest_um=f.y_rest_um,
        low_um=f.y_min_um, high_um=f.y_max_um, trusted=True,
    )  # fmt: skip


def begun(model: LssvmInverse, recording: Recording, at: int, off_um: float = 0.0) -> Trial:
    """A trial that begins at ``at``, from where the stage then is, or with a place that is off by so much."""
    learner = Learner.from_model(model)
    feed(learner, recording, 0, at)
    track = learner.parts.intake.track
    assert track is not None
    (y, v, a), u_before_V, u_V, y_um = track.since_motion()
    reckoning = Reckoning.begin(model, (y + off_um, v, a), u_before_V, u_V, y_um + off_um, track.memory)
    return Trial.begin(reckoning, model, track.memory_now(True))


def reckoned_by(wild: LssvmInverse, trial: Trial, recording: Recording, at: int) -> Trial:
    """The same trial, its place reckoned by another model."""
    n = trial.reckoning
    begin = Reckoning.begin(wild, (n.y_um, 0.0, 0.0), float(recording[0][at - 1]), np.zeros(0), np.zeros(0), n.memory)
    return replace(trial, reckoning=begin)


def judged(trial: Trial, recording: Recording, start: int, stop: int, now: Circumstances) -> tuple[Decision, int]:
    """The first decision that is not OPEN, and after how many samples."""
    u, y = recording
    for k in range(start, stop):
        decision = trial.put(float(u[k]), float(y[k]), now)
        if decision.outcome is not Outcome.OPEN:
            return decision, k - start + 1
    return Decision(Outcome.OPEN), stop - start


def test_readings_that_are_where_they_were_are_the_same(model: LssvmInverse, motions: dict[str, Recording]) -> None:
    at, now = 3000, circumstances(model)
    for recording in motions.values():
        decision, after = judged(begun(model, recording, at), recording, at, at + 1000, now)
        assert decision == Decision(Outcome.SAME, credit=1)
        assert after <= round(EnvelopeConfig().follow_s / DT_S) + VALUES // LOOKS


@pytest.mark.parametrize(("gain", "shift"), [(1.0, 0.15), (1.0, -0.2), (0.8, 0.0), (1.25, 0.0), (0.9, 0.1)])
def test_readings_that_follow_otherwise_have_changed(
    model: LssvmInverse, motions: dict[str, Recording], gain: float, shift: float
) -> None:
    """Slope and shift are those of the change, to some percent: it is the same in one window and the next."""
    at, now = 3000, circumstances(model)
    for u, clean in (motions["tones"], motions["sine"]):
        y = gain * clean + shift * range_of(model)
        decision, after = judged(begun(model, (u, clean), at), (u, y), at, at + 1500, now)
        if decision.outcome is Outcome.SAME:
            # The identified model explains them too: then the learner finds the change itself.
            assert abs(shift) < 0.15
            continue
        assert decision.outcome is Outcome.CHANGED
        # After a window, and another one in which it is the same; after half a one where it is plain.
        window = round(EnvelopeConfig().follow_s / DT_S)
        assert window // 2 <= after < 5 * window
        off_um = decision.slope * clean[at : at + 700] + decision.shift_um - y[at : at + 700]
        assert np.abs(off_um).max() < 0.04 * range_of(model)


@pytest.mark.parametrize(("gain", "fault"), [(1.08, ""), (2.6, SENSOR_GAIN)])
def test_a_gain_that_a_stage_can_have_is_no_fault_while_it_rings(
    model: LssvmInverse, motions: dict[str, Recording], gain: float, fault: str
) -> None:
    """With so much ringing that the readings do not follow, and too little to lie on no line at all."""
    at, now = 3250, circumstances(model)
    u, clean = motions["sine"]
    t_s = np.arange(clean.size) * DT_S
    swing_um = float(np.std(clean[at : at + round(now.envelope.follow_s / DT_S)]))
    y = clean[at] + gain * (clean - clean[at] + 0.5 * swing_um * np.sin(2.0 * math.pi * 125.0 * t_s))
    trial = begun(model, (u, clean), at)
    judged(trial, (u, y), at, at + round(0.9 * now.envelope.follow_s / DT_S), now)
    assert trial.fault == fault


@pytest.mark.parametrize("off", [-0.25, 0.2])
def test_a_reckoning_that_is_wrong_does_not_shut_out_a_good_sensor(
    model: LssvmInverse, motions: dict[str, Recording], off: float
) -> None:
    """It begins a quarter of the range away from the stage; the identified model says that the readings are right."""
    at, now = 3000, circumstances(model)
    for recording in motions.values():
        trial = begun(model, recording, at, off * range_of(model))
        decision, after = judged(trial, recording, at, at + 1000, now)
        assert decision.outcome is Outcome.SAME
        assert after < 600
        assert trial.fault == ""


def test_a_reckoning_that_goes_elsewhere_does_not_shut_out_a_good_sensor(
    model: LssvmInverse, motions: dict[str, Recording]
) -> None:
    """By its model the stage goes not half as far as it does: no reading follows that. The identified model knows."""
    at, now = 3000, circumstances(model)
    wild = replace(model, beta=2.4 * model.beta, alpha=2.4 * model.alpha)
    for recording in motions.values():
        trial = reckoned_by(wild, begun(model, recording, at), recording, at)
        decision, after = judged(trial, recording, at, at + 1500, now)
        assert decision.outcome is Outcome.SAME
        assert after < 1000
        assert trial.fault == ""


def test_samples_without_a_reading_decide_nothing(model: LssvmInverse, motions: dict[str, Recording]) -> None:
    at, now = 3000, circumstances(model)
    u, y = motions["tones"]
    trial = begun(model, (u, y), at)
    decision, _ = judged(trial, (u, np.full(y.size, math.nan)), at, at + 1000, now)
    assert decision.outcome is Outcome.OPEN
    assert trial.fault == ""
    assert trial.count == 0
    # What comes after is judged by where the stage has gone meanwhile.
    decision, _ = judged(trial, (u, y), at + 1000, at + 1600, now)
    assert decision.outcome is Outcome.SAME


def test_all_of_it_is_in_its_state(model: LssvmInverse, motions: dict[str, Recording]) -> None:
    at, now = 3000, circumstances(model)
    u, clean = motions["tones"]
    y = wrong("sign_rest", clean, at, range_of(model))
    one = begun(model, (u, clean), at)
    judged(one, (u, y), at, at + 200, now)
    assert one.fault
    changed: dict[str, Any] = {
        "fault": SENSOR_GAIN, "suspected": SENSOR_SIGN, "count": 301, "since": 302, "looked": 283, "times": 2,
        "obeyed": 4, "followed": 5, "agreed": 6, "slope": 1.25, "shift_um": -3.5,
    }  # fmt: skip
    one = replace(one, **changed)
    two = load(Trial, save(one), given={"base": model})
    for field in fields(Trial):
        mine, its = getattr(one, field.name), getattr(two, field.name)
        if field.name in ("memory", "window"):
            np.testing.assert_array_equal(mine, its)
        elif field.name not in ("reckoning", "base"):
            assert mine == its, field.name
    rest = range(at + 200, at + 600)
    for k in rest:
        assert one.put(float(u[k]), float(y[k]), now) == two.put(float(u[k]), float(y[k]), now)
    assert one.fault == two.fault
    state = save(one) | {"window": np.zeros((4, 3))}
    with pytest.raises(ModelFileError, match="window"):
        load(Trial, state, given={"base": model})


# ---- what a trial takes back, what is served meanwhile, and when no trial is held


def test_jumps_that_no_motion_bore_out_are_taken_back_with_the_first_of_them(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    """Two steps of the zero, 40 ms apart, and then the sign: the frame is again that from before both."""
    at = ATS[0]
    u, clean = motions["sine"]
    y = clean.copy()
    y[at:] += 0.03 * range_of(model)
    y[at + 40 :] += 0.03 * range_of(model)
    y[at + 80 :] = range_of(model) - y[at + 80 :]
    learner = Learner.from_state(warm["sine", at])
    frame, jumps = learner.features, learner.counters()["jumps"]
    place = clean[at + 60]
    feed(learner, (u, y), at, at + 80)
    assert learner.counters()["jumps"] == jumps + 2
    assert shown(learner, place) - place > 0.04 * range_of(model)
    kept = Learner.from_state(learner.state_dict())
    for one in (learner, kept):
        feed(one, (u, y), at + 80, at + NAMED)
        assert one.trouble == SENSOR_SIGN
        assert one.features == frame


def test_a_jump_that_motion_bore_out_stays(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    at = ATS[0]
    u, clean = motions["sine"]
    y = clean.copy()
    y[at:] += 0.05 * range_of(model)
    y[at + 1500 :] = range_of(model) - y[at + 1500 :]
    learner = Learner.from_state(warm["sine", at])
    feed(learner, (u, y), at, at + 1500 + NAMED)
    assert learner.trouble == SENSOR_SIGN
    assert shown(learner, clean[at]) - clean[at] > 0.03 * range_of(model)


@pytest.mark.parametrize("fault", ["sign_rest", "stuck_1e-5"])
def test_the_last_good_estimate_is_served_while_readings_are_on_trial(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], fault: str
) -> None:
    """It is a tenth to two tenths of a second old: an older one is worse away from the places of the last motion."""
    at = ATS[0]
    u, clean = motions["tones"]
    learner = Learner.from_state(warm["tones", at])
    good = [learner.parts.mark.beta.copy(), learner.parts.mark_beta[1].copy()]
    y = wrong(fault, clean, at, range_of(model), 1500)
    for k in range(at, at + 1500):
        before = learner.parts.filter.beta
        feed(learner, (u, y), k, k + 1)
        if learner.distrusts:
            break
        good.append(before)
    served = learner.parts.filter.beta
    ages = [i for i, beta in enumerate(good) if np.array_equal(beta, served)]
    assert ages
    assert len(good) - ages[-1] <= 0.25 / DT_S
    frozen = learner.snapshot().beta
    feed(learner, (u, y), k + 1, at + 1500)
    np.testing.assert_array_equal(learner.snapshot().beta, frozen)
    feed(learner, (u, y), at + 1500, at + 1500 + BACK)
    assert not learner.distrusts


def test_a_model_that_has_lost_its_credit_judges_no_sensor_until_it_reckons_right_again(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    at = ATS[0]
    u, clean = motions["tones"]
    y = wrong("sign_rest", clean, at, range_of(model), 600)
    doubtful = warm["tones", at] | {"front.credit": 0, "front.until_control": 0}
    learner = Learner.from_state(doubtful)
    for k in range(at, at + 600):
        feed(learner, (u, y), k, k + 1)
        assert learner.trouble not in SENSOR_FAULTS
    # Of good readings it is as good as ever, and then it judges again.
    learner = Learner.from_state(doubtful)
    feed(learner, (u, clean), at, at + 1500)
    assert learner.state_dict()["front.credit"] > 0
    feed(learner, (u, wrong("sign_rest", clean, at + 1500, range_of(model), 600)), at + 1500, at + 1500 + NAMED)
    assert learner.trouble == SENSOR_SIGN


@pytest.mark.parametrize("fault", ["stuck_1e-9", "stuck_1e-5"])
def test_a_model_without_credit_still_says_that_a_sensor_stands_still(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], fault: str
) -> None:
    """It cannot say where the stage is, but that it moves."""
    at = ATS[0]
    u, clean = motions["tones"]
    learner = Learner.from_state(warm["tones", at] | {"front.credit": -3, "front.until_control": 10**6})
    y = wrong(fault, clean, at, range_of(model))
    feed(learner, (u, y), at, at + NAMED)
    assert learner.trouble == SENSOR_STUCK
    assert learner.distrusts
    before = learnt(learner)
    feed(learner, (u, y), at + NAMED, at + WRONG)
    assert learnt(learner) == before
    feed(learner, (u, clean), at + WRONG, at + WRONG + BACK)
    assert learner.trouble == ""
    assert learner.diagnostics()["recent_rms_error_pct"] < 1.0


def test_by_voltages_alone_readings_that_move_are_trusted_after_two_seconds(
    model: LssvmInverse, motions: dict[str, Recording]
) -> None:
    at, now = 3000, circumstances(model)
    u, clean = motions["tones"]
    for y, least, most in ((clean, 1, 600), (3.0 * clean, 2000, 2200)):
        trial = replace(begun(model, (u, clean), at), by_voltages=1)
        decision, after = judged(trial, (u, y), at, at + 3000, now)
        assert decision == Decision(Outcome.SAME)
        assert least <= after <= most
    still = np.full_like(clean, clean[at])
    trial = replace(begun(model, (u, clean), at), by_voltages=1)
    assert judged(trial, (u, still), at, at + 4000, now)[0].outcome is Outcome.OPEN
    assert trial.fault == SENSOR_STUCK


def test_a_failed_control_trial_takes_away_two_that_were_passed(
    model: LssvmInverse, motions: dict[str, Recording]
) -> None:
    learner = Learner.from_model(replace(model, beta=0.5 * model.beta, alpha=0.5 * model.alpha))
    credits = []
    for k in range(2500):
        feed(learner, motions["tones"], k, k + 1)
        credits.append(learner.state_dict()["front.credit"])
    # One from -2 leaves -3, the least there is.
    assert -2 in np.diff(credits)


def test_readings_that_only_the_identified_model_explains_cost_the_reckoning_its_credit(
    model: LssvmInverse, motions: dict[str, Recording]
) -> None:
    at, now = 3000, circumstances(model)
    recording = motions["tones"]
    decision, _ = judged(begun(model, recording, at), recording, at, at + 1000, now)
    assert decision.credit == 1
    wild = replace(model, beta=2.4 * model.beta, alpha=2.4 * model.alpha)
    decision, _ = judged(reckoned_by(wild, begun(model, recording, at), recording, at), recording, at, at + 1500, now)
    assert decision == Decision(Outcome.SAME, credit=-1)


# --- A sensor that repeats itself, is at its end or says nothing: the learner follows by the voltages, and stays as is.

DT, STROKE_SPAN_V = 1e-3, 8.0


def feed_readings(learner: Learner, u: FloatArray, y: FloatArray, start: int, stop: int) -> list[str]:
    return [learner.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def before_sticking(model: LssvmInverse, all_strokes: Recording) -> dict[int, dict[str, object]]:
    """States of a learner at some instants."""
    learner, states, before = Learner.from_model(model), {}, 0
    for at in (4000, 4123, 4371, 4600):
        feed_readings(learner, *all_strokes, before, at)
        states[at], before = learner.state_dict(), at
    return states


def stuck(kind: str, y: FloatArray, at: int, n: int) -> FloatArray:
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
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording, kind: str, n: int, at: int
) -> None:
    u, clean = all_strokes
    y = stuck(kind, clean, at, n)
    learner, twin = Learner.from_state(before_sticking[at]), Learner.from_state(before_sticking[at])
    before = learner.counters()
    feed_readings(learner, u, y, at, at + n)
    # A reading that has stood still for longer than 0.1 s has to follow the drive for 0.3 s before it is trusted.
    feed_readings(learner, u, clean, at + n, at + n + 600)
    feed_readings(twin, u, clean, at, at + n + 600)
    after = learner.counters()
    assert [after[name] - before[name] for name in ("jumps", "rollbacks")] == [0, 0]
    assert learner.trouble == ""
    # Reckoning over 1.5 s is off by some tenths of a µm; to forget the turning points would be off by many.
    assert np.max(np.abs(learner.memory()[:20] - twin.memory()[:20])) < 1.5
    points = np.linspace(15.0, 65.0, 40), np.zeros(40), np.zeros(40)
    told, wanted = (each.snapshot().feedforward(*points, twin.memory()).u_V for each in (learner, twin))
    assert np.max(np.abs(told - wanted)) < 5e-3 * STROKE_SPAN_V


def test_who_has_lost_the_place_still_knows_the_turning_points(
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """A sensor that comes back with another zero, after strokes that nobody has read."""
    at, n = 4123, 1000
    y = stuck("silent", all_strokes[1], at, n)
    y[at + n :] += 6.0
    learner, twin = Learner.from_state(before_sticking[at]), Learner.from_state(before_sticking[at])
    before = learner.counters()["jumps"]
    feed_readings(learner, all_strokes[0], y, at, at + n + 20)
    feed_readings(twin, *all_strokes, at, at + n + 20)
    assert learner.counters()["jumps"] == before + 1
    wide = np.array(learner.base.features.thresholds_um) > 8.0
    assert np.count_nonzero(wide) > 3
    off = (learner.memory() - twin.memory())[: wide.size][wide]
    assert np.max(np.abs(off)) < 1.5


def test_state_goes_on_to_the_last_bit_while_the_sensor_is_stuck(
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    at = 4123
    y = stuck("frozen", all_strokes[1], at, 400)
    one = Learner.from_state(before_sticking[at])
    feed_readings(one, all_strokes[0], y, at, at + 200)
    two = Learner.from_state(one.state_dict())
    assert feed_readings(one, all_strokes[0], y, at + 200, at + 900) == feed_readings(
        two, all_strokes[0], y, at + 200, at + 900
    )
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
    feed_readings(learner, u, y, 0, 2930)
    assert learner.counters()["jumps"] == 1


def test_a_missing_reading_at_rest_is_no_repeated_one(
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    at, (u, y) = 4123, (column.copy() for column in all_strokes)
    u[at : at + 450], y[at : at + 450] = u[at - 1], y[at - 1]
    y[at + 400] = math.nan
    learner = Learner.from_state(before_sticking[at])
    assert learner.parts.intake._judges
    before = learner.counters()["trials"]
    feed_readings(learner, u, y, at, at + 450)
    assert learner.counters()["trials"] == before


def test_a_jump_that_never_was_is_taken_back_when_the_model_of_the_beginning_is_right(
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """As where a gap hides the way back from the gates: the frame must not stay wrong for good."""
    at = 4123
    learner = Learner.from_state(before_sticking[at])
    lied = all_strokes[1].copy()
    lied[at : at + 150] += 8.0
    feed_readings(learner, all_strokes[0], lied, at, at + 150)
    assert learner.counters()["jumps"] == 1
    feed_readings(learner, *all_strokes, at + 200, at + 2800)
    assert learner.features == learner.base.features
    assert learner.diagnostics()["valid"]


def test_the_memory_to_serve_with_is_the_one_that_was_learnt_with(
    before_sticking: dict[int, dict[str, object]], all_strokes: Recording
) -> None:
    """It is the learner's own, carried along the readings since the smoother's instant: also over a jump and a hold."""
    at = 4123
    u, clean = all_strokes
    y = clean.copy()
    y[at + 100 :] += 2.0
    learner = Learner.from_state(before_sticking[at])
    for stop in (at + 50, at + 105, at + 118, at + 300):
        feed_readings(learner, u, y, learner.seq + 1, stop)
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


# ---- how one thing follows another


@pytest.mark.parametrize("n", [3, 4, 10, 128])
@pytest.mark.parametrize("noise", [0.0, 0.01, 1.0])
def test_a_slope_is_that_of_least_squares(n: int, noise: float) -> None:
    rng = np.random.default_rng(n)
    x = 40.0 + 3.0 * rng.standard_normal(n)
    y = 7.0 - 0.6 * x + noise * rng.standard_normal(n)
    s = slope_of(x, y)
    slope, constant = np.polyfit(x, y, 1)
    assert (s.slope, s.constant) == pytest.approx((slope, constant), rel=1e-8)
    left = y - s.slope * x - s.constant
    assert s.residual == pytest.approx(math.sqrt(np.mean(left * left)), rel=1e-6, abs=1e-6)
    assert s.share == pytest.approx(np.corrcoef(x, y)[0, 1] ** 2, abs=1e-9)
    assert s.swing == pytest.approx(np.std(x))
    if n > 3:
        covariance = np.polyfit(x, y, 1, cov="unscaled")[1] * np.sum(left * left) / (n - 2)
        assert s.std == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-6, abs=1e-7)


def test_a_slope_of_what_does_not_move_or_is_too_little_is_none() -> None:
    still = slope_of(np.full(10, 3.0), np.arange(10.0))
    assert (still.slope, still.constant, still.share, still.swing) == (0.0, 4.5, 0.0, 0.0)
    assert math.isinf(still.std)
    assert still.residual == pytest.approx(np.std(np.arange(10.0)))
    for n in (1, 2):
        few = slope_of(np.arange(float(n)), np.arange(float(n)))
        assert math.isinf(few.std)
        assert (few.slope, few.share) == (0.0, 0.0)
    flat = slope_of(np.arange(10.0), np.full(10, 2.0))
    assert (flat.slope, flat.constant, flat.std, flat.residual, flat.share) == (0.0, 2.0, 0.0, 0.0, 0.0)
