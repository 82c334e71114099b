"""A loop of another class than the nominal stage must not hide a cause, take its name, or drive the lag away.

Each case has a kind of its own: what the comment says. Whole diagnoses of them run with ``-m long``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from dehyst.sim.diagnosis import diagnose_prepared, prepare
from dehyst.sim.diagnosis.nominal import BoucWenStage, calibrate_nominal, with_nominal_kind
from dehyst.sim.effects.gain_drift import in_rests
from dehyst.sim.effects.payload_change import seen as payload_seen
from dehyst.sim.effects.sampled_lags import lags_of_response, second_lag
from dehyst.sim.effects.saturation import Saturation
from dehyst.sim.effects.saturation import seen as saturation_seen
from dehyst.sim.effects.sensor_lag import SensorLag
from dehyst.sim.effects.slew_limit import seen as slew_seen
from dehyst.sim.effects.thermal_drift import in_rests as drift_in_rests
from dehyst.sim.effects.timing import Clock
from dehyst.sim.effects.timing import seen as timing_seen
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.readings.cycles import mirrored_branches
from dehyst.sim.readings.noise import noise_floor
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.ringing import ringing
from dehyst.sim.readings.sight import Sight
from dehyst.sim.readings.slow_motion import rests_over_time
from tests.hidden.foreign.cases import healthy, pair, single
from tests.hidden.foreign.record import Case, Rig
from tests.hidden.foreign.score import judge, nominal_of, recording_of

#: The nominal stage's own loop.
OWN_LOOP = Rig(3, "bouc_wen", False, "triangles", "white", 1000.0, 30.0, 100.0, 60.0, 1.5e-3, False, 0.0, 0.0018, 1.0)
#: A second lag, much like the stage's own on sixty plays.
EQUAL_LAGS = Case(
    "single",
    62,
    Rig(62, "play_sum", False, "steps_and_sines", "white", 500.0, 40.0, 10.0, 60.0, 2.7e-3, False, 0.0, 0.003, 1.0),
    {"amplifier_lag": {"tau_s": 3.4e-3}},
)
#: A mode that a payload has moved midway, after which there are sines alone; and one loaded before, behind a lag.
MOVED_MIDWAY, LOADED_AND_LAGGING = single(777), pair(778)
#: A second lag that the response gives to a few per cent of the fitted one; and none, under a staircase of relays.
FAINT_LAG, ONE_LAG = pair(1033), single(163)
#: A clock error on a record of 10 kHz, on which a sample moves little.
LATE_BY_LITTLE = pair(1030)


def readings_of(case: Case) -> Readings:
    """A case as the direct tests see it."""
    prepared = prepare(recording_of(case), nominal=nominal_of(case))
    data = with_nominal_kind(prepared.nominal, prepared.data)
    return Readings(data, prepared.mask, noise_floor(data).sigma_um)


def seen_late(readings: Readings) -> Sight:
    return Sight(lags_of_response(readings).late, "")


@pytest.mark.parametrize(
    ("case", "test", "seen"),
    [
        # The voltage's last 2 % are clipped on a loop that bends; a payload rings, where nothing is clipped; a sensor's
        # bow is slow at the bottom of a raster whose top is clipped: a limit shows at neither end.
        (single(763), saturation_seen, (True,)),
        (pair(614), saturation_seen, (None, False)),
        (single(820), saturation_seen, (None,)),
        # A limit of the speed beside a late reading: both bend the response, and neither is a lag.
        (pair(816), second_lag, (None,)),
        # Cycles over a part of the range do not exclude a bow.
        (single(733), mirrored_branches, (None,)),
        # Lags that are much alike, and of half a sample; one lag; what lags is not late.
        (EQUAL_LAGS, second_lag, (True,)),
        (EQUAL_LAGS, seen_late, (False,)),
        (single(260), second_lag, (True,)),
        (ONE_LAG, second_lag, (False,)),
        # Two lags on relays are no delay.
        (single(860), second_lag, (True,)),
        (single(860), seen_late, (None,)),
        # The response bends unclearly; is too narrow for half a sample; is not what lags describe: none is excluded.
        (pair(705), second_lag, (None,)),
        (pair(852), second_lag, (None,)),
        (pair(1032), second_lag, (None,)),
        # A loop that is described badly is no clock error.
        (single(672), timing_seen, (None,)),
        # A limit that only the largest steps reach is not excluded.
        (single(851), slew_seen, (None,)),
        # Rests of the second half do not exclude a drift in the first.
        (single(973), drift_in_rests, (None,)),
    ],
    ids=lambda one: f"{one.kind}-{one.seed}" if isinstance(one, Case) else None,
)
def test_a_direct_test_sees_what_is_there_and_excludes_only_what_would_show(
    case: Case, test: Callable[[Readings], Sight], seen: tuple[bool | None, ...]
) -> None:
    sight = test(readings_of(case))
    assert sight.seen in seen, sight.words


def test_the_frequency_at_which_the_stage_rings_dates_and_weighs_a_payload() -> None:
    own, readings = MOVED_MIDWAY.effects["payload_change"], readings_of(MOVED_MIDWAY)
    assert payload_seen(readings).seen is True
    found = ringing(readings.data)
    assert found is not None
    change = found.change()
    assert change is not None
    k, before, after = change
    assert abs(before.f_hz / own["known_Hz"] - 1.0) < 0.001
    assert abs((before.f_hz / after.f_hz) ** 2 - 1.0 - own["ratio"]) < 0.015
    at_s = own["from_share"] * MOVED_MIDWAY.rig.duration_s
    assert found.begin_s[k - 1] < at_s < found.end_s[k]


def test_a_payload_that_was_there_before_is_seen_against_the_stage_file_through_a_lag() -> None:
    own, readings = LOADED_AND_LAGGING.effects["payload_change"], readings_of(LOADED_AND_LAGGING)
    found = ringing(readings.data)
    assert found is not None
    assert found.change() is None
    assert abs(found.level().f_hz * np.sqrt(1.0 + own["ratio"]) / own["known_Hz"] - 1.0) < 0.002
    # The stage of this file has no lag of its own: the first one is the sensor's.
    assert second_lag(readings).seen is True
    unloaded = LOADED_AND_LAGGING.effects | {"payload_change": own | {"ratio": 0.0}}
    assert payload_seen(readings_of(replace(LOADED_AND_LAGGING, effects=unloaded))).seen is False


@pytest.mark.parametrize(("case", "ppm"), [(single(867), 190.2), (pair(820), 73.9)])
def test_a_clock_error_is_seen_when_what_the_description_took_over_is_taken_off(case: Case, ppm: float) -> None:
    """Under sines the description of late readings takes their lateness over; and beside creep."""
    assert case.effects["timing"]["ppm"] == pytest.approx(ppm, abs=0.1)
    sight = timing_seen(readings_of(case))
    said = re.search(r"changes by (-?[\d.]+)", sight.words)
    assert sight.seen is True
    assert said is not None
    assert -float(said[1]) == pytest.approx(ppm, abs=10.0)


def test_creep_on_a_loop_whose_steps_differ_is_not_seen_as_a_drift_of_the_gain() -> None:
    """A step over a steep part of the loop is larger than its voltage, and creeps by more."""
    readings = readings_of(single(741))
    assert in_rests(readings).seen is not True
    found = rests_over_time(readings).creep
    assert found is not None
    assert found.value > 10.0 * found.error


def test_the_hold_is_the_one_that_fits_best_with_its_own_lag() -> None:
    """Held voltages at 500 Hz, nothing hidden: a voltage that runs linearly fits at first."""
    case = healthy(716)
    prepared = prepare(recording_of(case))
    fit = calibrate_nominal("bouc_wen", with_nominal_kind("bouc_wen", prepared.data), prepared.mask)
    numbers = dict(zip((s.name for s in fit.model.parameters), fit.p, strict=True))
    assert (fit.model.nominal.hold, round(numbers["latch_samples"], 2)) == ("zero", 0.0)
    assert numbers["tau_s"] == pytest.approx(case.rig.lag_s, rel=0.01)


def test_a_start_that_is_not_judged_is_no_larger_than_what_moves_in_it() -> None:
    """Free to grow until the end of its tail fits, it bent the fit that a further cause needs."""
    data = prepare(recording_of(pair(836)), nominal="bouc_wen").data
    start = BoucWenStage("zero", free_memory=True).parameters(data)[-1]
    first = data.y_um[data.t_s - data.t_s[0] < 0.02]
    assert start.name == "start_um"
    assert start.high == pytest.approx(np.ptp(first), rel=0.3)


def made(seed: int, rig: Rig, **effects: dict[str, float]) -> Case:
    return Case("single", seed, rig, effects)


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [
        # What the form of a cause leaves is no other cause.
        made(3, replace(OWN_LOOP, drive="staircase"), asymmetry={"share": 0.0086}),
        made(3, OWN_LOOP, rate_dependence={"per_decade": 0.06, "corner_per_s": 0.3}),
        # A payload is looked for where the stage rings, in every rest.
        made(
            4,
            replace(OWN_LOOP, drive="staircase", fs_hz=2000.0, duration_s=15.0, lag_s=0.0),
            payload_change={"known_Hz": 93.7, "damping": 0.008, "ratio": 0.57, "from_share": 0.0},
        ),
        # Slips beside another loop; two lags; a payload on a stated mode; a stage that moved before the record.
        *(single(829), single(792), single(796), single(701), pair(818)),
        # A drift under a multisine; a bent sensor at 500 Hz; heat beside a used loop; a lag of the amplifier and creep.
        *(single(783), single(18), single(403), pair(934)),
        # Two causes that explain enough only together; held voltages; a faint drift; a level cut off; a known corner.
        *(single(958), pair(988), pair(834), single(1029), pair(1026)),
    ],
    ids=lambda case: f"{case.kind}-{case.seed}-{'-'.join(case.hidden)}",
)
def test_what_is_hidden_is_named_and_nothing_else_is(case: Case) -> None:
    said = diagnose_prepared(prepare(recording_of(case), nominal=nominal_of(case)))
    groups = tuple((c.name, *c.alternatives) for c in said.causes)
    judged = judge(case.hidden, case.allowed, said.verdict, groups)
    assert judged.right, (groups, judged)
    assert said.extended_heldout_um < 1.5 * max(said.noise_floor_um, case.rig.sigma_um)


def test_a_limit_that_cuts_next_to_nothing_off_does_not_speak_against_the_other_one() -> None:
    """Levels up to 8 V, cut at 6.7 V; a fitted lower limit that only rounds the bottom is no evidence."""
    u = np.repeat(np.tile([0.0, 0.05, 2.0, 4.0, 6.6, 8.0, 4.0], 4), 400)
    data = FitData(1e-3, u, 10.0 * np.minimum(u, 6.7))
    assert Saturation().plausible(np.array([6.7, 0.02]), data)
    assert not Saturation().plausible(np.array([3.0, 0.02]), FitData(1e-3, u, 10.0 * u))


def test_a_limit_shows_on_the_way_back_where_readings_lag_on_the_way_there() -> None:
    """Voltages that rise faster than the stage: its readings still rise beyond the limit."""
    u = np.tile(np.concatenate([np.linspace(0.0, 10.0, 400), np.full(200, 10.0), np.linspace(10.0, 0.0, 100)]), 6)
    y = 10.0 * lfilter([0.05], [1.0, -0.95], np.minimum(u, 9.3))
    data = FitData(1e-3, u, y)
    top, back = data.u_V > 9.2, np.diff(data.u_V, prepend=0.0) < 0.0
    ways = [float(np.polyfit(u[rows], y[rows], 1)[0]) for rows in (top, top & back)]
    assert abs(ways[0]) > 0.35 * data.gain_um_per_V > abs(ways[1])
    assert Saturation().plausible(np.array([9.3, 0.0]), data)
    assert not Saturation().plausible(np.array([9.3, 0.0]), FitData(1e-3, u, 10.0 * u))


@pytest.mark.parametrize(("fitted_s", "agrees"), [(0.64e-3, True), (1.0e-3, True), (0.3e-3, False)])
def test_a_fitted_lag_is_compared_with_that_of_the_response(fitted_s: float, agrees: bool) -> None:
    """Behind the response of `FAINT_LAG` are lags of 0.65 and 1 ms; that of `ONE_LAG` has no second one."""
    assert bool(SensorLag().agreement(np.array([fitted_s]), readings_of(FAINT_LAG))) is agrees
    assert not SensorLag().agreement(np.array([fitted_s]), readings_of(ONE_LAG))


@pytest.mark.parametrize(("fitted_ppm", "agrees"), [(45.4, True), (-45.4, False), (90.0, False)])
def test_a_faint_change_of_the_lateness_is_compared_with_the_fitted_clock(fitted_ppm: float, agrees: bool) -> None:
    readings = readings_of(LATE_BY_LITTLE)
    assert timing_seen(readings).seen is None
    assert bool(Clock().agreement(np.array([fitted_ppm]), readings)) is agrees
