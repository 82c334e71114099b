"""Each gate refuses what it is for, lets the rest through, and never raises on data."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive.errors import InputError
from adaptive.online import gates
from adaptive.online.gates import AdmissionConfig, AdmissionState
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


def test_what_is_usual_is_no_surprise() -> None:
    s = state()
    limit = gates.surprise(CONFIG, s, 8.0)
    assert limit == CONFIG.surprise_share
    for _ in range(3000):
        gates.watch_innovation(CONFIG, s, 0.0005)
    assert gates.surprise(CONFIG, s, 8.0) == pytest.approx(CONFIG.surprise_sigma * 0.0005, rel=0.02)
    for _ in range(20_000):
        gates.watch_innovation(CONFIG, s, 0.5)
    assert gates.surprise(CONFIG, s, 8.0) == CONFIG.glitch_share


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


def test_a_commanded_step_is_no_surprise() -> None:
    s = state(u_V=4.0, u_before_V=4.0)
    gates.watch_voltage(CONFIG, s, 4.001, 8.0)
    assert not gates.settling(CONFIG, s)
    gates.watch_voltage(CONFIG, s, 4.5, 8.0)
    assert gates.settling(CONFIG, s)
    for _ in range(CONFIG.settle + 2):
        gates.watch_voltage(CONFIG, s, 4.5, 8.0)
    assert not gates.settling(CONFIG, s)


def test_a_small_kink_of_the_voltage_widens_the_limit_for_a_while() -> None:
    s = state(u_V=4.0, u_before_V=4.0)
    gates.watch_voltage(CONFIG, s, 4.016, 8.0)
    assert not gates.settling(CONFIG, s)
    limits = []
    for _ in range(40):
        limits.append(gates.surprise(CONFIG, s, 8.0))
        gates.watch_voltage(CONFIG, s, 4.016, 8.0)
    assert limits[0] == pytest.approx(CONFIG.surprise_share + gates.KINK_SHARE * 0.002)
    assert limits[-1] < 1.05 * CONFIG.surprise_share


@given(st.integers(), st.floats(), st.floats(), st.floats())
def test_never_raises_on_data(seq: int, t: float, u: float, y: float) -> None:
    assert gates.check_sample(CONFIG, state(), Sample(seq, t, u, y), DT) in ("", *gates.REASONS)


def test_state_round_trip_and_counters() -> None:
    s = state(since_glitch=2, u_V=1.25)
    assert AdmissionState.from_state(s.state_dict()) == s
    assert set(gates.new_counters()) == {gates.LEARNT, gates.PASSED, *gates.REASONS}


@pytest.mark.parametrize(
    "bad", [{"u_min_V": 9.0}, {"y_min_um": 99.0}, {"glitch_share": 0.0}, {"settle": -1}, {"timing_tolerance": -0.1}]
)
def test_bad_configuration_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        AdmissionConfig(**{"u_max_V": 8.0, "y_max_um": 90.0, **bad})  # type: ignore[arg-type]
