"""Readings far from the prediction: glitch, ringing, jump or sensor fault."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, replace
from typing import NamedTuple, get_type_hints

import numpy as np
import pytest

from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import GLITCH, AdmissionConfig, EnvelopeConfig
from dehyst.adaptive.online.glitch_or_jump import (
    LEVEL_STD,
    NO_LEVEL,
    SIGMA,
    USUAL_STD,
    WINDOWS,
    Circumstances,
    Hold,
    Level,
    Verdict,
    judge,
    level_of,
)
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.track import Reckoning
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import FloatArray, Sample, StateDict
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- Glitch, knock, ringing, jump: what a run of surprising readings is taken for, and how often wrongly.
#
# First the decision alone, on readings about a place that is known, at four sample rates. Then through the learner, on
# the simulated stage: the readings of a stage that is struck, or that has changed, are those of the simulation with
# the swing of a damped mode added.

DT_S = 1e-3
Recording = tuple[FloatArray, FloatArray]
#: Instants at which something happens, in slow strokes and in fast ones.
ATS = tuple(range(2000, 6500, 150))
HELD = frozenset({"glitch", "ringing"})


# ---- the decision alone

RANGE_UM, PLACE_UM = 100.0, 40.0


def circumstances(dt_s: float = DT_S, trusted: bool = True) -> Circumstances:
    """Those of a healthy axis with a range of 100 µm."""
    config = AdmissionConfig().at(dt_s)
    usual_um = config.surprise_share * RANGE_UM
    return Circumstances(
        config=config, envelope=EnvelopeConfig(), dt_s=dt_s, range_um=RANGE_UM,
        noise_um=usual_um / config.surprise_sigma, usual_um=usual_um, rest_um=0.0, low_um=-5.0,
        high_um=105.0, trusted=trusted,
    )  # fmt: skip


def hold_at(model: LssvmInverse, place_um: float = PLACE_UM) -> Hold:
    """A hold that begins at a place that was known."""
    none = np.zeros(0)
    return Hold(Reckoning.begin(model, (place_um, 0.0, 0.0), 4.0, none, none, model.rest_memory(place_um)), place_um)


def put(hold: Hold, old_um: float, y_um: float) -> None:
    """One sample, with the place that the reckoning is to have come to."""
    hold.u_V.append(4.0)
    hold.old_um.append(old_um)
    hold.y_um.append(y_um)


def outcome(
    model: LssvmInverse, away: Callable[[float], float], dt_s: float, rng: np.random.Generator, over_s: float = 0.15
) -> tuple[Verdict, float, float]:
    """(first decision but BACK, when, s, and how far away), for readings ``away(t)``, µm, and noise at one place.

    Readings that are back begin another hold when they surprise again. WAIT where nothing is decided.
    """
    now, hold = circumstances(dt_s), hold_at(model)
    for k in range(1, round(over_s / dt_s)):
        off_um = away(k * dt_s) + 0.5 * now.noise_um * rng.standard_normal()
        if not hold.y_um and abs(off_um) <= now.usual_um:
            continue
        put(hold, PLACE_UM, PLACE_UM + off_um)
        verdict = judge(hold, now)
        if verdict is Verdict.BACK:
            hold = hold_at(model)
        elif verdict is not Verdict.WAIT:
            return verdict, k * dt_s, hold.away_um
    return Verdict.WAIT, over_s, 0.0


class Mode:
    """A damped mode of a random frequency and damping that swings by ``size_um``."""

    def __init__(self, rng: np.random.Generator, dt_s: float, size_um: float, phase: float = 0.0) -> None:
        self.omega = 2.0 * math.pi * rng.uniform(100.0, min(450.0, 0.45 / dt_s))
        self.damping = math.exp(rng.uniform(math.log(0.01), math.log(0.1)))
        self.size_um, self.phase = size_um, phase

    def __call__(self, t_s: float) -> float:
        swing = math.sin(self.omega * math.sqrt(1.0 - self.damping**2) * t_s + self.phase)
        return self.size_um * math.exp(-self.damping * self.omega * t_s) * swing


@pytest.mark.parametrize("dt_s", [2e-3, 1e-3, 5e-4, 1e-4])
@pytest.mark.parametrize("modes", [1, 2])
def test_looked_at_again_and_again_a_knock_is_no_jump(model: LssvmInverse, dt_s: float, modes: int) -> None:
    """None of 150 a sample rate, at swings of 0.5 to 5 % of the range, with a look at each reading."""
    rng, said = np.random.default_rng([modes, round(1.0 / dt_s)]), Counter[Verdict]()
    for _ in range(150 if dt_s > 2e-4 else 40):
        sizes = rng.uniform(0.005, 0.05) * RANGE_UM * np.array([1.0, rng.uniform(0.1, 0.5)])
        struck = [Mode(rng, dt_s, float(size)) for size in sizes[:modes]]
        said[outcome(model, lambda t, struck=struck: sum(mode(t) for mode in struck), dt_s, rng)[0]] += 1
    assert said[Verdict.JUMP] == 0
    # It is waited for; that the sensor is wrong is not thought of but where two modes are beyond four coefficients.
    assert said[Verdict.LOST] <= (0 if modes == 1 else 0.1 * said.total())


@pytest.mark.parametrize("dt_s", [2e-3, 1e-3, 5e-4, 1e-4])
@pytest.mark.parametrize("ringing", [0.0, 0.5, 1.0])
def test_a_jump_is_found_by_its_level_and_soon(model: LssvmInverse, dt_s: float, ringing: float) -> None:
    """Plain ones always within 20 ms or 16 readings; ringing ones in 97 % or more, within 60 ms, to 0.1 of it."""
    rng, found, latest_s, cases = np.random.default_rng([int(10 * ringing), round(1.0 / dt_s)]), 0, 0.0, 100
    for _ in range(cases):
        step_um = rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.1) * RANGE_UM
        mode = Mode(rng, dt_s, ringing * step_um, -0.5 * math.pi)
        verdict, at_s, away_um = outcome(model, lambda t, mode=mode, to=step_um: to + mode(t), dt_s, rng)
        found += verdict is Verdict.JUMP and abs(away_um - step_um) < 0.1 * abs(step_um)
        latest_s = max(latest_s, at_s if verdict is Verdict.JUMP else 0.0)
    assert found >= (0.97 if ringing else 1.0) * cases
    assert latest_s <= (0.06 if ringing else max(0.02, 17.0 * dt_s))


def test_no_jump_claims_more_than_the_readings_have_moved(model: LssvmInverse) -> None:
    """The reckoning goes 8 µm away at once, the readings stay: that is no jump of theirs."""
    rng, now = np.random.default_rng(5), circumstances()
    for moves_um, verdict in ((0.0, None), (8.0, Verdict.JUMP)):
        hold = hold_at(model)
        said = []
        for _ in range(39):
            # Where the readings themselves have moved by as much, the same distance is one.
            put(hold, PLACE_UM - (8.0 - moves_um), PLACE_UM + moves_um + 0.5 * now.noise_um * rng.standard_normal())
            said.append(judge(hold, now))
            if said[-1] is Verdict.JUMP:
                break
        assert (said[-1] if verdict else None) is verdict
        assert (Verdict.JUMP in said) == (verdict is not None)


@pytest.mark.parametrize("share", [0.13, 0.2, -0.5])
def test_no_jump_is_larger_than_the_envelope_allows(model: LssvmInverse, share: float) -> None:
    rng = np.random.default_rng(6)
    verdict, at_s, _ = outcome(model, lambda _: share * RANGE_UM, DT_S, rng)
    assert verdict is Verdict.LOST
    assert at_s <= 0.05
    inside = 0.9 * EnvelopeConfig().jump * RANGE_UM
    assert outcome(model, lambda _: math.copysign(inside, share), DT_S, rng)[0] is Verdict.JUMP


def test_outside_the_identified_range_nothing_is_believed_at_once(model: LssvmInverse) -> None:
    now, rng = circumstances(), np.random.default_rng(7)
    for low_um, high_um in ((50.0, 105.0), (-5.0, 30.0)):
        hold = hold_at(model)
        for _ in range(39):
            put(hold, PLACE_UM, PLACE_UM + 4.0 + 0.5 * now.noise_um * rng.standard_normal())
            assert judge(hold, now._replace(low_um=low_um, high_um=high_um)) is Verdict.WAIT


# ---- through the learner


@pytest.fixture(scope="module")
def still() -> Recording:
    """(u_V, y_um) of 3 s of strokes, 2 s of rest and 3 s of strokes."""
    stage = Stage(preset("rich", seed=8))
    t_s = np.arange(3000) * DT_S
    stroke = np.minimum(t_s / 0.5, 1.0) * (4.0 + 2.5 * np.sin(2 * np.pi * 0.9 * t_s))
    # From the end of the first strokes, at 4 V or near it, on.
    rest = np.full(2000, stroke[-1])
    again = stroke[-1] + 2.0 * np.sin(2 * np.pi * 0.9 * t_s)
    u = np.concatenate([stroke, rest, again])
    return u, stage.run(stage.initial_state(), u)[0]


def feed(learner: Learner, recording: Recording, start: int, stop: int) -> list[str]:
    u, y = recording
    return [learner.handle(Sample(k, k * DT_S, float(u[k]), float(y[k]))) for k in range(start, stop)]


def states_of(model: LssvmInverse, recording: Recording, ats: tuple[int, ...] = ATS) -> dict[int, StateDict]:
    """States of a learner at some instants."""
    learner, states, before = Learner.from_model(model), {}, 0
    for at in ats:
        feed(learner, recording, before, at)
        states[at], before = learner.state_dict(), at
    return states


@pytest.fixture(scope="module")
def slow_states(model: LssvmInverse, recording: Recording) -> dict[int, StateDict]:
    return states_of(model, recording)


@pytest.fixture(scope="module")
def fast_states(model: LssvmInverse, all_strokes: Recording) -> dict[int, StateDict]:
    return states_of(model, all_strokes)


def range_of(model: LssvmInverse) -> float:
    return model.features.y_max_um - model.features.y_min_um


def swing(n: int, mode_Hz: float, damping: float, size_um: float, phase: float = 0.0) -> FloatArray:
    """(n,) µm of a damped mode, from a sample after it was struck."""
    t_s, omega = (np.arange(n) + 1.0) * DT_S, 2.0 * math.pi * mode_Hz
    wave: FloatArray = np.sin(omega * math.sqrt(1.0 - damping**2) * t_s + phase)
    return size_um * np.exp(-damping * omega * t_s) * wave


def struck(recording: Recording, at: int, mode_Hz: float, damping: float, size_um: float) -> Recording:
    u, y = recording[0], recording[1].copy()
    y[at:] += swing(y.size - at, mode_Hz, damping, size_um)
    return u, y


def answers(learner: Learner, memory: FloatArray) -> FloatArray:
    """(50,) V that it serves at rest all over the range."""
    motion = np.linspace(10.0, 70.0, 50)
    return learner.snapshot().feedforward(motion, np.zeros(50), np.zeros(50), memory).u_V


def events(learner: Learner, before: StateDict | None = None) -> dict[str, int]:
    """What the learner has decided, since the state ``before``."""
    names = ("jumps", "jumps_undone", "trials", "restarts", "rollbacks", "distrusts")
    since = Learner.from_state(before).counters() if before else dict.fromkeys(names, 0)
    return {name: learner.counters()[name] - since[name] for name in names}


NOTHING = dict.fromkeys(("jumps", "jumps_undone", "trials", "restarts", "rollbacks", "distrusts"), 0)


@pytest.mark.parametrize("share", [0.005, 0.015, 0.03])
@pytest.mark.parametrize(
    ("mode_Hz", "damping"),
    [(100.0, 0.03), (100.0, 0.1), (173.0, 0.01), (291.0, 0.01), (291.0, 0.03), (450.0, 0.01), (450.0, 0.03)],
)
def test_a_knock_is_waited_for_and_teaches_nothing(
    model: LssvmInverse, recording: Recording, slow_states: dict[int, StateDict], mode_Hz: float, damping: float,
    share: float,
) -> None:  # fmt: skip
    """No jump, no doubt of the sensor; no step of the filter while it is held; then learning goes on as without it."""
    at = ATS[round(mode_Hz + 1e3 * (damping + share)) % len(ATS)]
    knocked = struck(recording, at, mode_Hz, damping, share * range_of(model))
    learner, twin = (Learner.from_state(slow_states[at]) for _ in range(2))
    said = []
    for k in range(at, at + 900):
        updates = learner.parts.filter.state.updates
        said += feed(learner, knocked, k, k + 1)
        if learner.parts.intake.holds:
            assert learner.parts.filter.state.updates == updates
            assert said[-1] in HELD
        assert learner.trouble == ""
    feed(twin, recording, at, at + 900)
    # While the swing is more than 0.4 % of the range nearly all readings are held back; half a percent is hardly more.
    loud = int(math.log(share / 0.004) / (damping * 2.0 * math.pi * mode_Hz) / DT_S)
    if share > 0.01:
        assert sum(word in HELD for word in said[:loud]) >= 0.85 * loud
        assert "ringing" in said or damping > 0.05
    assert events(learner, slow_states[at]) == NOTHING
    assert learner.features == twin.features
    assert not HELD & set(said[-400:])
    assert said[-400:].count("learnt") >= 190
    off_V = np.abs(answers(learner, twin.memory()) - answers(twin, twin.memory()))
    # A mode as slow as the motion itself is within the band of the smoother: the end of its ringing teaches.
    assert off_V.max() < (4e-3 if mode_Hz > 150.0 else 1e-2) * model.span_V


@pytest.mark.parametrize(("strokes", "jumps", "off"), [("slow", 0.01, 0.015), ("fast", 0.03, 0.015)])
def test_a_knock_at_any_time_leaves_the_model_as_it_was(
    model: LssvmInverse, request: pytest.FixtureRequest, strokes: str, jumps: float, off: float
) -> None:
    """Of 100 at random: at most that share is taken for a small jump, none has a name, and all answers stay.

    The error of what is reckoned grows with the way gone: in strokes of up to 7.7 Hz some tenths of a percent of the
    range after 50 ms, and that is taken for a jump now and then.
    """
    recording = request.getfixturevalue("recording" if strokes == "slow" else "all_strokes")
    states = request.getfixturevalue(f"{strokes}_states")
    rng, happened, worst_V, moved_um = np.random.default_rng(7), Counter[str](), 0.0, 0.0
    twins = {at: Learner.from_state(state) for at, state in states.items()}
    for at, twin in twins.items():
        feed(twin, recording, at, at + 300)
    for i in range(100):
        at = ATS[i % len(ATS)]
        damping = math.exp(rng.uniform(math.log(0.01), math.log(0.1)))
        size_um = range_of(model) * rng.uniform(0.005, 0.03)
        knocked = struck(recording, at, rng.uniform(100.0, 450.0), damping, size_um)
        learner, twin = Learner.from_state(states[at]), twins[at]
        for k in range(at, at + 300):
            feed(learner, knocked, k, k + 1)
            assert learner.trouble == ""
        happened.update(name for name, count in events(learner, states[at]).items() if count)
        worst_V = max(worst_V, np.abs(answers(learner, twin.memory()) - answers(twin, twin.memory())).max())
        f, g = learner.features, twin.features
        moved_um = max(moved_um, *(abs((f.gain - g.gain) * y + f.offset_um - g.offset_um) for y in (10.0, 70.0)))
    assert happened["jumps"] <= jumps * 100
    assert happened["trials"] <= 1
    assert worst_V < off * model.span_V
    assert moved_um < 0.02 * range_of(model)


@pytest.mark.parametrize("ringing", [0.5, 1.0])
@pytest.mark.parametrize("gain", [-0.12, -0.06, 0.04, 0.08, 0.12])
@pytest.mark.parametrize("strokes", ["slow", "fast"])
def test_a_gain_step_with_ringing_is_believed_once(
    model: LssvmInverse, request: pytest.FixtureRequest, strokes: str, gain: float, ringing: float
) -> None:
    """Within 40 readings, and the frame shows the place within 1 % of the range."""
    recording = request.getfixturevalue("recording" if strokes == "slow" else "all_strokes")
    states = request.getfixturevalue(f"{strokes}_states")
    rng = np.random.default_rng(round(1e4 + 1e3 * gain + 10 * ringing))
    u, y = recording
    for at in ATS[::5]:
        step_um = gain * y[at]
        if abs(step_um) < 0.008 * range_of(model):
            continue
        damping, mode_Hz = math.exp(rng.uniform(math.log(0.02), math.log(0.1))), rng.uniform(150.0, 450.0)
        changed = y.copy()
        changed[at:] *= 1.0 + gain
        changed[at:] += swing(y.size - at, mode_Hz, damping, ringing * step_um, -0.5 * math.pi)
        learner = Learner.from_state(states[at])
        before = learner.features
        feed(learner, (u, changed), at, at + 40)
        assert events(learner, states[at])["jumps"] == 1
        place = (y[at + 39] - before.offset_um) / before.gain
        shown_um = learner.features.offset_um + learner.features.gain * place
        assert shown_um == pytest.approx((1.0 + gain) * y[at + 39], abs=0.01 * range_of(model))
        feed(learner, (u, changed), at + 40, at + 600)
        assert events(learner, states[at])["jumps"] == 1
        assert events(learner, states[at])["jumps_undone"] == 0
        assert learner.trouble == ""


@pytest.mark.parametrize("ringing", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("strokes", ["slow", "fast"])
def test_a_zero_step_with_ringing_is_found_and_kept(
    model: LssvmInverse, request: pytest.FixtureRequest, strokes: str, ringing: float
) -> None:
    """Of 1 to 8 % of the range. It may be taken for a gain, and be put right by further jumps while it rings.

    After half a second the model is off by less than 0.4 % of the voltage span, in the median. Hardly any goes
    on trial: at most one in 30 in slow strokes, one in 10 in fast ones that ring by the whole step.
    """
    recording = request.getfixturevalue("recording" if strokes == "slow" else "all_strokes")
    states = request.getfixturevalue(f"{strokes}_states")
    rng = np.random.default_rng([9, round(10 * ringing)])
    u, y = recording
    trials, off_pct = 0, []
    for i in range(30):
        at = ATS[i % len(ATS)]
        step_um = rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.08) * range_of(model)
        damping, mode_Hz = math.exp(rng.uniform(math.log(0.02), math.log(0.1))), rng.uniform(150.0, 450.0)
        changed = y.copy()
        changed[at:] += step_um + swing(y.size - at, mode_Hz, damping, ringing * step_um, -0.5 * math.pi)
        learner = Learner.from_state(states[at])
        feed(learner, (u, changed), at, at + 500)
        assert events(learner, states[at])["jumps"] >= 1
        assert learner.trouble == ""
        trials += events(learner, states[at])["trials"] > 0
        off_pct.append(learner.diagnostics()["recent_rms_error_pct"])
    assert np.median(off_pct) < 0.4
    assert max(off_pct) < 2.0
    assert trials <= {"slow": 2, "fast": 8}[strokes] * (ringing > 0.0)


def test_a_jump_of_a_fifth_is_not_believed_from_readings_at_one_level(model: LssvmInverse, still: Recording) -> None:
    """As long as the stage rests it stays undecided; motion shows that the readings follow, and then it is."""
    u, clean = still
    shift_um = 0.2 * range_of(model)
    y = clean.copy()
    y[3500:] += shift_um
    learner = Learner.from_model(model)
    feed(learner, (u, y), 0, 3500)
    frame, updates, before = learner.features, learner.parts.filter.state.updates, learner.state_dict()
    feed(learner, (u, y), 3500, 5000)
    assert events(learner, before)["jumps"] == 0
    assert learner.features == frame
    assert learner.parts.filter.state.updates == updates
    said = feed(learner, (u, y), 5000, 6000)
    assert events(learner, before)["jumps"] == 1
    assert learner.trouble == ""
    assert "learnt" in said[-100:]
    for place in (20.0, 60.0):
        shown_um = learner.features.offset_um + learner.features.gain * (place - frame.offset_um) / frame.gain
        assert shown_um - place == pytest.approx(shift_um, abs=0.02 * range_of(model))


@pytest.mark.parametrize("noise_share", [1e-9, 3e-6, 1e-5, 1e-4, 3e-4])
@pytest.mark.parametrize("strokes", ["slow", "fast"])
def test_a_sensor_that_sticks_with_noise_makes_no_jump(
    model: LssvmInverse, request: pytest.FixtureRequest, strokes: str, noise_share: float
) -> None:
    """From 1e-9 to 3e-4 of the range: for one second no frame moves."""
    recording = request.getfixturevalue("recording" if strokes == "slow" else "all_strokes")
    states = request.getfixturevalue(f"{strokes}_states")
    u, clean = recording
    rng = np.random.default_rng(2)
    for at in ATS[::6]:
        y = clean.copy()
        y[at : at + 1000] = clean[at - 1] + noise_share * range_of(model) * rng.standard_normal(1000)
        learner = Learner.from_state(states[at])
        frame = learner.features
        feed(learner, (u, y), at, at + 1000)
        assert events(learner, states[at])["jumps"] == 0
        assert learner.features == frame


@pytest.mark.parametrize("at_ms", [1, 7, 25, 60])
def test_state_goes_on_to_the_last_bit_while_it_rings(
    recording: Recording, slow_states: dict[int, StateDict], at_ms: int
) -> None:
    at = ATS[10]
    knocked = struck(recording, at, 220.0, 0.01, 2.0)
    one = Learner.from_state(slow_states[at])
    said = feed(one, knocked, at, at + at_ms)
    assert said[-1] in HELD
    assert one.parts.intake.holds
    assert_goes_on(one, knocked, at + at_ms, at + 700)


def test_state_goes_on_to_the_last_bit_while_it_rings_about_a_new_level(
    recording: Recording, slow_states: dict[int, StateDict]
) -> None:
    at = ATS[10]
    u, y = struck(recording, at, 220.0, 0.01, 2.0)
    y[at:] += 3.0
    one = Learner.from_state(slow_states[at])
    feed(one, (u, y), at, at + 30)
    assert events(one, slow_states[at])["jumps"] == 1
    assert one.parts.intake.holds
    assert_goes_on(one, (u, y), at + 30, at + 700)


@pytest.mark.parametrize("kind", ["stuck", "foreign"])
def test_state_goes_on_to_the_last_bit_while_readings_are_on_trial(
    all_strokes: Recording, fast_states: dict[int, StateDict], kind: str
) -> None:
    at = ATS[10]
    u, y = all_strokes[0], all_strokes[1].copy()
    rng = np.random.default_rng(4)
    y[at : at + 600] = y[at] + 1e-4 * rng.standard_normal(600) if kind == "stuck" else y[1000:1600]
    one = Learner.from_state(fast_states[at])
    feed(one, (u, y), at, at + 400)
    assert events(one, fast_states[at])["trials"] >= 1
    assert one.trouble
    assert one.parts.intake.holds
    assert_goes_on(one, (u, y), at + 400, at + 1500)


def test_all_of_a_hold_is_in_its_state(model: LssvmInverse) -> None:
    """Each of its fields with a value of its own."""
    hold = hold_at(model)
    for k in range(5):
        put(hold, PLACE_UM + 0.1 * k, math.nan if k == 2 else PLACE_UM - 0.2 * k)
    plain = [field for field in fields(Hold) if field.name not in ("reckoning", "u_V", "y_um", "old_um")]
    values = {one.name: {int: 7 + i, float: 0.5 + i}[get_type_hints(Hold)[one.name]] for i, one in enumerate(plain)}
    one = replace(hold, **values)
    two = load(Hold, save(one))
    for field in fields(Hold):
        if field.name != "reckoning":
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name), err_msg=field.name)
    np.testing.assert_array_equal(one.reckoning.numbers, two.reckoning.numbers)


def assert_goes_on(one: Learner, recording: Recording, start: int, stop: int) -> None:
    """A learner from its state does the same as the learner itself, to the last bit."""
    two = Learner.from_state(one.state_dict())
    assert two.trouble == one.trouble
    assert feed(one, recording, start, stop) == feed(two, recording, start, stop)
    assert one.counters() == two.counters()
    assert one.features == two.features
    assert one.trouble == two.trouble
    np.testing.assert_array_equal(one.memory(), two.memory())
    for name, value in one.snapshot().state_dict().items():
        np.testing.assert_array_equal(two.snapshot().state_dict()[name], value, err_msg=name)


# --- Readings that surprise: long glitches are bridged, real jumps believed, and a jump that was none is undone.

DT, AT = 1e-3, 2500
PERSISTENCE = AdmissionConfig().glitch_persistence


def feed_readings(learner: Learner, u: FloatArray, y: FloatArray, start: int, stop: int) -> list[str]:
    return [learner.handle(Sample(k, k * DT, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def before_glitch(model: LssvmInverse, recording: Recording) -> dict[str, object]:
    """State of a learner that has seen everything up to the first wrong reading."""
    learner = Learner.from_model(model)
    feed_readings(learner, *recording, 0, AT)
    return learner.state_dict()


@pytest.mark.parametrize("count", [1, 2, 5, PERSISTENCE])
@pytest.mark.parametrize("size_um", [0.5, -2.0, 6.0, -40.0])
def test_a_run_of_wrong_readings_is_bridged(
    before_glitch: dict[str, object], recording: Recording, count: int, size_um: float
) -> None:
    """Frame and estimate stay, and what was bridged is where the stage really was."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + count] += size_um
    learner, twin = Learner.from_state(before_glitch), Learner.from_state(before_glitch)
    outcomes = feed_readings(learner, u, y, AT, AT + 80)
    feed_readings(twin, u, clean, AT, AT + 80)
    assert outcomes[:count] == [GLITCH] * count
    assert learner.counters()["jumps"] == 0
    assert learner.features == twin.features
    motion = np.linspace(10.0, 70.0, 50)
    still = np.zeros(50)
    answers = [each.snapshot().feedforward(motion, still, still, twin.memory()).u_V for each in (learner, twin)]
    assert np.max(np.abs(answers[0] - answers[1])) < 5e-4 * learner.base.span_V
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.05)


def test_readings_that_are_none_are_bridged_by_their_voltages(
    before_glitch: dict[str, object], recording: Recording
) -> None:
    """More of them in a row than a gap may be long: no new start, as the voltages are known."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + 12] = math.nan
    y[AT + 5] = 1e6
    learner, twin = Learner.from_state(before_glitch), Learner.from_state(before_glitch)
    restarts = learner.counters()["restarts"]
    outcomes = feed_readings(learner, u, y, AT, AT + 60)
    feed_readings(twin, u, clean, AT, AT + 60)
    assert outcomes[:12] == ["not_finite"] * 5 + ["out_of_range"] + ["not_finite"] * 6
    assert learner.counters()["restarts"] == restarts
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.05)


def test_the_place_goes_on_while_readings_are_none(before_glitch: dict[str, object], recording: Recording) -> None:
    """And not only from the next reading on: what is served meanwhile begins at the place of the stage."""
    u, clean = recording
    y = np.where(np.arange(clean.size) % 2, math.nan, 1e6)
    learner, twin = Learner.from_state(before_glitch), Learner.from_state(before_glitch)
    before = learner.parts.intake.memory_now()
    feed_readings(learner, u, y, AT, AT + 100)
    feed_readings(twin, u, clean, AT, AT + 100)
    after = twin.parts.intake.memory_now()
    assert np.max(np.abs(after - before)) > 1.0
    np.testing.assert_allclose(learner.parts.intake.memory_now(), after, atol=0.1)


@pytest.mark.parametrize("kind", ["gain", "offset", "small offset"])
def test_a_real_jump_is_believed_within_20_ms(
    before_glitch: dict[str, object], recording: Recording, kind: str
) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT:] = 0.94 * clean[AT:] if kind == "gain" else clean[AT:] + (0.4 if kind == "small offset" else 2.0)
    learner = Learner.from_state(before_glitch)
    feed_readings(learner, u, y, AT, AT + 20)
    assert learner.counters()["jumps"] == 1
    frame = learner.features
    now = clean[AT + 19]
    assert frame.offset_um + frame.gain * now == pytest.approx(y[AT + 19], abs=0.1)


def test_a_glitch_longer_than_patience_is_a_jump_and_its_end_another_one_back(
    before_glitch: dict[str, object], recording: Recording
) -> None:
    u, clean = recording
    y = clean.copy()
    count = PERSISTENCE + 15
    y[AT : AT + count] += 3.0
    learner, twin = Learner.from_state(before_glitch), Learner.from_state(before_glitch)
    before = learner.features
    feed_readings(learner, u, y, AT, AT + count)
    assert learner.features != before
    feed_readings(learner, u, y, AT + count, AT + count + 60)
    feed_readings(twin, u, clean, AT, AT + count + 60)
    assert learner.counters()["jumps"] == 2
    after = learner.features
    assert (after.gain, after.offset_um) == pytest.approx((before.gain, before.offset_um), rel=5e-3, abs=0.1)
    np.testing.assert_allclose(learner.memory(), twin.memory(), atol=0.1)


def test_after_a_glitch_the_sensor_is_trusted_less(before_glitch: dict[str, object], recording: Recording) -> None:
    """Where it has just been wrong, more readings are waited for before a jump is believed."""
    u, clean = recording
    y = clean.copy()
    y[AT : AT + 3] += 5.0
    y[AT + 100 :] += 2.0
    learner = Learner.from_state(before_glitch)
    patience = AdmissionConfig().doubt_persistence
    feed_readings(learner, u, y, AT, AT + 100 + patience)
    assert learner.counters()["jumps"] == 0
    feed_readings(learner, u, y, AT + 100 + patience, AT + 101 + patience)
    assert learner.counters()["jumps"] == 1


def test_nothing_is_served_or_taught_while_undecided(before_glitch: dict[str, object], recording: Recording) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT:] *= 0.94
    learner = Learner.from_state(before_glitch)
    served, updates = learner.snapshot(), learner.parts.filter.state.updates
    feed_readings(learner, u, y, AT, AT + PERSISTENCE)
    assert learner.snapshot() is served
    assert learner.parts.filter.state.updates == updates


@pytest.mark.parametrize("at", [3, PERSISTENCE + 4, PERSISTENCE + 40])
def test_state_goes_on_to_the_last_bit_while_held_and_on_probation(
    before_glitch: dict[str, object], recording: Recording, at: int
) -> None:
    u, clean = recording
    y = clean.copy()
    y[AT + 1] = math.nan
    y[AT : AT + PERSISTENCE + 50] += 3.0
    one = Learner.from_state(before_glitch)
    feed_readings(one, u, y, AT, AT + at)
    two = Learner.from_state(one.state_dict())
    stop = AT + 300
    assert feed_readings(one, u, y, AT + at, stop) == feed_readings(two, u, y, AT + at, stop)
    assert one.counters() == two.counters()
    np.testing.assert_array_equal(one.memory(), two.memory())
    np.testing.assert_array_equal(one.snapshot().beta, two.snapshot().beta)
    assert one.features == two.features


def test_patience_is_configurable(model: LssvmInverse, recording: Recording) -> None:
    u, y = recording[0], recording[1].copy()
    y[AT:] += 2.0
    learner = Learner.from_model(model, LearnerConfig(admission=AdmissionConfig(glitch_persistence=30)))
    feed_readings(learner, u, y, 0, AT + 30)
    assert learner.counters()["jumps"] == 0
    feed_readings(learner, u, y, AT + 30, AT + 31)
    assert learner.counters()["jumps"] == 1


# --- The level under ringing: exact without noise, with stated error rates in noise; and how one thing follows another.
#
# The rates are those of one look at a fixed number of readings, by the rule of ``adaptive.online.glitch_or_jump``.
# What comes of looking again with each reading is in ``test_hypotheses.py``.

#: Deviation of a reading, and the distance that is usual, in it: as a sensor's with the default limits.
NOISE = 1.0
USUAL = AdmissionConfig().surprise_sigma * NOISE
#: Sizes of the windows that are looked at: those of the hypotheses, and the longest.
SIZES = (*reversed(WINDOWS), 64)
RATES_Hz = (500.0, 1000.0, 2000.0)


class Rates(NamedTuple):
    """Shares of the cases in which a level is known, is decided to be another one, and is near to the true one."""

    known: float
    decided: float
    found: float


def ringing(
    n: int, rate_Hz: float, mode_Hz: float, damping: float, amplitude: float = 1.0, phase: float = 0.0
) -> FloatArray:
    """(n,) readings of a damped mode that was struck."""
    t_s = np.arange(n) / rate_Hz
    omega = 2.0 * math.pi * mode_Hz
    swing: FloatArray = np.cos(omega * math.sqrt(1.0 - damping * damping) * t_s + phase)
    return amplitude * np.exp(-damping * omega * t_s) * swing


def known(level: Level) -> bool:
    """As ``hypotheses._known``: the deviation is small beside the level, or beside what is usual."""
    return level.std <= max(LEVEL_STD * abs(level.at), USUAL_STD * USUAL)


def decided(level: Level) -> bool:
    """Whether the level is another one than the old one, beyond doubt."""
    return known(level) and abs(level.at) - USUAL > SIGMA * level.std


def rates(step: float, amplitude: float, n: int, cases: int = 2000, modes: int = 1) -> Rates:
    """Of readings at a level ``step`` with modes from 5 to 45 % of the sample rate ringing on it, in noise."""
    rng = np.random.default_rng([n, int(amplitude), int(abs(step)), modes])
    hits = np.zeros(3)
    for _ in range(cases):
        r = step + NOISE * rng.standard_normal(n)
        for i in range(modes if amplitude else 0):
            damping = math.exp(rng.uniform(math.log(0.005), math.log(0.1)))
            size = amplitude * rng.uniform(0.3, 1.0) * 0.3**i
            r += ringing(n, 1.0, rng.uniform(0.05, 0.45), damping, size, rng.uniform(0.0, 2.0 * math.pi))
        level = level_of(r, NOISE)
        near = abs(level.at - step) < 0.1 * abs(step)
        hits += known(level), decided(level), decided(level) and near
    return Rates(*(hits / cases))


# ---- exact


@pytest.mark.parametrize("value", [0.0, 0.3, -40.0, 1e6])
@pytest.mark.parametrize("n", [6, 7, 16, 64])
def test_the_level_of_a_constant_is_the_constant_and_knows_what_noise_leaves(value: float, n: int) -> None:
    level = level_of(np.full(n, value), 0.01)
    assert level.at == pytest.approx(value, rel=1e-9, abs=1e-9)
    assert level.std == pytest.approx(0.01 / math.sqrt(n), rel=1e-3)
    assert level.order == 0


@pytest.mark.parametrize("rate_Hz", RATES_Hz)
@pytest.mark.parametrize("damping", [0.0, 0.005, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("n", [12, 16, 28, 64])
def test_ringing_is_no_level_at_whatever_frequency_and_damping(rate_Hz: float, damping: float, n: int) -> None:
    """A swing that is ten times as large as the level does not move it."""
    for mode_Hz in np.linspace(0.05, 0.48, 12) * rate_Hz:
        for phase in (0.0, 1.0, 2.0):
            level = level_of(0.7 + ringing(n, rate_Hz, mode_Hz, damping, 7.0, phase), 1e-9)
            assert level.at == pytest.approx(0.7, abs=1e-8)
            assert level.std < 1e-7
            assert level.order >= 2


def test_two_modes_need_four_coefficients_and_are_no_level_either() -> None:
    r = -2.0 + ringing(40, 1000.0, 140.0, 0.02, 5.0, 1.0) + ringing(40, 1000.0, 390.0, 0.01, 2.0, 2.0)
    level = level_of(r, 1e-6)
    assert level.at == pytest.approx(-2.0, abs=1e-5)
    assert level.order == 4


def test_what_goes_on_and_on_has_no_level() -> None:
    """A recursion that forgets nothing settles nowhere: a ramp, a walk, and a swing too slow for the readings."""
    ramp = level_of(np.arange(30.0), 1e-3)
    assert math.isnan(ramp.at)
    assert math.isinf(ramp.std)
    slow = level_of(ringing(30, 1000.0, 20.0, 0.0), 1e-9)
    assert 2.0 - 2.0 * math.cos(2.0 * math.pi * 0.02) < NO_LEVEL
    assert math.isinf(slow.std)
    # A walk by chance stays about a place now and then; it is never known to within a step of it.
    for seed in range(200):
        walk = level_of(np.cumsum(np.random.default_rng(seed).standard_normal(40)), 1e-3)
        assert walk.std > 0.15


def test_fewer_than_six_values_have_no_level() -> None:
    for n in range(6):
        level = level_of(np.full(n, 3.0), 1.0)
        assert math.isnan(level.at)
        assert math.isinf(level.std)
        assert math.isinf(level.residual)
    assert level_of(np.full(6, 3.0), 1.0).at == pytest.approx(3.0)


def test_the_unit_of_the_readings_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    r = 20.0 + ringing(28, 1000.0, 220.0, 0.02, 30.0) + rng.standard_normal(28)
    one = level_of(r, 1.0)
    for unit in (1e-3, 20.0):
        other = level_of(unit * r, unit)
        assert other.order == one.order
        told = (other.at, other.std, other.residual)
        assert told == pytest.approx([unit * value for value in (one.at, one.std, one.residual)], rel=1e-4)


def test_noise_makes_no_order_of_its_own_and_the_deviation_is_honest() -> None:
    """Readings at one level in noise: hardly ever coefficients of ringing, and as far off as is stated."""
    rng = np.random.default_rng(11)
    levels = [level_of(5.0 + rng.standard_normal(28), 1.0) for _ in range(2000)]
    assert np.mean([level.order == 0 for level in levels]) > 0.95
    off = np.array([(level.at - 5.0) / level.std for level in levels])
    assert 0.9 < off.std() < 1.2
    assert np.abs(off).max() < SIGMA


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("amplitude", [5.0, 30.0, 300.0])
def test_under_ringing_the_level_is_off_by_little_more_than_is_stated(amplitude: float, n: int) -> None:
    """Noise is in what the recursion goes by too: measured 1.2 to 1.5 stated deviations, beyond five in 0.9 %."""
    rng = np.random.default_rng([n, int(amplitude)])
    off = []
    for _ in range(1000):
        damping = math.exp(rng.uniform(math.log(0.005), math.log(0.1)))
        swing = ringing(n, 1.0, rng.uniform(0.1, 0.4), damping, amplitude, rng.uniform(0.0, 2.0 * math.pi))
        level = level_of(60.0 + swing + rng.standard_normal(n), NOISE)
        off.append((level.at - 60.0) / level.std if known(level) else 0.0)
    assert 1.0 < np.std(off) < 1.7
    assert np.mean(np.abs(off) > SIGMA) < 0.012


# ---- error rates


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("amplitude", [30.0, 100.0, 300.0])
def test_a_knock_is_hardly_ever_another_level(amplitude: float, n: int) -> None:
    """Below 0.5 % of the cases, at swings of 0.5 to 5 % of the range; measured 0 of 2000 at all sizes."""
    got = rates(0.0, amplitude, n)
    assert got.decided < 0.005
    assert got.known > 0.97


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("amplitude", [30.0, 100.0, 300.0])
@pytest.mark.parametrize("step", [60.0, -300.0])
def test_a_step_is_found_under_its_ringing(step: float, amplitude: float, n: int) -> None:
    """Within 0.1 of it in at least 97 % of the cases, also where the swing is five times as large."""
    assert rates(step, amplitude, n).found >= 0.97


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("step", [25.0, -60.0, 300.0])
def test_a_plain_step_is_found_always(step: float, n: int) -> None:
    """But for one of twice what is usual, of which one in 2000 looks at 16 readings sees ringing that is not there."""
    got = rates(step, 0.0, n)
    assert got.found == got.decided
    assert got.found >= (0.999 if n == min(SIZES) and abs(step) < 2.5 * USUAL else 1.0)


@pytest.mark.parametrize("n", SIZES)
def test_two_modes_are_hardly_ever_another_level(n: int) -> None:
    """Fewer readings than four coefficients need do not know the level, and say so."""
    assert rates(0.0, 100.0, n, modes=2).decided < 0.005


@pytest.mark.parametrize("n", SIZES)
def test_what_is_usual_is_no_level(n: int) -> None:
    """A distance that is no surprise, in noise: nothing is ever decided."""
    assert rates(0.9 * USUAL, 0.0, n).decided == 0.0
