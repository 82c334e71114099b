"""The correction of motion that repeats: its low-pass, its convergence in frequency and in passes, and periods."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from dehyst.adaptive.correction.repetition import (
    GAIN,
    KEPT,
    LAG_ERROR,
    SLOPE_ERROR,
    Design,
    Repetition,
    designs,
    find_period,
    kernel,
    most_lag_s,
)
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray

DT_S = st.sampled_from([1e-4, 2e-4, 5e-4, 1e-3, 2e-3])


# ---- low-pass and design


def design(lag_s: float, mode_Hz: float, dt_s: float) -> Design:
    return next((one for one in designs(mode_Hz, dt_s) if lag_s <= one.most_lag_s), Design(0.0, 0, math.inf))


@given(st.floats(10.0, 300.0), st.floats(0.01, 0.35))
def test_the_low_pass_has_no_phase_about_its_delay_whole_or_not(delay: float, cutoff: float) -> None:
    half = math.ceil(3.0 / cutoff)
    first, weights = kernel(delay, cutoff, half)
    at = first + np.arange(weights.size)
    f = np.linspace(0.0, 0.5 * cutoff, 20)
    response = np.exp(-2j * np.pi * np.outer(f, at - delay)) @ weights
    assert np.abs(response - 1.0).max() < 1e-3
    beyond = np.exp(-2j * np.pi * np.outer(np.linspace(1.4 * cutoff, 0.5, 50), at - delay)) @ weights
    assert np.abs(beyond).max(initial=0.0) < 0.02 or 1.4 * cutoff > 0.5


@given(DT_S, st.floats(0.0, 3e-3), st.floats(40.0, 3000.0), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_at_every_frequency_the_residual_of_any_stage_falls(
    dt_s: float, lag_s: float, mode_Hz: float, seed: int
) -> None:
    """Exact responses of stages that the design is to bear, not the bound that it computes itself."""
    rng = np.random.default_rng(seed)
    cutoff, half, _ = design(lag_s, mode_Hz, dt_s)
    assert cutoff > 0.0
    f = np.linspace(1e-4, 0.5, 3000)
    x = np.arange(-half, half + 1)
    low_pass = np.cos(2.0 * np.pi * np.outer(f, x)) @ kernel(0.0, cutoff, half)[1]
    for _ in range(20):
        slope = 1.0 + SLOPE_ERROR * rng.uniform(-1.0, 1.0)
        late = rng.uniform(-1.0, 1.0) * (0.5 + LAG_ERROR * lag_s / dt_s)
        mode = mode_Hz * dt_s * (1.0 + rng.exponential(0.3))
        damping = 0.01 * (1.0 + rng.exponential(2.0))
        stage = 1.0 / (1.0 - (f / mode) ** 2 + 2j * damping * f / mode)
        response = slope * stage * np.exp(-2j * np.pi * f * late)
        assert np.abs(low_pass * (1.0 - GAIN * response)).max() < 1.0


def test_a_higher_mode_and_a_surer_lag_give_a_higher_cutoff_and_where_none_holds_there_is_none() -> None:
    cutoffs = [design(1e-3, mode_Hz, 1e-3).cutoff for mode_Hz in (50.0, 100.0, 200.0)]
    assert cutoffs == sorted(cutoffs)
    assert cutoffs[2] == pytest.approx(4.0 * cutoffs[0], rel=0.15)
    assert design(5e-3, 400.0, 1e-3).cutoff < design(0.0, 400.0, 1e-3).cutoff
    assert design(10.0, 400.0, 1e-3).cutoff == 0.0
    assert most_lag_s(0.2, 10, 60.0, 1e-3) < 0.0  # a cut-off above the mode


def test_no_low_pass_is_longer_than_what_is_kept() -> None:
    assert not designs(1.0, 1e-5)
    assert all(2 * one.half + 1 < KEPT for one in designs(10.0, 1e-4))


# ---- periods


@given(st.floats(20.0, 900.0), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_period_of_any_motion_is_found_to_the_part_of_a_sample(period: float, seed: int) -> None:
    """A fundamental and some harmonics that a sample still shows, behind a rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(3200.0)
    y = np.zeros(t.size)
    for k in range(1, int(min(6.0, period / 10.0)) + 1):
        y += rng.normal() / k**2 * (1.0 if k > 1 else 0.0) + 0.0
        y += (1.0 if k == 1 else rng.normal() / k**2) * np.sin(2.0 * np.pi * k * t / period + rng.uniform(0.0, 6.0))
    y[:200] = y[200]
    found = find_period(y)
    assert found is not None
    assert found == pytest.approx(period, abs=2e-3 * period / 20.0)


@pytest.mark.parametrize("period", [33.333, 66.6667, 200.0, 533.4])
def test_the_period_of_a_triangle_is_found_after_three_lines(period: float) -> None:
    y = np.abs(np.mod(np.arange(round(3.0 * period)) / period, 1.0) - 0.5)
    assert find_period(y) == pytest.approx(period, rel=2e-4)


def test_a_frame_of_steps_repeats_as_a_whole_and_not_by_its_steps() -> None:
    frame = np.repeat([0.0, 1.0, 2.0, 1.5], 50)
    assert find_period(np.tile(frame, 4)) == pytest.approx(200.0, abs=0.01)


def test_rests_ramps_and_random_motion_have_no_period() -> None:
    t = np.arange(4000.0)
    noise = lfilter([0.01], [1.0, -0.99], np.random.default_rng(3).standard_normal(t.size))
    for y in (np.full(t.size, 3.0), t, t**2, noise):
        assert find_period(np.asarray(y, dtype=np.float64)) is None


# ---- passes on a stage


class Loop:
    """A stage of 2 µm/V, late by one sample and a lag of 1 ms, and a model that is wrong by a disturbance."""

    def __init__(
        self, period: float, age: int = 1, mode_Hz: float = 200.0, state: bool = True, slope: float = 0.5
    ) -> None:
        self.period, self.age, self.slope = period, age, slope
        self.repetition = Repetition(1e-3, mode_Hz, 0.1)
        if state:
            self.repetition.state(period * 1e-3)
        self.u, self.k = 0.0, 0
        self.wanted: list[float] = []
        self.read: list[float] = []
        self.added: list[float] = []

    def wave(self, k: int) -> float:
        return 10.0 * math.sin(2.0 * math.pi * k / self.period)

    def run(
        self,
        passes: float,
        error: float = 0.1,
        noise_um: float = 0.0,
        gain: float = 1.0,
        wave: object = None,
        sensor: object = None,
    ) -> FloatArray:
        """(passes,) mean absolute errors, µm, of each pass; ``error`` : of the model, V, at twice the frequency."""
        rng, errors = np.random.default_rng(1), []
        for _ in range(round(passes * self.period)):
            k = self.k
            at = wave or self.wave  # type: ignore[truthy-function]
            y, before = at(k), at(k - 1)  # type: ignore[operator]
            answer = 0.5 * (y + 2.0 * (y - before)) + error * math.sin(4.0 * math.pi * k / self.period)
            seen = k - self.age
            self.repetition.set(self.age, self.slope, 2e-3, 2.0)
            if seen >= 0:
                self.repetition.read(seen, self.wanted[seen] - self.read[seen])
            added = self.repetition.add(k, y, answer)
            self.repetition.applied(k, answer + added)
            true = self.u
            self.wanted.append(y)
            self.added.append(added)
            reading = true + noise_um * rng.standard_normal()
            self.read.append(sensor(k, reading) if sensor is not None else reading)  # type: ignore[operator]
            errors.append(abs(y - true))
            self.u += (1.0 - math.exp(-1.0)) * (2.0 * gain * (answer + added) - self.u)
            self.k += 1
        n = max(int(passes), 1)
        return np.array([np.mean(part) for part in np.array_split(errors[: round(n * self.period)], n)])


@pytest.mark.parametrize("period", [25.25, 40.0, 66.6667, 200.0])
@pytest.mark.parametrize("age", [1, 5, 20])
def test_what_repeats_is_gone_after_some_passes(period: float, age: int) -> None:
    loop = Loop(period, age)
    errors = loop.run(25)
    assert errors[1] > 0.05
    assert errors[-1] < 0.03 * errors[1]
    assert np.diff(errors[4:]).max() < 0.02 * errors[1]
    assert (loop.repetition.halved, loop.repetition.doubted) == (0, 0)


def test_a_period_is_found_and_used_as_one_that_is_stated() -> None:
    loop = Loop(66.6667, state=False)
    errors = loop.run(25)
    assert loop.repetition.period == pytest.approx(66.6667, abs=0.01)
    assert errors[-1] < 0.03 * errors[1]


def test_noise_that_does_not_repeat_is_averaged_out() -> None:
    loop = Loop(66.6667)
    errors = loop.run(40, error=0.0, noise_um=0.05)
    plain = Loop(66.6667)
    plain.repetition.release()
    alone = Loop(66.6667, state=False).run(1, error=0.0)
    assert loop.repetition.active
    assert errors[-10:].mean() < alone[0] + 0.3 * 0.05


def test_one_wrong_reading_is_not_taken_for_what_repeats() -> None:
    clean, spiked = Loop(66.6667), Loop(66.6667)
    clean.run(12)
    spiked.run(12, sensor=lambda k, y: y + (3.0 if k == 500 else 0.0))
    assert np.abs(np.array(clean.added) - spiked.added).max() < 0.03


def test_lost_readings_freeze_it_and_for_long_they_let_it_go() -> None:
    loop = Loop(200.0)
    loop.run(10)
    before = loop.added[-200:]
    loop.run(1, sensor=lambda k, y: math.nan if k % 3 else y)
    np.testing.assert_allclose(loop.added[-200:], before, atol=5e-3)
    assert loop.repetition.active
    loop.run(1, sensor=lambda k, y: math.nan)
    assert not loop.repetition.active
    assert loop.added[-1] == 0.0


def test_a_stuck_sensor_lets_it_go_within_a_pass_and_teaches_nothing() -> None:
    loop = Loop(200.0)
    loop.run(10)
    stuck = loop.read[-1]
    errors = loop.run(6, sensor=lambda k, y: stuck)
    alone = Loop(200.0).run(2)[1]
    assert errors[0] < alone
    assert errors.max() < 1.5 * alone


def test_another_gain_of_the_stage_lets_it_go_and_it_is_learnt_anew() -> None:
    loop = Loop(66.6667)
    before = loop.run(12)[-1]
    after = loop.run(14, gain=1.06)
    assert loop.repetition.halved >= 1
    assert after[-1] < 0.1 * after[0]
    assert after[-1] < before + 0.02


def test_another_motion_lets_it_go_without_a_step() -> None:
    loop = Loop(66.6667)
    loop.run(12)
    begin, place = loop.k, loop.wave(loop.k)
    loop.run(3, wave=lambda k: place if k >= begin else loop.wave(k))
    assert not loop.repetition.active
    assert loop.added[-1] == 0.0
    added = np.array(loop.added)
    assert np.abs(np.diff(added[begin:])).max() <= 2.0 * np.abs(np.diff(added[begin - 70 : begin])).max()


def test_a_loop_that_grows_is_let_go_with_half_the_gain() -> None:
    """The model's slope has the wrong sign: the residual of each pass is 1.7 times that of the one before."""
    loop = Loop(66.6667, slope=-0.5)
    errors = loop.run(30, error=0.02)
    assert loop.repetition.halved >= 2
    assert errors.max() < 4.0 * errors[1]


def test_growth_is_seen_after_readings_of_the_first_pass_came_late() -> None:
    one = Repetition(1e-3, 200.0, 0.5)
    one.state(0.1)

    def step(k: int, seen: list[int], residual_um: float) -> None:
        one.set(1, 0.5, 2e-3, 2.0)
        for number in seen:
            one.read(number, residual_um * math.sin(4e-2 * math.pi * number))
        y_um = 10.0 * math.sin(2e-2 * math.pi * k)
        one.applied(k, 0.5 * y_um + one.add(k, y_um, 0.5 * y_um))

    k = 0
    while not one.active:
        step(k, [k - 1] if k > 50 else [], 0.05)
        k += 1
    step(k, [*range(3, 50), k - 1], 0.05)
    for later in range(k + 1, k + 150):
        step(later, [later - 1], 0.05 if later < k + 110 else 0.5)
    assert one.halved == 1


def test_doubted_residuals_of_before_it_began_count_when_growth_is_judged() -> None:
    """A ring beyond the bound is no growth of the repetition: it was there before."""
    one = Repetition(1e-3, 200.0, 10.0)
    one.state(0.1)
    began = 0
    for k in range(800):
        one.set(1, 0.5, 2e-3, 0.2)
        one.read(k - 1, 2.0 * math.sin(4e-2 * math.pi * (k - 1)))
        y_um = 10.0 * math.sin(2e-2 * math.pi * k)
        one.applied(k, 0.5 * y_um + one.add(k, y_um, 0.5 * y_um))
        began += one.active
    assert began > 300
    assert one.active
    assert one.halved == 0


def test_a_residual_that_changes_its_sign_from_pass_to_pass_grows_little() -> None:
    """A slope of three and a half times the right one: 1 - GAIN 3.5 = -1.45."""
    loop = Loop(66.6667, slope=1.75)
    errors = loop.run(30)
    assert errors.max() < 2.5 * errors[1]


def test_after_quiet_passes_a_halved_gain_comes_back() -> None:
    loop = Loop(66.6667)
    loop.run(5)
    loop.repetition.factor = 0.25
    loop.run(50)
    assert loop.repetition.factor == 1.0


def test_what_is_kept_goes_on_beyond_its_end_and_a_gap_begins_anew() -> None:
    loop = Loop(66.6667)
    loop.run(2.5 * 2 * KEPT / 66.6667)
    assert loop.repetition.active
    assert np.abs(np.diff(np.array(loop.added[-2000:]))).max() < 0.05
    loop.repetition.add(loop.k + 50, 0.0, 0.0)
    assert not loop.repetition.active


def test_readings_that_come_later_than_before_change_the_pass_that_teaches() -> None:
    """Begun just now, with readings 1 sample old; of readings 60 samples old the last pass has too few."""
    loop = Loop(66.6667)
    while not loop.repetition.active:
        loop.run(1 / 66.0)
    loop.age = 60
    loop.run(1 / 66.0)
    assert not loop.repetition.active
    errors = loop.run(20)
    assert loop.repetition.active
    assert errors[-1] < 0.05 * errors[0]


def test_the_correction_keeps_its_bound() -> None:
    loop = Loop(66.6667)
    loop.run(12, error=3.0)
    assert np.abs(loop.added).max() <= 2.0


@pytest.mark.parametrize("name", ["dt_s", "mode_Hz", "fade_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_impossible_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name}: got {value}"):
        Repetition(**{"dt_s": 1e-3, "mode_Hz": 200.0, "fade_s": 0.5, name: value})


@pytest.mark.parametrize("period_s", [0.0, -1.0, 1e-3, 10.0, math.nan])
def test_impossible_periods_are_refused_and_change_nothing(period_s: float) -> None:
    one = Repetition(1e-3, 200.0, 0.5)
    one.state(0.1)
    with pytest.raises(InputError, match=r"period_s: got .*expected 0.016 to 4.096 s"):
        one.state(period_s)
    assert one.period == pytest.approx(100.0)
