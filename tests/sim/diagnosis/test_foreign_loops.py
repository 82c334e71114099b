"""A loop of another class than the nominal stage must not hide a cause, take its name, or drive the lag away."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from dehyst.sim.diagnosis import Diagnosis, diagnose_prepared, prepare
from dehyst.sim.diagnosis.nominal import BoucWenStage, calibrate_nominal, with_nominal_kind
from dehyst.sim.diagnosis.search.search import first_fits
from dehyst.sim.effects.gain_drift import in_rests
from dehyst.sim.effects.hysteresis_shape import HysteresisShape
from dehyst.sim.effects.payload_change import seen as payload_seen
from dehyst.sim.effects.sampled_lags import lags_of_response, second_lag
from dehyst.sim.effects.saturation import Saturation
from dehyst.sim.effects.saturation import seen as saturation_seen
from dehyst.sim.effects.sensor_lag import SensorLag
from dehyst.sim.effects.slew_limit import seen as slew_seen
from dehyst.sim.effects.thermal_drift import in_rests as drift_in_rests
from dehyst.sim.effects.timing import Clock
from dehyst.sim.effects.timing import seen as timing_seen
from dehyst.sim.fitting.calibration import with_new_columns
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.readings.cycles import mirrored_branches
from dehyst.sim.readings.noise import noise_floor
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.ringing import Ringing, ringing
from dehyst.sim.readings.slow_motion import rests_over_time
from tests.hidden.foreign.cases import healthy, pair, single
from tests.hidden.foreign.record import Case, Rig
from tests.hidden.foreign.score import nominal_of, recording_of

#: Elasto-slide elements that begin relaxed and a bent sensor, at 500 Hz: a sample is longer than the stage's lag.
CURVED = single(18)
#: A stage that moved before the record creeps on from there: a linearised guess of creep overshoots.
CREEPING = Case(
    "single",
    703,
    Rig(703000, "bouc_wen", True, "excitation", "white", 3000.0, 20.0, 8.0, 86.9, 2.57e-3, False, 0.5, 0.0047, 4.2),
    {"creep": {"share": 0.0316, "power": 0.123}},
)
#: A stage that moved before the record; beside a large cause its memory at the start does not show at first.
SLEWED = Case(
    "single",
    756,
    Rig(756000, "bouc_wen", True, "excitation", "white", 2000.0, 20.0, 150.0, 36.7, 1.27e-3, True, 0.5, 0.0011, -0.57),
    {"slew_limit": {"rate_V_per_s": 4860.0}},
)
#: Sixty plays and branches that are not point-symmetric.
BOWED = Case(
    "single",
    1,
    Rig(1, "play_sum", False, "raster", "white", 1000.0, 20.0, 8.0, 85.0, 1.04e-3, False, 0.0, 0.0038, 4.0),
    {"asymmetry": {"share": -0.019}},
)
#: The nominal stage's own loop, with one cause by a formula of the generator's.
OWN_LOOP = Rig(3, "bouc_wen", False, "triangles", "white", 1000.0, 30.0, 100.0, 60.0, 1.5e-3, False, 0.0, 0.0018, 1.0)
WITH_A_BOW = Case("single", 3, replace(OWN_LOOP, drive="staircase"), {"asymmetry": {"share": 0.0086}})
WIDENED = Case("single", 3, OWN_LOOP, {"rate_dependence": {"per_decade": 0.06, "corner_per_s": 0.3}})
#: Heat through a thick wall, beside a loop that was used before.
WARMED = single(403)
#: A second lag: much like the stage's own on sixty plays; and on relays, at half a sample and less.
EQUAL_LAGS = Case(
    "single",
    62,
    Rig(62, "play_sum", False, "steps_and_sines", "white", 500.0, 40.0, 10.0, 60.0, 2.7e-3, False, 0.0, 0.003, 1.0),
    {"amplifier_lag": {"tau_s": 3.4e-3}},
)
SHORT_LAG = single(260)
#: A mode that hardly damps, moved far from where the stage file has it: it rings in every rest.
LOADED = Case(
    "single",
    4,
    replace(OWN_LOOP, drive="staircase", fs_hz=2000.0, duration_s=15.0, lag_s=0.0),
    {"payload_change": {"known_Hz": 93.7, "damping": 0.008, "ratio": 0.57, "from_share": 0.0}},
)
#: A staircase with one level beyond the amplifier's limit: there is no slope to be flat.
ONE_LEVEL = Case(
    "single",
    704,
    Rig(704000, "preisach", False, "staircase", "white", 500.0, 50.0, 8.0, 89.7, 2.9e-3, False, 0.5, 0.003, 3.0),
    {"saturation": {"top_V": 7.5252310818518735}},
)
#: A mode that moves midway, after which there are sines alone, on relays; and one that was loaded before, behind a lag.
MOVED_MIDWAY = single(777)
LOADED_AND_LAGGING = pair(778)
#: A drift of half a percent under a multisine, on sixty plays that were used before.
DRIFTING = single(783)
#: The voltage's last 2 % are clipped on a loop that bends; and a payload that rings, where nothing is clipped.
CLIPPED, RINGING = single(763), pair(614)
#: The top of a raster is clipped while a sensor's bow is slow at the bottom: a limit shows at neither end.
SLOW_BOTTOM = single(820)
#: A limit of the speed beside a late reading: both bend the response, and neither is a lag.
SLEWED_AND_LATE = pair(816)
#: Slips beside a loop of another class, which calls for slips of its own as long as it is not named.
SLIPPED = single(829)
#: The stage file's own loop, used before the record, under a payload; and with a clipped voltage besides.
USED_AND_LOADED, USED_AND_CLIPPED = single(701), pair(818)
#: A sensor's lag beside the stage's own: calibrated alone, the stage's stands at its bound.
TWO_LAGS = single(792)
#: A bow that only cycles over the whole range pass, and there are two of them.
BOW_BETWEEN = single(733)
#: A second lag and a mode under a multisine: the response bends, and not clearly enough to measure the lag.
UNCLEAR_LAG = pair(705)
#: A drift that four rests show faintly, beside a lag.
FAINT = pair(834)
#: Stick slip on a stage that begins at rest.
BEGINS_AT_REST = pair(836)
#: A fast clock: under sines the description of late readings takes their lateness over; and beside creep.
FAST_CLOCK, FAST_CLOCK_BESIDE_CREEP = single(867), pair(820)
#: No clock error, but a loop that is described badly: a rate dependence, and stick slip.
NO_CLOCK = (single(672), single(833))
#: A limit that only the largest steps reach.
JUST_REACHED = single(851)
#: A mode that a payload has moved rings in every rest, beside a lag of two samples that the response is too narrow for.
RINGS_BESIDE_A_LAG = pair(852)
#: Two lags: on a loop of the stage's own class, and on relays.
TWO_LAGS_NO_DELAY = (pair(851), single(860))
#: A lag of the amplifier beside creep, with held voltages: calibrated alone, lag, latch and hold all imitate it.
LAG_AND_CREEP = pair(934)
#: A gain that drifts on a loop that bends: each explains too little without the other.
DRIFT_AND_BEND = single(958)
#: Heat that sets in at once, of which the rests of the second half show little; and a drift under a multisine.
EARLY_HEAT, STEADIED = single(973), single(954)
#: Held voltages: calibrated alone, a voltage that runs linearly fits better, and the lag is driven away.
HELD = pair(988)
#: Nothing hidden, under a multisine with held voltages at 500 Hz: a voltage that runs linearly fits at first.
HELD_AT_FIRST = healthy(716)
#: No second lag: relays under a staircase whose steps are read in the middle of a sample.
ONE_LAG = single(163)

#: A limit of the voltage between the two highest levels of a staircase.
CUT_OFF_ONE_LEVEL = single(1029)
#: A second lag that the response gives to a few per cent of the fitted one.
FAINT_LAG = pair(1033)
#: A rate dependence whose growth is open but whose corner is known, behind a delay.
KNOWN_CORNER = pair(1026)
#: A loop that makes more of the response than its two lags.
CROOKED = pair(1032)
#: A clock error on a record of 10 kHz, on which a sample moves little.
LATE_BY_LITTLE = pair(1030)


def readings_of(case: Case) -> Readings:
    """A case as the direct tests see it."""
    prepared = prepare(recording_of(case), nominal=nominal_of(case))
    data = with_nominal_kind(prepared.nominal, prepared.data)
    return Readings(data, prepared.mask, noise_floor(data).sigma_um)


def diagnosed(case: Case) -> Diagnosis:
    return diagnose_prepared(prepare(recording_of(case), nominal="bouc_wen"))


def test_the_memory_at_the_start_is_chosen_by_fits_that_have_converged() -> None:
    prepared = prepare(recording_of(CURVED), nominal="bouc_wen")
    base = with_new_columns(calibrate_nominal("bouc_wen", prepared.data, prepared.mask), prepared.mask)
    shape = HysteresisShape()
    start = np.zeros(len(shape.parameters(prepared.data)))
    chosen, _ = first_fits(shape, start, base, prepared.mask)
    assert isinstance(chosen, HysteresisShape)
    assert chosen.before_V == 0.0


@pytest.mark.long
def test_a_payload_is_looked_for_where_the_stage_rings() -> None:
    said = diagnose_prepared(prepare(recording_of(LOADED), nominal=nominal_of(LOADED)))
    assert [cause.name for cause in said.causes] == ["payload_change"]
    assert abs(said.causes[0].parameters["payload_ratio"] - 0.57) < 0.01
    assert said.extended_heldout_um < 2.0 * LOADED.rig.sigma_um
    assert said.noise_floor_um < 2.0 * LOADED.rig.sigma_um


def rung(readings: Readings) -> Ringing:
    """The stretches in which the stage rings, where they show a payload."""
    assert payload_seen(readings).seen is True
    found = ringing(readings.data)
    assert found is not None
    return found


def test_the_frequency_at_which_the_stage_rings_dates_and_weighs_a_payload() -> None:
    own = MOVED_MIDWAY.effects["payload_change"]
    found = rung(readings_of(MOVED_MIDWAY))
    change = found.change()
    assert change is not None
    k, before, after = change
    assert abs(before.f_hz / own["known_Hz"] - 1.0) < 0.001
    assert abs((before.f_hz / after.f_hz) ** 2 - 1.0 - own["ratio"]) < 0.015
    at_s = own["from_share"] * MOVED_MIDWAY.rig.duration_s
    assert found.begin_s[k - 1] < at_s < found.end_s[k]


def test_a_payload_that_was_there_before_is_seen_against_the_stage_file_through_a_lag() -> None:
    own = LOADED_AND_LAGGING.effects["payload_change"]
    readings = readings_of(LOADED_AND_LAGGING)
    found = rung(readings)
    assert found.change() is None
    assert abs(found.level().f_hz * np.sqrt(1.0 + own["ratio"]) / own["known_Hz"] - 1.0) < 0.002
    # The stage of this file has no lag of its own: the first one is the sensor's.
    assert second_lag(readings).seen is True


@pytest.mark.parametrize("case", [MOVED_MIDWAY, LOADED_AND_LAGGING], ids=["white", "lagging"])
def test_a_stage_that_rings_where_its_file_says_carries_no_payload(case: Case) -> None:
    unloaded = replace(case, effects=case.effects | {"payload_change": case.effects["payload_change"] | {"ratio": 0.0}})
    assert payload_seen(readings_of(unloaded)).seen is False
    assert payload_seen(readings_of(WITH_A_BOW)).seen is None


def test_a_limit_is_seen_on_the_way_back_from_it_and_not_where_the_stage_rings() -> None:
    assert saturation_seen(readings_of(CLIPPED)).seen is True
    assert saturation_seen(readings_of(RINGING)).seen is not True


def test_one_end_without_a_limit_does_not_exclude_one_at_the_other() -> None:
    assert saturation_seen(readings_of(SLOW_BOTTOM)).seen is None


def test_a_response_behind_a_limit_of_the_speed_shows_no_lag() -> None:
    readings = readings_of(SLEWED_AND_LATE)
    assert second_lag(readings).seen is None
    assert "limit of the speed" in second_lag(readings).words


@pytest.mark.long
def test_slips_that_a_wrong_loop_called_for_are_dropped_beside_a_better_one() -> None:
    said = diagnosed(SLIPPED)
    assert {cause.name for cause in said.causes} == {"timing", "hysteresis_shape"}


@pytest.mark.long
def test_two_lags_are_told_apart_where_the_calibration_found_their_sum() -> None:
    said = diagnosed(TWO_LAGS)
    assert [cause.name for cause in said.causes] == ["sensor_lag"]
    low_s, high_s = said.causes[0].intervals["tau_s"]
    assert any(low_s < true_s < high_s for true_s in (TWO_LAGS.effects["sensor_lag"]["tau_s"], TWO_LAGS.rig.lag_s))
    assert said.extended_heldout_um < 1.2 * said.noise_floor_um


@pytest.mark.long
def test_a_payload_is_weighed_against_the_stated_frequency() -> None:
    """Calibration may move a stated mode by 1.5 %, which a payload throughout cannot be told from."""
    case = single(796)
    said = diagnose_prepared(prepare(recording_of(case), nominal=nominal_of(case)))
    low, high = next(cause.intervals["payload_ratio"] for cause in said.causes if cause.name == "payload_change")
    assert low < case.effects["payload_change"]["ratio"] < high
    assert high - low < 0.01


@pytest.mark.long
@pytest.mark.parametrize("case", [USED_AND_LOADED, USED_AND_CLIPPED], ids=["payload", "saturation_too"])
def test_the_stage_of_a_file_may_have_moved_before_the_record(case: Case) -> None:
    """Its loop does not begin relaxed then; a loop of another shape would imitate that."""
    said = diagnose_prepared(prepare(recording_of(case), nominal=nominal_of(case)))
    assert {cause.name for cause in said.causes} == set(case.hidden)
    assert said.extended_heldout_um < 1.25 * max(said.noise_floor_um, case.rig.sigma_um)


@pytest.mark.long
def test_a_finer_shape_is_fitted_again_beside_a_drift_without_which_it_held_out_worse() -> None:
    said = diagnosed(DRIFTING)
    assert {cause.name for cause in said.causes} == {"hysteresis_shape", "thermal_drift"}
    assert said.extended_heldout_um < 0.0015


@pytest.mark.long
def test_a_lag_that_the_wrong_loop_drove_away_comes_back() -> None:
    said = diagnosed(CURVED)
    lag_s = dict(zip((s.name for s in said.extended.model.parameters), said.extended.p, strict=True))["tau_s"]
    assert abs(lag_s - CURVED.rig.lag_s) < 0.1 * CURVED.rig.lag_s
    assert {c.name for c in said.causes} <= {"hysteresis_shape", "sensor_nonlinearity", "asymmetry"}
    assert said.extended_heldout_um < 1.5 * said.noise_floor_um


@pytest.mark.long
def test_one_level_beyond_the_limit_shows_a_saturation() -> None:
    said = diagnosed(ONE_LEVEL)
    assert {"saturation"} <= {c.name for c in said.causes} <= {"saturation", "hysteresis_shape"}
    limit = next(c for c in said.causes if c.name == "saturation").parameters["u_max_V"]
    assert abs(limit - 7.525) < 0.02
    assert said.extended_heldout_um < 1.25 * said.noise_floor_um


def test_cycles_over_a_part_of_the_range_do_not_exclude_a_bow() -> None:
    readings = readings_of(BOW_BETWEEN)
    assert mirrored_branches(readings).seen is None


@pytest.mark.long
def test_a_loop_with_weights_that_go_with_the_voltage_does_not_take_the_name_of_an_asymmetry_that_is_seen() -> None:
    said = diagnosed(BOWED)
    assert "asymmetry" in {name for c in said.causes for name in (c.name, *c.alternatives)}


@pytest.mark.long
@pytest.mark.parametrize("case", [WITH_A_BOW, WIDENED, WARMED, CREEPING, SLEWED], ids=lambda case: case.hidden[0])
def test_what_the_form_of_a_cause_leaves_is_not_another_cause(case: Case) -> None:
    said = diagnosed(case)
    assert [c.name for c in said.causes] == list(case.hidden)
    assert said.extended_heldout_um < 1.25 * said.noise_floor_um


@pytest.mark.parametrize(("case", "lagged"), [(EQUAL_LAGS, True), (SHORT_LAG, True), (ONE_LAG, False)])
def test_a_second_lag_is_seen_in_the_response_as_the_recorder_samples_it(case: Case, lagged: bool) -> None:
    readings = readings_of(case)
    assert second_lag(readings).seen is lagged
    # What lags is not late: these readings are taken within a sample.
    assert lags_of_response(readings).late is False


def test_a_response_that_bends_unclearly_does_not_exclude_a_lag() -> None:
    readings = readings_of(UNCLEAR_LAG)
    assert second_lag(readings).seen is None


@pytest.mark.parametrize(("case", "ppm"), [(FAST_CLOCK, 190.2), (FAST_CLOCK_BESIDE_CREEP, 73.9)])
def test_a_clock_error_is_seen_when_what_the_description_took_over_is_taken_off(case: Case, ppm: float) -> None:
    assert case.effects["timing"]["ppm"] == pytest.approx(ppm, abs=0.1)
    sight = timing_seen(readings_of(case))
    assert sight.seen is True
    said = re.search(r"changes by (-?[\d.]+)", sight.words)
    assert said is not None
    assert -float(said[1]) == pytest.approx(ppm, abs=10.0)


@pytest.mark.parametrize("case", NO_CLOCK)
def test_lateness_that_describes_the_readings_worse_is_no_clock_error(case: Case) -> None:
    assert timing_seen(readings_of(case)).seen is None


def test_a_limit_that_steps_may_just_have_reached_is_not_excluded() -> None:
    assert slew_seen(readings_of(JUST_REACHED)).seen is None


def test_a_response_that_a_lag_of_half_a_sample_would_not_bend_does_not_exclude_one() -> None:
    assert second_lag(readings_of(RINGS_BESIDE_A_LAG)).seen is None


@pytest.mark.parametrize("case", TWO_LAGS_NO_DELAY)
def test_two_lags_are_not_seen_as_a_delay(case: Case) -> None:
    found = lags_of_response(readings_of(case))
    assert found.lagged is True
    assert found.late is None


@pytest.mark.long
def test_a_lag_is_found_below_what_rang_until_the_payload_was_found() -> None:
    record = recording_of(RINGS_BESIDE_A_LAG)
    first = record.part(0, round(0.4 * len(record)))
    said = diagnose_prepared(prepare(first, nominal=nominal_of(RINGS_BESIDE_A_LAG)))
    named = {cause.name: cause for cause in said.causes}
    assert set(RINGS_BESIDE_A_LAG.hidden) <= set(named) <= set(RINGS_BESIDE_A_LAG.hidden) | RINGS_BESIDE_A_LAG.allowed
    low, high = named["amplifier_lag"].intervals["tau_s"]
    assert low < RINGS_BESIDE_A_LAG.effects["amplifier_lag"]["tau_s"] < high
    assert said.noise_floor_um < 4.0 * RINGS_BESIDE_A_LAG.rig.sigma_um


@pytest.mark.long
def test_the_hold_that_a_missing_lag_called_for_is_tried_anew() -> None:
    """Beside the wrong hold the latch stood at its bound, and a delay of a sample was named."""
    said = diagnosed(LAG_AND_CREEP)
    assert {c.name for c in said.causes} == {"amplifier_lag", "creep"}
    lag = next(c for c in said.causes if c.name == "amplifier_lag").parameters["tau_s"]
    assert lag == pytest.approx(LAG_AND_CREEP.effects["amplifier_lag"]["tau_s"], rel=0.003)


@pytest.mark.long
def test_two_causes_are_found_at_once_where_neither_explains_enough_alone() -> None:
    said = diagnosed(DRIFT_AND_BEND)
    drift = next(c for c in said.causes if c.name == "gain_drift").parameters["gain"]
    assert drift == pytest.approx(DRIFT_AND_BEND.effects["gain_drift"]["total"], rel=0.05)
    assert {c.name for c in said.causes} <= {"gain_drift", "sensor_nonlinearity", "asymmetry", "hysteresis_shape"}
    assert said.extended_heldout_um < 0.06 * said.nominal_heldout_um


def test_the_hold_is_the_one_that_fits_best_with_its_own_lag() -> None:
    prepared = prepare(recording_of(HELD_AT_FIRST))
    fit = calibrate_nominal("bouc_wen", with_nominal_kind("bouc_wen", prepared.data), prepared.mask)
    numbers = dict(zip((s.name for s in fit.model.parameters), fit.p, strict=True))
    assert (fit.model.nominal.hold, round(numbers["latch_samples"], 2)) == ("zero", 0.0)
    assert numbers["tau_s"] == pytest.approx(HELD_AT_FIRST.rig.lag_s, rel=0.01)


@pytest.mark.long
def test_the_stages_own_lag_is_not_named_as_a_second_one() -> None:
    """Without the lag that was found, the stage's own comes back under the other hold."""
    said = diagnosed(HELD)
    assert {c.name for c in said.causes} == {"hysteresis_shape", "cross_talk", "saturation"}
    lag_s = dict(zip((s.name for s in said.extended.model.parameters), said.extended.p, strict=True))["tau_s"]
    assert lag_s == pytest.approx(HELD.rig.lag_s, rel=0.01)


def test_rests_of_the_second_half_do_not_exclude_a_drift_in_the_first() -> None:
    assert drift_in_rests(readings_of(EARLY_HEAT)).seen is None


@pytest.mark.long
def test_what_only_steadies_an_earlier_cause_in_held_out_stretches_is_no_cause() -> None:
    """Plays of 0.2 nm took 57 % off the held-out error of a drift, and 4 % off that of the fit."""
    assert {c.name for c in diagnosed(STEADIED).causes} == {"thermal_drift"}


@pytest.mark.long
def test_a_faint_drift_of_the_rests_counts_as_seen_where_the_fit_has_its_size() -> None:
    sight = drift_in_rests(readings_of(FAINT))
    assert sight.seen is None
    said = diagnosed(FAINT)
    named = {cause.name: cause for cause in said.causes}
    assert set(FAINT.hidden) <= set(named) <= set(FAINT.hidden) | FAINT.allowed
    witness = named["thermal_drift"].witness
    assert witness is not None
    assert witness.seen is True
    assert witness.words.startswith(sight.words)


def test_a_start_that_is_not_judged_is_no_larger_than_what_moves_in_it() -> None:
    """Free to grow until the end of its tail fits, it bent the fit that a further cause needs."""
    prepared = prepare(recording_of(BEGINS_AT_REST), nominal="bouc_wen")
    data = prepared.data
    start = BoucWenStage("zero", free_memory=True).parameters(data)[-1]
    first = data.y_um[data.t_s - data.t_s[0] < 0.02]
    assert start.name == "start_um"
    assert start.high == pytest.approx(np.ptp(first), rel=0.3)


@pytest.mark.parametrize("seed", [741, 760])
def test_creep_on_a_loop_whose_steps_differ_is_not_seen_as_a_drift_of_the_gain(seed: int) -> None:
    """A step over a steep part of the loop is larger than its voltage, and creeps by more."""
    case = single(seed)
    assert case.hidden == ("creep",)
    readings = readings_of(case)
    assert in_rests(readings).seen is not True
    found = rests_over_time(readings).creep
    assert found is not None
    assert found.value > 10.0 * found.error


@pytest.mark.parametrize(
    "case",
    [CUT_OFF_ONE_LEVEL, KNOWN_CORNER,
     pytest.param(FAINT_LAG, marks=pytest.mark.xfail(reason="an asymmetry is named beside it"))],
    ids=lambda case: case.hidden[-1],
)  # fmt: skip
def test_what_is_hidden_beside_a_foreign_loop_is_named(case: Case) -> None:
    said = diagnosed(case)
    named = {name for c in said.causes for name in (c.name, *c.alternatives)}
    assert set(case.hidden) <= named
    assert {c.name for c in said.causes} <= {*case.hidden, "hysteresis_shape"}


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


def test_a_response_that_lags_do_not_describe_excludes_none() -> None:
    assert second_lag(readings_of(CROOKED)).seen is None


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
