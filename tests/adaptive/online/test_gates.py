"""Gates of the samples, and the envelope of what may be learnt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import AdmissionConfig, AdmissionState, EnvelopeConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.online.sensor_trust import OUT_OF_ENVELOPE, SENSOR_GAIN
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import FloatArray, Sample, StateDict
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

# --- Each gate refuses what it is for, lets the rest through, and never raises on data.

DT = 1e-3
CONFIG = AdmissionConfig(u_min_V=0.0, u_max_V=8.0, y_min_um=-1.0, y_max_um=90.0)


def state(**changes: float) -> AdmissionState:
    made = AdmissionState(seq=10, t_s=0.010, since_start=1000)
    for name, value in changes.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize(
    ("sample", "outcome"),
    [
        (Sample(11, 0.011, 1.0, 5.0), ""),
        (Sample(13, 0.013, 1.0, 5.0), ""),
        (Sample(11, 0.0112, 1.0, 5.0), ""),
        (Sample(11, 0.011, math.nan, 5.0), gates.NOT_FINITE),
        (Sample(11, 0.011, 1.0, math.inf), gates.NOT_FINITE),
        (Sample(11, math.nan, 1.0, 5.0), gates.NOT_FINITE),
        (Sample(11, 0.011, 1.0, 1e300), gates.NOT_FINITE),
        (Sample(10, 0.010, 1.0, 5.0), gates.DUPLICATE),
        (Sample(9, 0.009, 1.0, 5.0), gates.OUT_OF_ORDER),
        (Sample(11, 0.013, 1.0, 5.0), gates.TIMING),
        (Sample(11, 0.010, 1.0, 5.0), gates.TIMING),
    ],
)
def test_raw_samples(sample: Sample, outcome: str) -> None:
    assert gates.check_sample(CONFIG, state(), sample, DT) == outcome


def test_the_first_sample_may_have_any_number() -> None:
    assert gates.check_sample(CONFIG, AdmissionState(), Sample(77, 12.0, 1.0, 5.0), DT) == ""


@pytest.mark.parametrize(
    ("pair", "outcome"),
    [
        ((4.0, 4.0, 40.0), ""),
        ((8.0, 7.9, 80.0), gates.SATURATED),
        ((7.9, 8.0, 80.0), gates.SATURATED),
        ((0.0, 0.1, 0.0), gates.SATURATED),
        ((4.0, 4.0, 95.0), gates.OUT_OF_RANGE),
    ],
)
def test_pairs(pair: tuple[float, float, float], outcome: str) -> None:
    assert gates.check_pair(CONFIG, *pair) == outcome


def test_what_is_usual_is_no_surprise() -> None:
    s = state()
    limit = gates.surprise(CONFIG, s, 8.0)
    assert limit == CONFIG.surprise_share
    for _ in range(3000):
        gates.watch_innovation(CONFIG, s, 0.0005)
    assert gates.surprise(CONFIG, s, 8.0) == pytest.approx(CONFIG.surprise_sigma * 0.0005, rel=0.02)
    for _ in range(20_000):
        gates.watch_innovation(CONFIG, s, 0.05)
    # However large: where the smoother is wrong again and again, the motion is so fast, and nothing is a glitch.
    assert gates.surprise(CONFIG, s, 8.0) == pytest.approx(CONFIG.surprise_sigma * 0.05, rel=0.02)


def test_glitches_hardly_raise_what_is_usual() -> None:
    """One reading in ten is off by a tenth of the range: predictions are as good as they were."""
    s = state()
    for k in range(5000):
        gates.watch_innovation(CONFIG, s, 0.1 if k % 10 == 0 else 0.0002)
    assert gates.surprise(CONFIG, s, 8.0) < 0.3 * CONFIG.glitch_share


def test_a_slow_sample_rate_widens_what_is_no_surprise() -> None:
    for dt_s, factor in ((1e-4, 1.0), (1e-3, 1.0), (5e-3, 5.0)):
        assert CONFIG.at(dt_s).surprise_share == pytest.approx(factor * CONFIG.surprise_share)
        assert CONFIG.at(dt_s).glitch_share == pytest.approx(factor * CONFIG.glitch_share)


def test_a_commanded_step_is_no_surprise_and_stops_no_learning() -> None:
    s = state(u_V=4.0, u_before_V=4.0)
    before = gates.surprise(CONFIG, s, 8.0)
    gates.watch_voltage(s, 4.5)
    assert gates.surprise(CONFIG, s, 8.0) > before + 0.5 / 8.0
    assert not gates.settling(CONFIG, s)
    for _ in range(100):
        gates.watch_voltage(s, 4.5)
    assert gates.surprise(CONFIG, s, 8.0) == pytest.approx(before, rel=1e-2)


def test_a_small_kink_of_the_voltage_widens_the_limit_for_a_while() -> None:
    s = state(u_V=4.0, u_before_V=4.0)
    gates.watch_voltage(s, 4.016)
    assert not gates.settling(CONFIG, s)
    limits = []
    for _ in range(40):
        limits.append(gates.surprise(CONFIG, s, 8.0))
        gates.watch_voltage(s, 4.016)
    assert limits[0] == pytest.approx(CONFIG.surprise_share + gates.KINK_SHARE * 0.002)
    assert limits[-1] < 1.05 * CONFIG.surprise_share


@given(st.integers(), st.floats(), st.floats(), st.floats())
def test_never_raises_on_data(seq: int, t: float, u: float, y: float) -> None:
    assert gates.check_sample(CONFIG, state(), Sample(seq, t, u, y), DT) in ("", *gates.REASONS)


def test_state_round_trip() -> None:
    s = state(since_glitch=2, u_V=1.25)
    assert load(AdmissionState, save(s)) == s


@pytest.mark.parametrize(
    "bad", [{"u_min_V": 9.0}, {"y_min_um": 99.0}, {"glitch_share": 0.0}, {"settle": -1}, {"timing_tolerance": -0.1}]
)
def test_bad_configuration_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        AdmissionConfig(**{"u_max_V": 8.0, "y_max_um": 90.0, **bad})  # type: ignore[arg-type]


# --- What a stage can become, and nothing beyond: bounds of what is believed, and the way back to the identified model.

DT_S = 1e-3
Recording = tuple[FloatArray, FloatArray]
#: Limits of the drive, V, and when the voltage reaches the upper one, stays there, and leaves it, s.
LOW_V, HIGH_V, REACHED_S, LEFT_S = -1.0, 7.0, 3.0, 4.0
AT = 2500


def range_of(model: LssvmInverse) -> float:
    return model.features.y_max_um - model.features.y_min_um


def feed(learner: Learner, recording: Recording, start: int, stop: int) -> list[str]:
    u, y = recording
    return [learner.handle(Sample(k, k * DT_S, float(u[k]), float(y[k]))) for k in range(start, stop)]


@pytest.fixture(scope="module")
def railed() -> Recording:
    """(u_V, y_um) of 6 s: strokes, a second at the upper limit of the drive, and strokes again."""
    stage = Stage(preset("rich", seed=5))
    t_s = np.arange(6000) * DT_S
    stroke = np.minimum(t_s / 0.5, 1.0) * (4.0 - 2.5 * np.cos(2.0 * np.pi * t_s))
    way = np.interp(t_s, (REACHED_S - 0.2, REACHED_S, LEFT_S, LEFT_S + 0.2), (0.0, 1.0, 1.0, 0.0))
    u = stroke + way * (HIGH_V - stroke)
    u[(t_s >= REACHED_S) & (t_s <= LEFT_S)] = HIGH_V
    return u, stage.run(stage.initial_state(), u)[0]


@pytest.fixture(scope="module")
def warm(model: LssvmInverse, all_strokes: Recording) -> StateDict:
    learner = Learner.from_model(model)
    feed(learner, all_strokes, 0, AT)
    return learner.state_dict()


def limited(**changes: float) -> LearnerConfig:
    """With the limits of the drive."""
    admission = AdmissionConfig(u_min_V=LOW_V, u_max_V=HIGH_V)
    return LearnerConfig(admission=admission, envelope=EnvelopeConfig(**changes))


# ---- the bounds


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("gain", (1.0, 0.9, 0.0, -2.0, math.nan, math.inf), "a factor above 1"),
        *((name, (0.0, -1.0, math.nan, math.inf), "a positive finite number")
          for name in ("offset", "shape", "jump", "drift_per_s", "follow_s")),
    ],
)  # fmt: skip
def test_what_is_no_bound_is_refused_by_name(name: str, values: tuple[float, ...], expected: str) -> None:
    for value in values:
        with pytest.raises(InputError, match=rf"envelope\.{name}: got .*, expected {expected}"):
            EnvelopeConfig(**{name: value})
    assert EnvelopeConfig(**{name: 1.5})


@pytest.mark.parametrize("base_gain", [1.0, 0.4])
def test_a_frame_is_inside_up_to_its_bounds_and_not_beyond(model: LssvmInverse, base_gain: float) -> None:
    """Gain about the identified one, and the reading where the identified stage rests, as a share of the range."""
    envelope, span_um = EnvelopeConfig(gain=1.25, offset=0.2), range_of(model)
    base = replace(model.features, gain=base_gain, offset_um=3.0, y_rest_um=20.0)
    rest_um = base.offset_um + base_gain * base.y_rest_um

    def frame(gain: float, shift: float) -> FeatureMap:
        """That shows the stage's rest at a shift from where it was, as a share of the range."""
        return replace(
            base, gain=gain * base_gain, offset_um=rest_um + shift * span_um - gain * base_gain * base.y_rest_um
        )

    for gain, shift in ((1.0, 0.0), (1.249, 0.0), (0.801, 0.0), (1.0, 0.199), (1.0, -0.199), (1.249, -0.199)):
        assert envelope.refuses(base, frame(gain, shift)) == ""
    assert "gain 1.251 of the identified, allowed 0.800 to 1.250" in envelope.refuses(base, frame(1.251, 0.0))
    assert "gain 0.799" in envelope.refuses(base, frame(0.799, 0.0))
    for shift in (0.201, -0.201):
        told = envelope.refuses(base, frame(1.0, shift))
        assert told == f"zero moved by {shift * span_um:.3g} µm, allowed {0.2 * span_um:.3g} µm"


def test_a_gain_of_readings_is_allowed_by_the_same_factor_both_ways() -> None:
    envelope = EnvelopeConfig(gain=1.25)
    assert [envelope.gain_allows(gain) for gain in (0.79, 0.81, 1.0, 1.24, 1.26, -1.0, math.nan)] == [
        False, True, True, True, False, False, False,
    ]  # fmt: skip


# ---- through the learner


@pytest.mark.parametrize("shift", [0.4, -0.4])
def test_a_zero_that_has_moved_further_than_a_stage_can_is_not_believed(
    model: LssvmInverse, all_strokes: Recording, warm: StateDict, shift: float
) -> None:
    """By 40 % of the range: it has its name within half a second, no frame moves, and what is served stays."""
    u, y = all_strokes[0], all_strokes[1].copy()
    y[AT:] += shift * range_of(model)
    learner = Learner.from_state(warm)
    frame, beta = learner.features, learner.parts.filter.beta
    feed(learner, (u, y), AT, AT + 500)
    assert learner.trouble == OUT_OF_ENVELOPE
    for k in range(AT + 500, AT + 2500):
        feed(learner, (u, y), k, k + 1)
        assert learner.trouble == OUT_OF_ENVELOPE
    assert learner.features == frame
    assert np.abs(learner.parts.filter.beta - beta).max() < 0.01 * np.abs(beta).max()
    assert not learner.snapshot().valid
    # The sensor is right again: so is the learner.
    feed(learner, all_strokes, AT + 2500, AT + 3300)
    assert learner.trouble == ""
    assert learner.features == frame


@pytest.mark.parametrize(("shift", "offset"), [(0.4, 0.5), (-0.25, 0.3)])
def test_a_zero_that_has_moved_as_far_as_a_stage_can_is_believed_after_motion(
    model: LssvmInverse, all_strokes: Recording, shift: float, offset: float
) -> None:
    """The same, in an envelope that is wide enough."""
    u, y = all_strokes[0], all_strokes[1].copy()
    y[AT:] += shift * range_of(model)
    learner = Learner.from_model(model, LearnerConfig(envelope=EnvelopeConfig(offset=offset)))
    feed(learner, (u, y), 0, AT + 700)
    assert learner.trouble == ""
    assert learner.features.offset_um == pytest.approx(shift * range_of(model), abs=0.02 * range_of(model))
    feed(learner, (u, y), AT + 700, AT + 1500)
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.5


@pytest.mark.parametrize(("gain", "name"), [(1.3, ""), (0.77, ""), (1.6, SENSOR_GAIN), (0.6, SENSOR_GAIN)])
def test_a_gain_is_believed_as_far_as_a_stage_can_have_it(
    model: LssvmInverse, all_strokes: Recording, warm: StateDict, gain: float, name: str
) -> None:
    u, y = all_strokes[0], all_strokes[1].copy()
    y[AT:] *= gain
    learner = Learner.from_state(warm)
    feed(learner, (u, y), AT, AT + 600)
    assert learner.trouble == name
    inside = learner.config.envelope.refuses(model.features, learner.features) == ""
    assert inside
    if name:
        assert learner.features.gain == pytest.approx(1.0, abs=0.02)


def test_whatever_the_readings_claim_no_frame_is_outside(model: LssvmInverse, all_strokes: Recording) -> None:
    """Jump after jump in the same direction, each small enough to be believed: the sum is not."""
    u, y = all_strokes[0], all_strokes[1].copy()
    learner, told = Learner.from_model(model), set()
    for i in range(12):
        y[1500 + 350 * i :] += 0.06 * range_of(model)
    for k in range(u.size):
        feed(learner, (u, y), k, k + 1)
        told.add(learner.trouble)
        assert learner.config.envelope.refuses(model.features, learner.features) == ""
    assert learner.counters()["jumps"] >= 3
    assert told > {""}


def test_no_answer_is_further_from_the_identified_model_than_the_bound(
    model: LssvmInverse, all_strokes: Recording
) -> None:
    """Whatever the filter has come to: all over the range, in rest and in motion."""
    learner = Learner.from_model(model)
    feed(learner, all_strokes, 0, 1500)
    memory = learner.memory()
    y_um = np.linspace(0.0, range_of(model), 60)
    motion = y_um, 50.0 * np.cos(y_um), 3000.0 * np.sin(y_um)
    basis = model.features.run(*motion, memory)[0]
    rng = np.random.default_rng(1)
    for _ in range(20):
        size = 10.0 ** rng.uniform(-1.0, 3.0)
        learner.parts.filter.restore((size * rng.standard_normal(model.beta.size), learner.parts.filter.mark()[1]))
        learner._cache = None
        u_V = learner.snapshot().feedforward(*motion, memory).u_V
        away_V = np.abs(u_V - basis @ model.beta)
        assert away_V.max() <= learner.parts.allowed_V * (1.0 + 1e-9)


# ---- the way back to the identified model


def shifted(share: float) -> Callable[[Learner], None]:
    """Spoils what was learnt: its constant is off by a share of the voltage span, now and in all that is kept."""

    def spoil(learner: Learner) -> None:
        learner.parts.shift_constant(share * learner.base.span_V)
        learner._cache = None

    return spoil


def doubled(learner: Learner) -> None:
    """Spoils what was learnt: all coefficients twice as large."""
    beta, covariance = learner.parts.filter.mark()
    learner.parts.filter.restore((2.0 * beta, covariance))
    learner._cache = None


def is_identified(learner: Learner) -> bool:
    """Whether what is served asks for the voltages of the identified model, to 1 % of the span."""
    served, base = learner.snapshot(), learner.base
    y_um = np.linspace(0.0, 85.0, 40)
    still, memory = np.zeros(40), base.rest_memory(0.0)
    off_V = served.feedforward(y_um, still, still, memory).u_V - base.feedforward(y_um, still, still, memory).u_V
    return bool(np.abs(off_V).max() < 0.01 * base.span_V and served.features == base.features)


@pytest.mark.parametrize("spoil", [shifted(0.6), shifted(-0.6), doubled])
def test_a_spoilt_model_is_not_served_while_the_voltage_is_at_a_limit(
    model: LssvmInverse, railed: Recording, spoil: Callable[[Learner], None]
) -> None:
    """Within 0.3 s the identified one is, although nothing is learnt there; afterwards learning goes on."""
    learner = Learner.from_model(model, limited())
    at, left = round(REACHED_S / DT_S) + 100, round(LEFT_S / DT_S)
    feed(learner, railed, 0, at)
    spoil(learner)
    feed(learner, railed, at, at + 300)
    assert is_identified(learner)
    said = feed(learner, railed, at + 300, left + 1000)
    assert learner.trouble == ""
    assert said[-200:].count("learnt") > 90
    assert learner.diagnostics()["recent_rms_error_pct"] < 1.0


def test_a_voltage_at_a_limit_by_the_reference_is_no_trouble(model: LssvmInverse, railed: Recording) -> None:
    """A second of it; it teaches nothing, but the stage goes on being followed."""
    learner = Learner.from_model(model, limited())
    said = []
    for k in range(6000):
        said += feed(learner, railed, k, k + 1)
        assert learner.trouble == ""
    part = slice(round(REACHED_S / DT_S) + 100, round(LEFT_S / DT_S))
    assert set(said[part]) == {"saturated"}
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.3


@pytest.mark.parametrize("spoil", [shifted(0.6), shifted(-0.6)])
def test_a_spoilt_model_is_not_served_although_learning_is_stopped(
    all_strokes: Recording, warm: StateDict, spoil: Callable[[Learner], None]
) -> None:
    """Within 0.3 s the identified one is; the filter then learns again, although the good estimates are spoilt too."""
    learner = Learner.from_state(warm)
    learner.freeze()
    spoil(learner)
    feed(learner, all_strokes, AT, AT + 300)
    assert is_identified(learner)
    learner.thaw()
    feed(learner, all_strokes, AT + 300, AT + 2300)
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.5


@pytest.mark.parametrize(("gain", "shift"), [(0.2, 0.0), (-0.15, 0.0), (0.1, 0.1), (0.0, -0.2)])
def test_what_is_learnt_of_a_stage_that_changes_much_is_no_trouble(
    model: LssvmInverse, all_strokes: Recording, warm: StateDict, gain: float, shift: float
) -> None:
    """A gain that grows by a fifth within two seconds, a zero that moves by a fifth: inside, and learnt."""
    u, clean = all_strokes
    grown = np.clip((np.arange(clean.size) - AT) / 2000.0, 0.0, 1.0)
    y = clean * (1.0 + gain * grown) + shift * range_of(model) * grown
    learner = Learner.from_state(warm)
    for k in range(AT, clean.size):
        feed(learner, (u, y), k, k + 1)
        assert learner.trouble == ""
    assert learner.diagnostics()["recent_rms_error_pct"] < 1.0


# ---- kept


def test_configuration_and_envelope_go_there_and_back() -> None:
    config = LearnerConfig(
        window=77, envelope=EnvelopeConfig(gain=1.2, offset=0.1, shape=0.5, jump=0.05, drift_per_s=0.3, follow_s=0.4)
    )
    state = config.state_dict()
    assert LearnerConfig.from_state(state) == config
    flat = {name.removeprefix("envelope."): state[name] for name in state if name.startswith("envelope.")}
    assert flat == asdict(config.envelope)
    # Settings from before there was an envelope have its defaults.
    old = {name: value for name, value in state.items() if not name.startswith("envelope.")}
    assert LearnerConfig.from_state(old) == replace(config, envelope=EnvelopeConfig())
