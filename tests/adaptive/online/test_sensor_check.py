"""Does the sensor follow the drive? The steps of the voltage against those that the model asks for at the readings."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest

from adaptive.online.sensor_trust import (
    CREEP_PER_S,
    FOLLOWING_SLOPES,
    OF_VOLTAGE,
    STEP_S,
    STEP_SIGMA,
    STILL_STEPS,
    Following,
)
from adaptive.types import FloatArray

SPAN_V = 10.0
#: Between two pairs, s.
EVERY_S = 4e-3


def asked(
    following: Following, u: FloatArray, p: FloatArray, every_s: float = EVERY_S, span_V: float = SPAN_V
) -> list[bool]:
    """What it says of (n,) voltages that were applied and those that the model asks for."""
    return [following.take(float(a), float(b), span_V, every_s) for a, b in zip(u, p.astype(np.float64), strict=True)]


def strokes(seconds: float, hertz: float = 1.0, share: float = 0.3) -> FloatArray:
    """(n,) V: a sine about the middle with an amplitude of a share of the span."""
    t_s = np.arange(round(seconds / EVERY_S)) * EVERY_S
    return SPAN_V * (0.5 + share * np.sin(2.0 * math.pi * hertz * t_s))


def first(said: list[bool]) -> int:
    return said.index(True) if True in said else -1


@pytest.mark.parametrize("slope", [1.05 * FOLLOWING_SLOPES[0], 0.9, 1.0, 1.35, 0.95 * FOLLOWING_SLOPES[1]])
@pytest.mark.parametrize("offset_V", [0.0, -6.0])
def test_a_sensor_that_follows_is_no_fault(slope: float, offset_V: float) -> None:
    """Whatever its offset, and with a gain that a stage and a model of another amplitude may have."""
    for hertz in (0.2, 1.0, 5.0):
        u = strokes(10.0, hertz)
        following = Following()
        assert not any(asked(following, u, slope * u + offset_V))
        assert following.good > 20


def test_hysteresis_and_turning_points_are_no_fault() -> None:
    """A model that knows no hysteresis at all: a loop as wide as a fifth of the stroke."""
    u = strokes(20.0, 1.0)
    p = u + 0.1 * np.ptp(u) * np.sign(np.gradient(u))
    assert not any(asked(Following(), u, p))


@pytest.mark.parametrize("slope", [-1.0, -0.3, 0.02, 0.3, 0.8 * FOLLOWING_SLOPES[0], 1.3 * FOLLOWING_SLOPES[1], 5.0])
def test_another_slope_or_sign_is_a_fault_within_a_tenth_of_the_span(slope: float) -> None:
    u = np.linspace(2.0, 8.0, 600)
    assert not FOLLOWING_SLOPES[0] <= slope <= FOLLOWING_SLOPES[1]
    following = Following()
    said = asked(following, u, slope * u)
    assert first(said) > 0
    assert abs(u[first(said)] - u[0]) < 0.1 * SPAN_V
    assert following.good == 0


def test_a_sensor_that_stops_is_found_after_some_steps_however_long_it_had_followed() -> None:
    u = strokes(20.0, 1.0)
    at = round(10.1 / EVERY_S)
    p = u.copy()
    p[at:] = p[at]
    following = Following()
    said = asked(following, u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(0.1 / EVERY_S)
    # Not after fewer than these: the model may be wrong about one stroke.
    following = Following()
    asked(following, u[:at], p[:at])
    still = 0
    for a, b in zip(u[at:], p[at:], strict=True):
        fault = following.take(float(a), float(b), SPAN_V, EVERY_S)
        still = max(still, following.still)
        if fault:
            break
    assert still == STILL_STEPS


def test_readings_that_have_nothing_to_do_with_the_voltage_are_a_fault() -> None:
    t_s = np.arange(1000) * EVERY_S
    u = SPAN_V * (0.5 + 0.3 * np.sin(2.0 * math.pi * 1.0 * t_s))
    p = SPAN_V * (0.5 + 0.3 * np.sin(2.0 * math.pi * 1.7 * t_s + 1.0))
    assert first(asked(Following(), u, p)) > 0


def test_readings_that_go_too_far_and_not_at_all_in_turns_are_a_fault() -> None:
    """On average they go as far as the voltage asks for; but that is no straight line."""
    u = 2.0 + 0.1 * np.arange(40)
    p = 2.0 + np.cumsum(np.tile([0.25, 0.25, 0.25, 0.25, -0.03], 8))
    following = Following()
    straight = []
    for a, b in zip(u, p, strict=True):
        fault = following.take(float(a), float(b), SPAN_V, STEP_S)
        if following.uu > 0.0 and FOLLOWING_SLOPES[0] < following.up / following.uu < FOLLOWING_SLOPES[1]:
            straight.append(fault)
    assert any(straight)


@pytest.mark.parametrize("seconds", [1.0, 60.0])
def test_a_gain_that_breaks_down_is_found_as_soon_after_a_minute_as_after_a_second(seconds: float) -> None:
    u = strokes(seconds + 1.0, 1.0)
    at = round(seconds / EVERY_S)
    p = np.where(np.arange(u.size) < at, u, u[at] + 0.35 * (u - u[at]))
    said = asked(Following(), u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(0.35 / EVERY_S)


def test_what_moves_while_the_voltage_rests_is_a_matter_of_surprise_and_not_of_following() -> None:
    """Somebody moves the table: readings go, the voltage does not. Nothing is said of the sensor."""
    u = np.full(1000, 5.0)
    p = 5.0 + 2.0 * np.sin(np.arange(1000) * 0.05)
    following = Following()
    assert not any(asked(following, u, p))
    assert following.uu < OF_VOLTAGE * following.count


@pytest.mark.parametrize("noise_share", [1e-4, 1e-3, 5e-3])
def test_noise_makes_the_steps_longer_and_no_fault(noise_share: float) -> None:
    """Of the model's answer, up to 0.5 % of the span; the steps that are compared become so many times as large."""
    u = strokes(60.0, 0.7)
    noise_V = noise_share * SPAN_V
    following = Following()
    rng = np.random.default_rng(1)
    steps: list[float] = []
    for a in u:
        before = following.u_V
        assert not following.take(float(a), float(a + noise_V * rng.standard_normal()), SPAN_V, EVERY_S)
        if following.u_V != before and not math.isnan(before):
            steps.append(abs(following.u_V - before))
    # The change from one pair to the next has twice the variance of the noise.
    assert math.sqrt(following.noise2) == pytest.approx(math.sqrt(2.0) * noise_V, rel=0.25)
    settled = steps[len(steps) // 2 :]
    assert np.median(settled) > 0.8 * STEP_SIGMA * noise_V
    assert following.good > 5


@pytest.mark.parametrize(("noise_share", "within_s"), [(1e-4, 0.1), (1e-3, 0.2), (5e-3, 1.0)])
def test_noise_does_not_hide_a_sensor_that_stands_still(noise_share: float, within_s: float) -> None:
    u = strokes(20.0, 0.7)
    rng = np.random.default_rng(2)
    noise = noise_share * SPAN_V * rng.standard_normal(u.size)
    at = u.size // 2
    p = u + noise
    p[at:] = p[at] + noise[at:]
    said = asked(Following(), u, p)
    assert not any(said[:at])
    assert 0 < first(said) - at < round(within_s / EVERY_S)


def test_a_single_wild_answer_does_not_make_it_deaf() -> None:
    """The noise is an average in which one pair counts for little: the steps stay short."""
    following = Following()
    u = strokes(4.0)
    p = u.copy()
    p[200] += 5.0 * SPAN_V
    asked(following, u[:240], p[:240])
    assert STEP_SIGMA * math.sqrt(following.noise2) < 0.05 * SPAN_V


@pytest.mark.parametrize("per_s", [0.2, 0.9])
def test_a_voltage_that_holds_a_creeping_stage_in_place_is_no_fault(per_s: float) -> None:
    """Readings stand still while the voltage goes on, slower than a stage is moved: for a minute, however far."""
    u = 3.0 + per_s * CREEP_PER_S * SPAN_V * np.arange(round(15.0 / EVERY_S)) * EVERY_S
    following = Following()
    assert not any(asked(following, u, np.full(u.size, 3.0)))
    assert following.count == 0.0
    # Faster than that it is one.
    u = 3.0 + 3.0 * CREEP_PER_S * SPAN_V * np.arange(round(3.0 / EVERY_S)) * EVERY_S
    assert any(asked(Following(), u, np.full(u.size, 3.0)))


def test_steps_are_no_shorter_than_ringing_lasts() -> None:
    """A voltage that swings with a mode of the stage, both within less time than a step takes: hardly compared."""
    every_s = 1e-3
    k = np.arange(2000)
    u = 5.0 + 0.5 * np.sin(2.0 * math.pi * 300.0 * k * every_s)
    following = Following()
    ends = 0
    for a in u:
        before = following.u_V
        following.take(float(a), 10.0 - float(a), SPAN_V, every_s)
        ends += following.u_V != before
    assert ends <= 2000 * every_s / STEP_S + 1


def test_a_span_of_any_size_is_asked_alike() -> None:
    u = np.linspace(0.2, 0.8, 600)
    said = [first(asked(Following(), span * u, 0.2 * span * u, span_V=span)) for span in (1e-3, 1.0, 10.0, 1000.0)]
    assert len(set(said)) == 1
    assert said[0] > 0


def test_what_is_no_number_is_no_answer_and_begins_anew() -> None:
    following = Following()
    u = strokes(4.0)
    p = u.copy()
    p[300:310] = math.nan
    assert not any(asked(following, u, p))
    assert following.good > 5
    assert math.isfinite(following.noise2)


def test_to_forget_is_to_begin_anew_but_for_the_noise() -> None:
    following, fresh = Following(), Following()
    u = strokes(3.0)
    asked(following, u, u + 0.02 * np.random.default_rng(3).standard_normal(u.size))
    noise2 = following.noise2
    following.forget()
    assert following.noise2 == noise2
    for one in fields(Following):
        if one.name != "noise2":
            now, then = (each.state_dict()[one.name] for each in (following, fresh))
            assert now == then or (math.isnan(now) and math.isnan(then))
    # A stage in another frame: nothing of the step is across the two.
    assert not any(asked(following, u, u + 7.0))


def test_state_goes_on_to_the_last_bit_and_an_old_one_is_that_of_a_beginning() -> None:
    u = strokes(10.0)
    p = np.where(np.arange(u.size) < 1800, u, u[1800]) + 0.01 * np.random.default_rng(4).standard_normal(u.size)
    one = Following()
    cut = 1812
    asked(one, u[:cut], p[:cut])
    assert 0 < one.still < STILL_STEPS
    two = Following.from_state(one.state_dict())
    assert two == one
    said = asked(one, u[cut:], p[cut:])
    assert True in said
    assert asked(two, u[cut:], p[cut:]) == said
    assert one.state_dict() == two.state_dict()
    assert math.isnan(Following.from_state({}).u_V)
    with pytest.raises(KeyError):
        Following.from_state({"u_V": 1.0})
