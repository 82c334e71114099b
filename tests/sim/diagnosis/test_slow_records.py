"""Records of a stack at 200 Hz under a sine of 1 Hz: what their readings say of time, drifts and the start."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.diagnose import usable, without_start
from dehyst.sim.diagnosis.witnesses import witnesses
from dehyst.sim.effects.creep import Creep
from dehyst.sim.effects.mains_hum import MainsHum
from dehyst.sim.effects.rate_dependence import RateDependence
from dehyst.sim.effects.resonance import find_ringing, ringing_peak
from dehyst.sim.effects.saturation import find_limits
from dehyst.sim.effects.thermal_drift import Wander, in_cycles
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.readings.noise import reading_limits
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight
from dehyst.sim.readings.slow_motion import USUAL
from tests.foreign.inject import inject

DT, N = 0.005, 4000
SIGMA_UM = 0.05


def sine() -> tuple[FloatArray, FloatArray]:
    """Voltage, and readings (µm) of a loop of plays with a bend that no description knows exactly."""
    rng = np.random.default_rng(0)
    u = 1.8 + 1.8 * np.sin(2.0 * np.pi * DT * np.arange(N))
    y, weights = 8.0 * u + 0.4 * np.sin(1.3 * u), rng.uniform(0.1, 0.3, 25)
    for radius, weight in zip(np.linspace(0.05, 1.6, 25), weights, strict=True):
        at = u[0]
        for k in range(N):
            at = min(max(at, u[k] - radius), u[k] + radius)
            y[k] += weight * at
    return u, y + SIGMA_UM * rng.standard_normal(N)


def injected(cause: str, seed: int = 3) -> tuple[FitData, dict[str, float]]:
    u, y, truth = inject(DT, *sine(), cause, np.random.default_rng(seed)) if cause else (*sine(), {})
    return FitData(DT, u, y), truth


def sights(cause: str, seed: int = 3) -> tuple[dict[str, Sight], dict[str, float]]:
    data, truth = injected(cause, seed)
    return witnesses(Readings(data, np.ones(data.n, dtype=np.bool_), SIGMA_UM)), truth


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_lost_samples_and_a_wrong_clock_are_seen_in_slow_motion(seed: int) -> None:
    slips, lost = sights("slips", seed)
    assert slips["timing"].seen is True, slips["timing"].words
    assert f"{lost['lost_samples'] / 2:+.0f} from" in slips["timing"].words
    clock, truth = sights("clock", seed)
    assert clock["timing"].seen is True, clock["timing"].words
    said = -float(clock["timing"].words.split("changes by ")[1].split()[0])
    assert said == pytest.approx(truth["clock_ppm"], rel=0.15)


@pytest.mark.parametrize("cause", ["", "gain_drift", "thermal_exponential", "creep", "bow", "sensor_lag", "resonance"])
def test_what_does_not_act_on_time_is_no_timing(cause: str) -> None:
    assert sights(cause)[0]["timing"].seen is not True


@pytest.mark.parametrize("cause", ["thermal_line", "thermal_exponential", "thermal_walk"])
def test_a_drift_of_any_form_is_seen_in_equal_cycles(cause: str) -> None:
    found = sights(cause)[0]
    assert found["thermal_drift"].seen is True, found["thermal_drift"].words
    # One that settles may be creep: then both are one set.
    assert found["creep"].seen is not True or "creep" in found["thermal_drift"].also, found["creep"].words


def test_the_course_of_a_walk_is_that_of_the_means_over_one_period() -> None:
    data, _ = injected("thermal_walk")
    walk = data.y_um - sine()[1]
    form = Wander().shown(Readings(data, np.ones(N, dtype=np.bool_), SIGMA_UM))
    assert not form.missing(data)
    left = walk - form.motion(np.zeros(N), np.ones(1), data)
    inside = slice(400, -400)
    assert np.std(left[inside]) < 0.25 * np.std(walk[inside])


def test_a_drift_below_the_usual_is_not_seen_in_cycles() -> None:
    u, y = sine()
    for share, seen in ((0.3, None), (3.0, True)):
        drifted = y + share * USUAL * np.ptp(y) * np.linspace(0.0, 1.0, N)
        found = in_cycles(Readings(FitData(DT, u, drifted), np.ones(N, dtype=np.bool_), 1e-4))
        assert found.seen is seen, found.words


def test_a_creep_of_fast_lags_alone_is_no_creep() -> None:
    data, form = FitData(DT, *sine()), Creep()
    assert form.plausible(np.array([5e-3, 2e-3, 0.0, 0.0]), data)
    assert not form.plausible(np.array([5e-3, -8e-3, 0.0, 0.0]), data)


def test_a_gain_that_drifts_about_the_middle_moves_no_mean() -> None:
    found = sights("gain_drift")[0]
    assert found["gain_drift"].seen is True, found["gain_drift"].words
    assert found["thermal_drift"].seen is not True, found["thermal_drift"].words


def test_a_hum_of_two_percent_of_the_range_is_within_its_bounds() -> None:
    data = FitData(DT, *sine())
    assert MainsHum().parameters(data)[1].high > 0.02 * data.range_um


def test_readings_at_a_limit_are_told_from_those_on_a_coarse_grid_and_from_rests() -> None:
    data, truth = injected("clipped_reading")
    assert reading_limits(data) == (-np.inf, truth["y_max_um"])
    whole = np.ones(N, dtype=np.bool_)
    found = find_limits(data, 0.1 * np.ones(N), usable(data, whole), SIGMA_UM)
    assert found is not None
    assert found.parameters == {"y_max_um": truth["y_max_um"]}
    assert not usable(data, whole)[data.y_um == truth["y_max_um"]].any()
    for other in ("quantisation", ""):
        assert reading_limits(injected(other)[0]) == (-np.inf, np.inf)
    resting = FitData(DT, np.repeat([0.0, 4.0, 0.0, 2.0, 0.0], 800), np.repeat([0.0, 4.0, 0.0, 2.0, 0.0], 800))
    assert reading_limits(resting) == (-np.inf, np.inf)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_mode_rings_in_what_the_loop_leaves_and_hum_does_not(seed: int) -> None:
    data, truth = injected("resonance", seed)
    mask = np.ones(N, dtype=np.bool_)
    readings = Readings(data, mask, SIGMA_UM)
    f_hz, share = ringing_peak(readings.left_um, readings.memory_um, mask, DT)
    assert f_hz == pytest.approx(truth["f0_hz"], rel=0.04)
    found = find_ringing(data, readings.left_um, mask, SIGMA_UM)
    assert (found is not None) is (share > 0.2)
    for other in ("mains_hum", "creep", ""):
        quiet = Readings(injected(other, seed)[0], mask, SIGMA_UM)
        assert ringing_peak(quiet.left_um, quiet.memory_um, mask, DT) == (0.0, 0.0)


def test_equal_cycles_are_compared_by_the_samples_that_count_in_all_of_them() -> None:
    """A drift under clipped tops: no cycle is whole."""
    u, y = sine()
    drifting = FitData(DT, u, np.minimum(y + 0.02 * DT * np.arange(N), 0.9 * float(y.max())))
    mask = usable(drifting, np.ones(N, dtype=np.bool_))
    assert 0.05 < np.mean(~mask) < 0.4
    assert witnesses(Readings(drifting, mask, SIGMA_UM))["thermal_drift"].seen is True


def test_one_period_shows_no_rate_dependence() -> None:
    u, y = sine()
    assert RateDependence().missing(FitData(DT, u, y))
    growing = u * np.linspace(0.2, 1.0, N)
    assert RateDependence().missing(FitData(DT, growing, y))
    faster = np.concatenate([u[:2000], 1.8 + 1.8 * np.sin(2.0 * np.pi * 4.0 * DT * np.arange(2000))])
    assert not RateDependence().missing(FitData(DT, faster, y))


def test_a_ring_down_at_the_start_is_left_out_and_an_equal_one_later_is_not() -> None:
    rng = np.random.default_rng(1)
    residual, whole = 0.05 * rng.standard_normal(8000), np.ones(8000, dtype=np.bool_)
    t = np.arange(300) * 1e-3
    ring = 2.0 * np.exp(-t / 0.015) * np.cos(2.0 * np.pi * 300.0 * t)
    start = residual.copy()
    start[:300] += ring
    assert 0.04 <= float(np.flatnonzero(without_start(whole, start, 1e-3))[0]) * 1e-3 <= 0.09
    both = start.copy()
    both[4000:4300] += ring
    assert without_start(whole, both, 1e-3).all()
    assert np.count_nonzero(~without_start(whole, residual, 1e-3)) <= 10
