"""A follower that corrects by fresh readings: what it pairs, when it lets go, and that it makes no step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dehyst.service.answers.correcting import Correcting
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.client.follower import Follower
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.model import ModelMessage, Safety, decode_model, encode_model
from dehyst.service.protocol.query import OUTSIDE_DOMAIN
from tests.service.conftest import make_models

DT_S = 1e-3
LIMITS = Limits(0.0, 10.0, 2000.0, -5.0, 95.0)
CONFIG = CorrectionConfig(on=True, mode_Hz=200.0, fade_s=0.1)
MODEL = make_models()["lssvm_adaptive"]
#: The model's stated deviation is 1 mV here, so that a correction of 4 mV is its bound: 0.04 µm.
OFFSET_UM = 0.02


def message(safety: Safety | None = None, model: Any = MODEL) -> bytes:
    return encode_model("lssvm_adaptive", model, 5, MODEL.rest_memory(40.0), safety)


def follower(config: CorrectionConfig | None = CONFIG) -> Follower:
    correcting = None if config is None else Correcting(config, LIMITS, DT_S)
    return Follower(None, None, "lssvm_adaptive", message, LIMITS, correcting=correcting)  # type: ignore[arg-type]


def wanted(n: int) -> np.ndarray:
    return 40.0 + 20.0 * np.sin(2.0 * np.pi * np.arange(n) * DT_S)


def drive(
    follower: Follower, n: int, age: int = 1, first: int = 0, read: Callable[[int, float], float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(voltages, errors) of a stage that does what the model says, but ``OFFSET_UM`` above. ``read`` : its sensor."""
    ideal = Follower(None, None, "lssvm_adaptive", message, LIMITS)  # type: ignore[arg-type]
    y = wanted(first + n)
    slope = LIMITS.u_max_V / 110.0
    u_V, error_um = np.zeros(n), np.zeros(n)
    for k in range(n):
        if k >= age:
            seen = first + k - age
            reading = y[seen] - error_um[k - max(age, 1)]
            follower.read(seen, reading if read is None else read(seen, reading))
        u_V[k] = follower.point(y[first + k], seq=first + k)
        error_um[k] = -OFFSET_UM - (u_V[k] - ideal.point(y[first + k])) / slope
    return u_V, error_um


def test_an_offset_is_corrected_to_nothing_and_without_readings_it_stays() -> None:
    _, error_um = drive(follower(), 600)
    assert abs(error_um[0]) == pytest.approx(OFFSET_UM)
    assert np.abs(error_um[-100:]).max() < 0.02 * OFFSET_UM
    plain = follower(None)
    _, error_um = drive(plain, 600)
    np.testing.assert_allclose(error_um, -OFFSET_UM, atol=1e-12)
    assert plain.correcting is None


def test_the_age_is_that_of_the_stamps_and_sets_the_gain() -> None:
    gains = []
    for age in (0, 1, 5, 20):
        one = follower()
        drive(one, 200, age)
        assert one.correcting is not None
        assert one.correcting.age == age
        gains.append(one.correcting.correction.loop.gain_per_s)
    assert gains == sorted(gains, reverse=True)
    assert gains[-1] < 0.5 * gains[0]


def test_the_age_follows_readings_that_come_sooner_again() -> None:
    one = follower()
    drive(one, 50, 20)
    drive(one, 1200, 2, first=50)
    assert one.correcting is not None
    assert one.correcting.age == 2


def test_a_reading_is_compared_with_what_was_asked_for_at_its_own_sample() -> None:
    """A motion of 126 µm/s read 20 samples late is off by 2.5 µm at each instant, and right where it belongs."""
    one = follower()
    _, error_um = drive(one, 1500, 20)
    assert np.abs(error_um[-100:]).max() < 0.05 * OFFSET_UM
    assert one.correcting is not None
    assert one.correcting.correction.doubted == 0


def test_where_the_voltage_was_limited_a_reading_says_nothing() -> None:
    """A limit 0.1 mV below what is needed: the residual is as small as an error of the model."""
    one = follower()
    for k in range(200):
        last_V = one.point(40.0, seq=k)
        one.read(k, 40.0 + 1e-3)
    assert one.correcting is not None
    one.limits = replace(LIMITS, u_max_V=last_V - 1e-4)
    one.point(40.0, seq=200)
    before_V, doubted = one.correcting.correction.u_V, one.correcting.correction.doubted
    for k in range(200, 250):
        one.read(k, 40.0 - 1e-3)
        one.point(40.0, seq=k + 1)
    assert one.correcting.correction.u_V == before_V
    assert one.correcting.correction.doubted == doubted + 50


def test_points_with_flags_teach_what_repeats_and_not_the_integral() -> None:
    one = Correcting(CONFIG, LIMITS, DT_S, RepetitionConfig(on=True, mode_Hz=200.0))
    memory, zero = MODEL.rest_memory(40.0), np.zeros(1)
    assert one.repetition is not None
    assert one.correction is not None
    one.repetition.state(0.05)
    for k in range(500):
        y_um = 40.0 + math.sin(2.0 * math.pi * k / 50.0)
        if k:
            one.read(k - 1, 40.0 + 0.98 * math.sin(2.0 * math.pi * (k - 1) / 50.0))
        one.voltage(k, MODEL, (np.array([y_um]), zero, zero), memory, (np.array([y_um]), 1.0))
        one.applied(k, np.array([y_um + one.repetition.u_V]))
        one.leave_out(k, np.full(1, OUTSIDE_DOMAIN))
    assert one.repetition.active
    assert one.repetition.doubted == 0
    assert one.correction.doubted > 0
    assert (one.correction.u_V, abs(one.repetition.u_V) > 0.0) == (0.0, True)


@pytest.mark.parametrize("bad", [math.nan, 39.0])
def test_single_wrong_readings_change_nothing(bad: float) -> None:
    clean, spiked = follower(), follower()
    _, without = drive(clean, 400)
    _, error_um = drive(spiked, 400, read=lambda seq, y: bad if seq % 50 == 49 else y)
    assert np.abs(error_um[-100:]).max() < 0.05 * OFFSET_UM
    assert np.abs(error_um - without).max() < 0.1 * OFFSET_UM


def test_a_named_trouble_lets_the_correction_go_over_its_time_and_its_end_brings_it_back() -> None:
    one = follower()
    drive(one, 400)
    assert one.correcting is not None
    carried_V = one.correcting.correction.u_V
    one._take(decode_model(message(Safety(trouble="sensor_gain"))))
    u_V, _ = drive(one, 150, first=400)
    assert one.correcting.trouble == "sensor_gain"
    assert one.correcting.correction.u_V == 0.0
    without = follower(None)
    drive(without, 400)
    added_V = u_V - drive(without, 150, first=400)[0]
    assert np.abs(np.diff(added_V)).max() < 0.02 * abs(carried_V)
    one._take(decode_model(message(Safety())))
    drive(one, 400, first=550)
    assert one.correcting.correction.u_V == pytest.approx(carried_V, rel=0.02)


def test_switched_off_and_on_again_it_makes_no_step() -> None:
    one = follower()
    parts = [drive(one, 300)[0]]
    assert one.correcting is not None
    for on in (False, True):
        one.correcting.on = on
        parts.append(drive(one, 300, first=300 * len(parts))[0])
    added_V = np.concatenate(parts) - drive(follower(None), 900)[0]
    assert np.abs(np.diff(added_V)).max() < 0.1 * np.abs(added_V).max()
    assert added_V[580] == pytest.approx(0.0, abs=1e-12)


def test_what_a_new_model_takes_over_leaves_the_correction() -> None:
    one = follower()
    drive(one, 400)
    assert one.correcting is not None
    carried_V = one.correcting.correction.u_V
    beta = MODEL.beta.copy()  # type: ignore[attr-defined]
    beta[0] += 0.75 * carried_V
    one._take(decode_model(message(None, replace(MODEL, beta=beta))))  # type: ignore[type-var]
    one.point(wanted(401)[-1], seq=400)
    assert one.correcting.correction.u_V == pytest.approx(0.25 * carried_V)


def test_a_follower_that_begins_on_a_driven_stage_goes_on_from_its_voltage() -> None:
    one = follower()
    u_V, _ = drive(one, 400)
    again = follower()
    y = wanted(401)
    again.resynchronise(np.arange(400), u_V, y[:400] + 0.0)
    assert again.point(y[400], seq=400) == pytest.approx(one.point(y[400]), abs=0.2e-3)


def test_a_block_of_points_carries_one_correction() -> None:
    one = follower()
    drive(one, 300)
    u_V, _ = one.trajectory(np.full(5, 40.0), np.zeros(5), np.zeros(5), seq=300)
    plain = follower(None)
    drive(plain, 300)
    without_V, _ = plain.trajectory(np.full(5, 40.0), np.zeros(5), np.zeros(5))
    assert one.correcting is not None
    np.testing.assert_allclose(u_V - without_V, one.correcting.correction.u_V, atol=1e-12)
    assert one._number == 305


@pytest.mark.parametrize(
    ("seq", "y_um", "wrong"),
    [
        ([3, 4], [1.0], "y_um: got 1 values, expected 2"),
        ([4, 4], [1.0, 1.0], "seq: got .*expected rising"),
        ([3.5], [1.0], "seq: got .*expected whole numbers"),
    ],
)
def test_readings_that_cannot_be_are_refused_and_change_nothing(seq: Any, y_um: Any, wrong: str) -> None:
    one = follower()
    drive(one, 10)
    with pytest.raises(FieldError, match=wrong):
        one.read(seq, y_um)
    assert one.correcting is not None
    assert not one.correcting._readings


def test_an_axis_without_a_range_has_no_correction() -> None:
    with pytest.raises(FieldError, match=r"y_min_um.*expected the displacement range"):
        Correcting(CONFIG, Limits(0.0, 10.0, 2000.0), DT_S)


def test_a_trouble_travels_with_the_model_and_is_nothing_while_all_is_well() -> None:
    """Where nothing is wrong the payload is the one of before: older clients and the vectors know no such entry."""
    assert b"trouble" not in message(Safety())
    told = decode_model(message(Safety(trouble="sensor_stuck")))
    assert (told.safety.trouble, decode_model(message(Safety())).safety.trouble) == ("sensor_stuck", "")


def test_an_older_or_newer_service_is_understood() -> None:
    assert Correcting.of_status({}, LIMITS, DT_S) is None
    assert Correcting.of_status({"correction": None}, LIMITS, DT_S) is None
    one = Correcting.of_status({"correction": {"on": True, "new": 1}}, LIMITS, DT_S)
    assert one is not None
    assert one.repetition is None
    one = Correcting.of_status({"correction": None, "repetition": {"on": True, "new": 1}}, LIMITS, DT_S)
    assert one is not None
    assert (one.correction, one.repetition is None) == (None, False)
    with pytest.raises(FieldError, match=r"status.correction.fade_s: got '1', expected 0.01 to 60 s"):
        Correcting.of_status({"correction": {"fade_s": "1"}}, LIMITS, DT_S)


REPEATS = RepetitionConfig(on=True, mode_Hz=200.0, fade_s=0.1)
#: Samples of a pass, not a whole number of them.
PERIOD = 66.6667


def raster(n: int) -> np.ndarray:
    return 40.0 + 10.0 * np.sin(2.0 * np.pi * np.arange(n) / PERIOD)


def repeating(config: CorrectionConfig | None = None) -> Follower:
    correcting = Correcting(config or CorrectionConfig(), LIMITS, DT_S, REPEATS)
    return Follower(None, None, "lssvm_adaptive", message, LIMITS, correcting=correcting)  # type: ignore[arg-type]


def rasters(
    follower: Follower, n: int, first: int = 0, read: Callable[[int, float], float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(voltages, errors) along `raster` of a stage that follows the model but for a wave of 0.2 µm."""
    ideal = Follower(None, None, "lssvm_adaptive", message, LIMITS)  # type: ignore[arg-type]
    y = raster(first + n)
    wave = 0.2 * np.sin(4.0 * np.pi * np.arange(first + n) / PERIOD + 1.0)
    slope = LIMITS.u_max_V / 110.0
    u_V, error_um = np.zeros(n), np.zeros(n)
    for k in range(n):
        seq = first + k
        if k:
            reading = y[seq - 1] - error_um[k - 1]
            follower.read(seq - 1, reading if read is None else read(seq - 1, reading))
        u_V[k] = follower.point(y[seq], seq=seq)
        error_um[k] = -wave[seq] - (u_V[k] - ideal.point(y[seq])) / slope
    return u_V, error_um


@pytest.mark.parametrize("config", [None, CONFIG])
def test_motion_that_repeats_is_corrected_by_the_pass_before(config: CorrectionConfig | None) -> None:
    one = repeating(config)
    _, error_um = rasters(one, 1400)
    assert one.correcting is not None
    repetition = one.correcting.repetition
    assert repetition is not None
    assert repetition.period == pytest.approx(PERIOD, abs=0.01)
    assert repetition.active
    assert np.abs(error_um[-70:]).mean() < 0.05 * np.abs(error_um[:70]).mean()
    integral = one.correcting.correction
    assert (integral is None) == (config is None)
    if integral is not None:  # it stays as it is: the convergence is tested without it
        held_V = integral.u_V
        rasters(one, 100, first=1400)
        assert integral.u_V == held_V


def test_a_period_can_be_stated_and_blocks_of_points_are_corrected_too() -> None:
    one, plain = repeating(), follower(None)
    assert one.correcting is not None
    assert one.correcting.repetition is not None
    one.correcting.repetition.state(PERIOD * DT_S)
    rasters(one, 1000)
    rasters(plain, 1000)
    y = raster(1020)[1000:]
    zeros = np.zeros(20)
    added_V = one.trajectory(y, zeros, zeros, seq=1000)[0] - plain.trajectory(y, zeros, zeros)[0]
    wave_V = 0.2 * LIMITS.u_max_V / 110.0 * np.sin(4.0 * np.pi * np.arange(1000, 1020) / PERIOD + 1.0)
    np.testing.assert_allclose(added_V, -wave_V, atol=1.5e-3)


def test_a_named_trouble_and_off_let_the_repetition_go() -> None:
    one = repeating()
    rasters(one, 1000)
    assert one.correcting is not None
    repetition = one.correcting.repetition
    assert repetition is not None
    carried_V = abs(repetition.u_V)
    one._take(decode_model(message(Safety(trouble="sensor_stuck"))))
    added_V = rasters(one, 60, first=1000)[0] - rasters(follower(None), 1060)[0][1000:]
    assert (repetition.active, repetition.u_V) == (False, 0.0)
    assert np.abs(np.diff(added_V)).max() < max(carried_V, 0.02) / 2.0
    one._take(decode_model(message(Safety())))
    rasters(one, 400, first=1060)
    assert repetition.active
    one.correcting.on = False
    rasters(one, 60, first=1460)
    assert (repetition.active, repetition.u_V) == (False, 0.0)


def test_new_models_do_not_move_a_motion_that_repeats() -> None:
    """The learner goes on beside it: what it changes in its answer leaves the correction."""
    one = repeating()
    before_V, _ = rasters(one, 1000)
    beta = MODEL.beta.copy()  # type: ignore[attr-defined]
    beta[0] += 0.02
    one._take(decode_model(message(None, replace(MODEL, beta=beta))))  # type: ignore[type-var]
    assert one.point(raster(1001)[-1], seq=1000) == pytest.approx(
        np.interp(1000 - PERIOD, np.arange(1000), before_V), abs=5e-3
    )


SETTINGS = 'served = "lssvm_adaptive"\ncompete = []\n[axis.{}]\non = true\nmode_Hz = 200.0\nfade_s = 0.2\n'


@pytest.fixture
def client(serve: Any, request: pytest.FixtureRequest) -> Iterator[Client]:
    """Of a service with the correction, or whatever a test is parametrised by, switched on."""
    text = SETTINGS.format(getattr(request, "param", "correction"))
    with Client.connect(serve(extra=text).endpoint, timeout_s=5.0, wait_s=10.0) as connected:
        yield connected


@pytest.mark.e2e
def test_a_real_service_switches_it_on_and_a_stuck_sensor_lets_it_go(client: Client) -> None:
    """In lock step with a stage of 11 µm/V in this process, whose sensor sticks after some seconds."""
    followed = client.follow()
    assert followed.correcting is not None
    correction = followed.correcting.correction
    y = wanted(3000)
    v = np.gradient(y, DT_S)
    u_V, read_um, added_V = np.zeros(y.size), np.zeros(y.size), np.zeros(y.size)
    named = -1
    for k in range(y.size):
        if k:
            followed.read(k - 1, read_um[k - 1])
        u_V[k] = followed.point(y[k], v[k], seq=k)
        added_V[k] = correction.u_V
        read_um[k] = (11.0 * u_V[k] + 1.0) if k < 1500 else read_um[1499]
        if k % 5 == 4:
            part = np.arange(k - 4, k + 1)
            client.samples(part, part * DT_S, u_V[part], read_um[part])
            followed.wait(k - 24, 2.0)
        if named < 0 and followed.correcting.trouble:
            named = k
        if named >= 0 and k > named + 300:
            break
    assert isinstance(followed._newest[0], ModelMessage)
    assert followed.correcting.age == 1
    assert np.abs(added_V[100:1500]).max() > 0.0
    error_um = np.abs(read_um - y)[1000:1500]
    assert error_um.mean() < 0.05
    assert 1500 < named < 2500, client.status()["trouble"]
    assert followed.correcting.trouble == client.status()["trouble"]
    assert added_V[k] == 0.0


@pytest.mark.e2e
@pytest.mark.parametrize("client", ["repetition"], indirect=True)
def test_a_real_service_switches_the_repetition_on_while_it_learns(client: Client) -> None:
    """In lock step with a stage of 11 µm/V and a wave in time, which no model of the position can know."""
    followed = client.follow()
    assert followed.correcting is not None
    repetition = followed.correcting.repetition
    assert repetition is not None
    assert followed.correcting.correction is None
    n = 2200
    y = raster(n)
    v = np.gradient(y, DT_S)
    wave = 0.5 * np.sin(6.0 * np.pi * np.arange(n) / PERIOD)
    u_V, read_um = np.zeros(n), np.zeros(n)
    for k in range(n):
        if k:
            followed.read(k - 1, read_um[k - 1])
        u_V[k] = followed.point(y[k], v[k], seq=k)
        read_um[k] = 11.0 * u_V[k] + 1.0 + wave[k]
        if k % 5 == 4:
            part = np.arange(k - 4, k + 1)
            client.samples(part, part * DT_S, u_V[part], read_um[part])
            followed.wait(k - 24, 2.0)
    error_um = np.abs(read_um - y)
    assert repetition.active
    assert repetition.period == pytest.approx(PERIOD, abs=0.01)
    assert error_um[-200:].mean() < 0.05
    assert error_um[-200:].mean() < 0.3 * error_um[:134].mean()


def test_a_block_lets_go_as_many_samples_as_it_has() -> None:
    one = follower()
    drive(one, 300)
    assert one.correcting is not None
    assert one.correcting.integral_V
    one.correcting.on = False
    y = wanted(500)
    for first in range(300, 400, 20):  # fade_s is 100 samples
        one.trajectory(y[first : first + 20], seq=first)
    assert one.correcting.integral_V == 0.0
    again = follower()
    drive(again, 300)
    assert again.correcting is not None
    for first in range(300, 510, 30):  # twice fade_s: no reading, then let go
        again.trajectory(wanted(540)[first : first + 30], seq=first)
    assert again.correcting.integral_V == 0.0
