"""Readings that are later than the nominal stage may be, in motion too slow for a frequency response."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.diagnose import diagnose
from dehyst.sim.diagnosis.nominal import calibrate_nominal
from dehyst.sim.diagnosis.unexplained import follows_drive
from dehyst.sim.effects.delay import Delay, Late
from dehyst.sim.effects.sampled_lags import has_response
from dehyst.sim.effects.sensor_lag import SensorLag
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.hysteresis_loops import bouc_wen_loop
from dehyst.sim.readings.readings import Readings

DT, N = 0.005, 4000
WHOLE = np.ones(N, dtype=np.bool_)
LAGS = {"delay", "sensor_lag", "amplifier_lag"}


def record(late_s: float) -> FitData:
    """A Bouc-Wen loop under a sine of 1 Hz with a growing height, read ``late_s`` late, with noise of 50 nm."""
    t = np.arange(N) * DT
    voltage = lambda at: 1.8 - np.linspace(0.4, 1.0, N) * 1.8 * np.cos(2.0 * np.pi * at)  # noqa: E731
    late = np.ascontiguousarray(voltage(t - late_s))
    y = 12.0 * late - bouc_wen_loop(late, 4.0, 0.6, 0.7, 0.0)
    return FitData(DT, voltage(t), y + 0.05 * np.random.default_rng(2).standard_normal(N))


@pytest.mark.parametrize("late_s", [0.005, 0.03])
def test_a_lateness_that_the_nominal_stage_may_not_have_is_named_with_its_size(late_s: float) -> None:
    said = diagnose(record(late_s))
    lags = [c for c in said.causes if LAGS & {c.name, *c.alternatives}]
    if late_s < 0.009:
        assert not lags
        return
    (found,) = lags
    assert {found.name, *found.alternatives} == LAGS
    # The stage's own lateness is between that of its neutral lag and the 6.5 ms more that it may have.
    low, high = found.intervals["tau_s"]
    assert low <= late_s - 9e-3 < late_s - 2.53e-3 <= high
    assert high - low < 0.02


def test_what_shows_only_a_sum_is_fitted_as_a_sum() -> None:
    slow = record(0.03)
    readings = Readings(slow, WHOLE, 0.05)
    assert not has_response(readings)
    assert Delay("delay").shown(readings).missing(slow)
    assert Late("delay").shown(readings).pins == ("tau_s", "latch_samples")
    assert SensorLag("sensor_lag").shown(readings).missing(slow)
    rng = np.random.default_rng(0)
    steps = np.repeat(rng.uniform(0.0, 100.0, N // 100), 100)
    fast = FitData(1e-3, steps, 0.1 * steps + 0.01 * rng.standard_normal(N))
    shown = Readings(fast, WHOLE, 0.05)
    assert has_response(shown)
    assert not Delay("delay").shown(shown).missing(fast)
    assert Late("delay").shown(shown).pins == ("latch_samples",)
    assert not SensorLag("sensor_lag").shown(shown).missing(fast)


def test_nothing_is_late_while_the_stage_may_have_the_lag() -> None:
    for late_s, later in ((0.005, False), (0.03, True)):
        data = record(late_s)
        fit = calibrate_nominal("bouc_wen", data, WHOLE)
        assert bool(Late("delay").found_again(fit, WHOLE).missing(data)) is not later


def residual(left: FloatArray, u: FloatArray) -> float:
    data = FitData(DT, u, left)
    fit = calibrate_nominal("linear", data, WHOLE)
    return follows_drive(fit, WHOLE)


def test_an_error_that_follows_the_drive_in_parts_is_no_noise() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal(N)
    moved = np.convolve(u, np.exp(-np.arange(60) / 6.0) * np.cos(0.9 * np.arange(60)))[:N]
    lost = np.concatenate([moved[:1500], -moved[1500:]])
    assert residual(lost, u) > 0.3
    slow = np.cumsum(rng.standard_normal(N))
    for noise in (rng.standard_normal(N), slow / slow.std()):
        assert abs(residual(noise, u)) < 0.05
