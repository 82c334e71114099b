"""Each gate refuses what it is for, lets the rest through, and never raises on data."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive import admission as gates
from adaptive.admission import AdmissionConfig, AdmissionState
from adaptive.errors import InputError
from adaptive.types import Sample

DT = 1e-3
CONFIG = AdmissionConfig(u_min_V=0.0, u_max_V=8.0, y_min_um=-1.0, y_max_um=90.0)


def state(**changes: float) -> AdmissionState:
    made = AdmissionState(seq=10, t_s=0.010, since_start=1000, since_jump=1000, since_step=1000)
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


def test_a_glitch_is_skipped_and_a_persistent_one_believed() -> None:
    s = state()
    got = [gates.check_reading(CONFIG, s, 0.05) for _ in range(CONFIG.glitch_persistence + 1)]
    assert got == [gates.GLITCH] * CONFIG.glitch_persistence + [gates.GAP]
    assert gates.check_reading(CONFIG, s, 0.05) == gates.GLITCH
    assert gates.check_reading(CONFIG, s, 0.0) == ""
    assert s.glitches == 0


def test_a_slow_sample_rate_widens_what_is_no_glitch() -> None:
    for dt_s, outcome in ((1e-4, gates.GLITCH), (1e-3, gates.GLITCH), (5e-3, "")):
        assert gates.check_reading(CONFIG.at(dt_s), state(), 0.05) == outcome


def test_a_commanded_step_is_no_glitch() -> None:
    s = state(u_V=4.0, u_before_V=4.0)
    gates.watch_voltage(CONFIG, s, 4.001, 8.0)
    assert gates.check_reading(CONFIG, s, 0.05) == gates.GLITCH
    gates.watch_voltage(CONFIG, s, 4.5, 8.0)
    assert gates.check_reading(CONFIG, s, 0.05) == ""
    for _ in range(CONFIG.settle + 2):
        gates.watch_voltage(CONFIG, s, 4.5, 8.0)
    assert gates.check_reading(CONFIG, s, 0.05) == gates.GLITCH


@given(st.integers(), st.floats(), st.floats(), st.floats())
def test_never_raises_on_data(seq: int, t: float, u: float, y: float) -> None:
    assert gates.check_sample(CONFIG, state(), Sample(seq, t, u, y), DT) in ("", *gates.REASONS)


def test_state_round_trip_and_counters() -> None:
    s = state(glitches=2, u_V=1.25)
    assert AdmissionState.from_state(s.state_dict()) == s
    assert set(gates.new_counters()) == {gates.LEARNT, gates.PASSED, *gates.REASONS}


@pytest.mark.parametrize(
    "bad", [{"u_min_V": 9.0}, {"y_min_um": 99.0}, {"glitch_share": 0.0}, {"settle": -1}, {"timing_tolerance": -0.1}]
)
def test_bad_configuration_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        AdmissionConfig(**{"u_max_V": 8.0, "y_max_um": 90.0, **bad})  # type: ignore[arg-type]
