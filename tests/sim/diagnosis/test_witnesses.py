"""The direct tests of the readings: each sees its own cause, made by a generator that shares no formula with them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.signal import lfilter

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.witnesses import witnesses
from dehyst.sim.effects import CAUSES
from dehyst.sim.effects.timing import slips_are_borne_out
from dehyst.sim.fitting.fit_data import EARLY_S, FitData
from dehyst.sim.readings.cycles import mirrored_branches
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight
from tests.hidden.excitation import FS_HZ, excitation
from tests.hidden.stage import Truth, record

DT = 1.0 / FS_HZ
SIGMA_UM = 0.005

#: Sizes that a stage can have, in the units of the hidden generator.
HIDDEN: dict[str, dict[str, float]] = {
    "creep": {"per_decade": 0.012},
    "thermal_drift": {"total_um": -0.6, "tau_s": 40.0},
    "gain_drift": {"total": 0.012},
    "resonance": {"f_Hz": 400.0, "damping": 0.02},
    "amplifier_lag": {"f_Hz": 250.0},
    "sensor_lag": {"f_Hz": 250.0},
    "delay": {"tau_s": 1.5e-3},
    "slew_limit": {"rate_V_per_s": 300.0},
    "saturation": {"top_V": 7.2},
    "asymmetry": {"share": 0.02},
    "sensor_nonlinearity": {"share": 0.0008},
    "cross_talk": {"share": 0.006},
    "mains_hum": {"f_Hz": 50.0, "amplitude_um": 0.006},
    "timing": {"ppm": 80.0},
}
#: Causes that show in one another's tests: one voltage and one sensor see their sum, or their shape.
ALIKE = (
    {"amplifier_lag", "sensor_lag"},
    {"asymmetry", "sensor_nonlinearity", "saturation"},
)


@lru_cache(maxsize=32)
def sights(name: str, seed: int = 5) -> dict[str, Sight]:
    effects = {name: HIDDEN[name]} if name else {}
    columns = record(Truth(seed, noise_um=SIGMA_UM, effects=effects), *excitation(np.random.default_rng(seed)))
    data = FitData(DT, columns["u_V"], columns["y_um"], u2_V=columns["u2_V"], y2_um=columns["y2_um"])
    return witnesses(Readings(data, np.ones(data.n, dtype=np.bool_), SIGMA_UM))


@pytest.mark.parametrize("name", HIDDEN)
def test_each_test_sees_its_cause_and_no_other(name: str) -> None:
    found = sights(name)
    assert found[name].seen is True, found[name].words
    allowed = {name, "hysteresis_shape"}.union(*(group for group in ALIKE if name in group))
    others = {other for other, sight in found.items() if sight.seen}
    assert others <= allowed, [found[other].words for other in others - allowed]


def test_on_a_healthy_stage_nothing_but_the_loop_is_seen() -> None:
    found = sights("")
    assert {name for name, sight in found.items() if sight.seen} == {"hysteresis_shape"}
    assert set(found) <= set(CAUSES)
    assert all(sight.words for sight in found.values())


@pytest.mark.parametrize(("rest_s", "also"), [(0.0, ("creep",)), (1.0, ())])
def test_cycles_that_began_before_the_record_do_not_tell_a_drift_from_creep(
    rest_s: float, also: tuple[str, ...]
) -> None:
    """The logarithm of the time since a beginning that is long ago is as good as straight."""
    t = np.arange(30_000) * DT
    u = np.where(t < rest_s, 0.0, 4.0 + 4.0 * np.sin(2.0 * np.pi * 2.0 * (t - rest_s) - 0.5 * np.pi))
    y = 10.0 * u + 0.02 * t + SIGMA_UM * np.random.default_rng(0).normal(size=u.size)
    u, y = (u, y) if rest_s else (u[2000:], y[2000:])
    found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))["thermal_drift"]
    assert found.seen is True, found.words
    assert found.also == also


def test_a_record_that_excites_nothing_decides_nothing() -> None:
    t = np.arange(8000) * DT
    u = 4.0 - 4.0 * np.cos(2.0 * np.pi * 0.5 * t)
    y = 10.0 * u + SIGMA_UM * np.random.default_rng(0).normal(size=u.size)
    found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
    for name in ("creep", "thermal_drift", "gain_drift", "resonance", "delay", "cross_talk", "mains_hum", "timing"):
        assert found[name].seen is None, found[name].words


def test_asymmetry_is_asked_of_each_height_of_cycle_alone() -> None:
    heights = np.repeat([4.0, 8.0, 4.0], [12, 4, 12])
    ramp = np.linspace(0.0, 1.0, 400, endpoint=False)
    u = np.concatenate([np.zeros(400), *(h * np.r_[ramp, 1.0 - ramp] for h in heights), np.zeros(400)])
    noise = SIGMA_UM * np.random.default_rng(6).normal(size=u.size)
    # The gain changes where small cycles do not come: most of the cycles see nothing of it.
    y = 10.0 * u + 0.3 * np.maximum(u - 5.0, 0.0) + noise
    whole = np.ones(u.size, dtype=np.bool_)
    assert witnesses(Readings(FitData(DT, u, y), whole, SIGMA_UM))["asymmetry"].seen is True
    # One cycle that does not close is the first rise of a loop, whatever its height.
    rise = np.arange(u.size) < 400 + 800 * 12 + 400
    y = 10.0 * u - np.where(rise, 0.4 * np.maximum(u - 4.0, 0.0), 0.0) + noise
    assert witnesses(Readings(FitData(DT, u, y), whole, SIGMA_UM))["asymmetry"].seen is False


def staircase(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time, a staircase of holds of 2 s, and noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.permutation(np.tile([0.0, 2.0, 5.0, 8.0], 3)), 4000)
    return np.asarray(np.arange(u.size) * DT), u, SIGMA_UM * rng.normal(size=u.size)


@pytest.mark.parametrize("per_decade", [0.006, 0.02])
def test_the_size_of_creep_is_that_of_the_law(per_decade: float) -> None:
    """y = g u (1 + c log10(1 + t/t0)) for each step, in closed form: the test reads c from the holds."""
    t, u, noise = staircase(1)
    y = 10.0 * u + noise
    for k in np.flatnonzero(np.diff(u, prepend=0.0)):
        step = u[k] - (u[k - 1] if k else 0.0)
        y[k:] += 10.0 * step * per_decade * np.log10(1.0 + (t[k:] - t[k]) / 0.05)
    sight = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))["creep"]
    assert sight.seen is True
    said = float(sight.words.split("rise by ")[1].split()[0])
    assert said == pytest.approx(100.0 * per_decade, rel=0.25)


def test_a_drift_in_time_is_no_creep_and_no_gain_drift() -> None:
    t, u, noise = staircase(2)
    found = witnesses(Readings(FitData(DT, u, 10.0 * u + 0.02 * t + noise), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
    assert found["thermal_drift"].seen is True
    assert found["creep"].seen is not True
    assert found["gain_drift"].seen is not True


def test_cycles_tell_a_mean_that_creeps_from_one_that_drifts() -> None:
    t = np.arange(60_000) * DT
    u = 4.0 - 4.0 * np.cos(2.0 * np.pi * 1.0 * t)
    noise = SIGMA_UM * np.random.default_rng(3).normal(size=t.size)
    whole = np.ones(t.size, dtype=np.bool_)
    creeps = witnesses(Readings(FitData(DT, u, 10.0 * u + 0.3 * np.log10(0.2 + t) + noise), whole, SIGMA_UM))
    drifts = witnesses(Readings(FitData(DT, u, 10.0 * u + 0.02 * t + noise), whole, SIGMA_UM))
    assert (creeps["creep"].seen, creeps["thermal_drift"].seen) == (True, None)
    assert (drifts["creep"].seen, drifts["thermal_drift"].seen) == (None, True)
    grows = witnesses(Readings(FitData(DT, u, 10.0 * u * (1.0 + 4e-4 * t) + noise), whole, SIGMA_UM))
    assert grows["gain_drift"].seen is True
    assert grows["thermal_drift"].seen is not True


def test_slips_must_be_borne_out_by_the_lateness_of_the_readings() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(40_000) * DT
    u = 4.0 - 4.0 * np.cos(2.0 * np.pi * 3.0 * t)
    clean = 10.0 * u
    slipped = np.concatenate([clean[:20_000], clean[20_002:], clean[-2:]]) + SIGMA_UM * rng.normal(size=t.size)
    whole = np.ones(t.size, dtype=np.bool_)
    readings = Readings(FitData(DT, u, slipped), whole, SIGMA_UM)
    assert slips_are_borne_out(readings, ((20_000, 2),))
    # A lag that comes and goes wanders by more than any count of slips.
    wandering = np.interp(t - 8.0 * DT * (1.0 + np.sin(2.0 * np.pi * 0.2 * t)), t, clean)
    assert not slips_are_borne_out(Readings(FitData(DT, u, wandering), whole, SIGMA_UM), ((20_000, 1),))


@pytest.mark.parametrize("ppm", [60.0, -60.0])
def test_a_clock_shows_in_the_steps_of_a_staircase(ppm: float) -> None:
    """Readings that come up to seven samples early or late are no linear change of a step."""
    rng = np.random.default_rng(6)
    u = np.repeat(rng.uniform(0.0, 8.0, 40), 3000)
    lagged = lfilter([1.0 - np.exp(-DT / 1.3e-3)], [1.0, -np.exp(-DT / 1.3e-3)], 10.0 * u)
    at = np.arange(u.size)
    y = np.interp(at * (1.0 + 1e-6 * ppm), at, lagged) + SIGMA_UM * rng.normal(size=u.size)
    found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
    assert found["timing"].seen is True, found["timing"].words
    assert found["slew_limit"].seen is not True, found["slew_limit"].words


def test_what_is_slower_than_the_steps_says_nothing_about_a_limit_of_the_slew() -> None:
    """Steps of one size ask for more speed than the sine; a limit between both cannot be excluded."""
    t = np.arange(16_000) * DT
    u = np.concatenate([np.tile(np.repeat([0.0, 5.0], 2000), 4), 2.5 - 2.5 * np.cos(2.0 * np.pi * (2.0 + t / 2.0) * t)])
    for steps, seen in ((0, None), (3, False)):
        u[2000 * np.arange(steps)[:, None] + np.arange(2000)] *= np.array([0.3, 0.6, 0.45])[:steps, None]
        y = 10.0 * u + SIGMA_UM * np.random.default_rng(0).normal(size=u.size)
        found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
        assert found["slew_limit"].seen is seen, found["slew_limit"].words


def test_a_cycle_that_is_shorter_than_the_lag_has_no_branches() -> None:
    """The last cycle of the record is over before the stage has followed it."""
    u = np.concatenate([np.repeat(np.tile([0.0, 4.0, 2.0], 8), 1000), [0.0] * 1000, np.linspace(0.0, 4.0, 14), [0.0]])
    s, y = 0.0, np.empty(u.size)
    for k in range(u.size):
        s += (u[k] - s) * DT / 0.2
        y[k] = 10.0 * s
    readings = Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM)
    last = readings.cycles[-1]
    assert readings.lag_s > (last.stop - last.start) * DT
    assert mirrored_branches(readings).seen is None


def test_steps_between_which_nothing_moves_say_nothing_about_slow_motion() -> None:
    """Steps too small to count as such are the only motion besides: no correlation of constants is asked for."""
    u = np.repeat(np.tile([0.0, 2.0, 4.0, 2.0], 4), 2000) + np.repeat(np.tile([0.0, 0.05], 80), 200)
    y = 10.0 * u + SIGMA_UM * np.random.default_rng(4).normal(size=u.size)
    found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
    assert found["slew_limit"].seen is not True


def test_a_staircase_with_one_level_beyond_the_limit_shows_a_saturation() -> None:
    levels = [0.0, 2.0, 4.0, 6.6, 8.0, 6.6, 4.0, 2.0, 0.0]
    u = np.repeat(np.tile(levels, 2), 2000).astype(np.float64)
    noise = SIGMA_UM * np.random.default_rng(1).normal(size=u.size)
    for top, seen in ((6.7, True), (9.0, None)):
        y = 10.0 * np.minimum(u, top) + noise
        found = witnesses(Readings(FitData(DT, u, y), np.ones(u.size, dtype=np.bool_), SIGMA_UM))
        assert found["saturation"].seen is seen, found["saturation"].words


def test_rests_and_cycles_are_found_where_they_are() -> None:
    u = np.concatenate([np.zeros(2000), np.linspace(0, 5, 1000), np.linspace(5, 0, 1000), np.full(3000, 0.0)])
    readings = Readings(FitData(DT, u, 10.0 * u), np.ones(u.size, dtype=np.bool_), SIGMA_UM)
    (cycle,) = readings.cycles
    assert np.abs(np.array([cycle.start, cycle.top, cycle.stop]) - [2000, 2999, 3999]).max() <= 1
    first, last = readings.rests
    settled, early = round(0.15 / DT), round(EARLY_S / DT)
    assert np.abs(np.array([first.last, last.first, last.last]) - [2001 - early, 3999 + settled, u.size]).max() <= 1
    assert first.level_V == last.level_V == 0.0
