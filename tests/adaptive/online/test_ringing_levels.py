"""The level under ringing: exact without noise, with stated error rates in noise; and how one thing follows another.

The rates are those of one look at a fixed number of readings, by the rule of ``adaptive.online.glitch_or_jump``. What
comes of
looking again with each reading is in ``test_hypotheses.py``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from adaptive.online.gates import AdmissionConfig
from adaptive.online.glitch_or_jump import LEVEL_STD, NO_LEVEL, SIGMA, USUAL_STD, WINDOWS, Level, level_of, slope_of
from adaptive.types import FloatArray

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
    assert (level.order, level.rate) == (0, 0.0)


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


@pytest.mark.parametrize("slope", [0.01, -0.3, 0.0])
@pytest.mark.parametrize("n", [16, 28, 64])
@pytest.mark.parametrize(("mode_Hz", "damping"), [(0.0, 0.0), (120.0, 0.01), (300.0, 0.05)])
def test_the_level_of_a_ramp_is_where_it_has_come_to(slope: float, n: int, mode_Hz: float, damping: float) -> None:
    r = 0.4 + slope * np.arange(n) + (ringing(n, 1000.0, mode_Hz, damping, 1.0, 1.0) if mode_Hz else 0.0)
    level = level_of(r, 1e-9, drifts=True)
    assert level.at == pytest.approx(0.4 + slope * (n - 1), rel=1e-5, abs=1e-6)
    assert level.rate == pytest.approx(slope, rel=1e-5, abs=1e-8)
    # Without noise the fit is nearly singular, and the deviation is that of the ridge.
    assert level.std < 5e-3


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


def test_fewer_than_six_values_have_no_level_and_a_line_needs_eight() -> None:
    for n in range(6):
        level = level_of(np.full(n, 3.0), 1.0)
        assert math.isnan(level.at)
        assert math.isinf(level.std)
        assert math.isinf(level.residual)
    assert level_of(np.full(6, 3.0), 1.0).at == pytest.approx(3.0)
    assert math.isinf(level_of(np.full(7, 3.0), 1.0, drifts=True).std)
    assert level_of(np.full(8, 3.0), 1.0, drifts=True).at == pytest.approx(3.0)


@pytest.mark.parametrize("drifts", [False, True])
def test_the_unit_of_the_readings_does_not_matter(drifts: bool) -> None:
    rng = np.random.default_rng(3)
    r = 20.0 + 0.2 * np.arange(28) * drifts + ringing(28, 1000.0, 220.0, 0.02, 30.0) + rng.standard_normal(28)
    one = level_of(r, 1.0, drifts)
    for unit in (1e-3, 20.0):
        other = level_of(unit * r, unit, drifts)
        assert other.order == one.order
        told = (other.at, other.std, other.residual, other.rate)
        assert told == pytest.approx([unit * value for value in (one.at, one.std, one.residual, one.rate)], rel=1e-4)


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
