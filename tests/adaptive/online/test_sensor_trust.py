"""Trust in the sensor: the check that always runs, the trial, and sensors that stick."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.dead_reckoning import Reckoning
from dehyst.adaptive.online.gates import AdmissionConfig, EnvelopeConfig
from dehyst.adaptive.online.glitch_or_jump import Circumstances
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.sensor_trust import (
    FOLLOWING_SLOPES,
    LOOKS,
    SENSOR_FAULTS,
    SENSOR_FOREIGN,
    SENSOR_GAIN,
    SENSOR_SIGN,
    SENSOR_STUCK,
    STILL_STEPS,
    VALUES,
    Decision,
    Following,
    Outcome,
    Trial,
    slope_of,
)
from dehyst.adaptive.types import FloatArray, Sample, StateDict
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


@pytest.mark.parametrize("seconds", [1.0, 60.0])
def test_a_gain_that_breaks_down_is_found_as_soon_after_a_minute_as_after_a_second(seconds: float) -> None:
    u = strokes(seconds + 1.0, 1.0)
    at = round(seconds / EVERY_S)
    p = np.where(np.arange(u.size) < at, u, u[at] + 0.35 * (u - u[at]))
    said = asked(Following(), u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(0.35 / EVERY_S)


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


# --- A sensor that is wrong has a name within half a second, teaches nothing, and earns its trust back; a good one has
# it.
#
# The readings are those of the simulated stage under a voltage of its own, made wrong from outside.

DT_S = 1e-3
Recording = tuple[FloatArray, FloatArray]
#: When a sensor goes wrong, and for how many samples.
ATS, WRONG = (2500, 3133), 600
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


@pytest.mark.parametrize(
    ("fault", "motion"), list(zip(FAULTS, itertools.cycle(["tones", "sine", "triangle"]), strict=False))
)
def test_a_fault_has_its_name_teaches_nothing_and_good_readings_lead_back(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], fault: str, motion: str
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


@pytest.mark.parametrize(("motion", "noise_share"), [("tones", 0.0), ("sine", 5e-4), ("triangle", 5e-4)])
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


@pytest.mark.parametrize(("motion", "gain"), [("tones", -0.12), ("sine", 0.12), ("triangle", -0.06)])
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


@pytest.mark.parametrize("place", [0.8])
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
    at = ATS[1]
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
        low_um=f.y_min_um, high_um=f.y_max_um,
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
        assert decision == Decision(Outcome.SAME)
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
    good = [learner.parts.mark.beta.copy(), learner.parts.next_mark.beta.copy()]
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


def test_a_model_that_has_lost_its_credit_judges_no_sensor_until_it_is_valid_again(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict]
) -> None:
    at = ATS[0]
    u, clean = motions["tones"]
    y = wrong("sign_rest", clean, at, range_of(model), 400)
    doubtful = warm["tones", at] | {"front.credit": 0}
    learner = Learner.from_state(doubtful)
    for k in range(at, at + 400):
        feed(learner, (u, y), k, k + 1)
        assert learner.trouble not in SENSOR_FAULTS
    # Of good readings it is as good as ever, and then it judges again.
    learner = Learner.from_state(doubtful)
    feed(learner, (u, clean), at, at + 2500)
    assert learner.state_dict()["front.credit"] > 0
    feed(learner, (u, wrong("sign_rest", clean, at + 2500, range_of(model), 600)), at + 2500, at + 2500 + NAMED)
    assert learner.trouble == SENSOR_SIGN


@pytest.mark.parametrize("fault", ["stuck_1e-9", "stuck_1e-5"])
def test_a_model_without_credit_still_says_that_a_sensor_stands_still(
    model: LssvmInverse, motions: dict[str, Recording], warm: dict[tuple[str, int], StateDict], fault: str
) -> None:
    """It cannot say where the stage is, but that it moves."""
    at = ATS[0]
    u, clean = motions["tones"]
    learner = Learner.from_state(warm["tones", at] | {"front.credit": 0})
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


# --- A sensor that repeats itself, is at its end or says nothing: the learner follows by the voltages, and stays as is.

DT, STROKE_SPAN_V = 1e-3, 8.0


def feed_readings(learner: Learner, u: FloatArray, y: FloatArray, start: int, stop: int) -> list[str]:
    return [learner.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def before_sticking(model: LssvmInverse, all_strokes: Recording) -> dict[int, dict[str, object]]:
    """States of a learner at some instants."""
    learner, states, before = Learner.from_model(model), {}, 0
    for at in (4000, 4123, 4371):
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


@pytest.mark.parametrize("kind", ["frozen", "at its end", "silent"])
@pytest.mark.parametrize(("at", "n"), [(4000, 30), (4123, 300), (4371, 1500)])
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
