"""The motions of users: within their band, from rest, with the velocities and accelerations of their positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dehyst.lab.rehearsal.reference import BEGIN_S, REST_S, Motion, ReferenceRequest
from dehyst.lab.rehearsal.runs import times
from tests.foreign.motions import MOTIONS, NIGHT_FROM_S, MotionMaker, motion

#: Rests of the tests, s.
STILL_S = 3.0
DT_S = 1e-4


def wish(seed: int, duration_s: float = 12.0) -> ReferenceRequest:
    return ReferenceRequest(-3.0, 5.0, 25.0, duration_s, seed)


def made(name: str, seed: int, t_s: np.ndarray) -> Motion:
    return replace(motion(name), still_s=STILL_S if MOTIONS[name.partition(":")[0]].rests else 0.0)(wish(seed))(t_s)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", MOTIONS)
def test_it_starts_at_rest_moves_into_the_band_and_stays_there(name: str, seed: int) -> None:
    t_s = times(120_000, DT_S)
    y, v, a = made(name, seed, t_s)
    rests = t_s <= REST_S
    assert (y[rests] == -3.0).all()
    assert not v[rests].any()
    assert not a[rests].any()
    moves = t_s >= BEGIN_S + (STILL_S if MOTIONS[name].rests == "night" else 0.0)
    assert 5.0 - 1e-9 <= y[moves].min() < y[moves].max() <= 25.0 + 1e-9
    assert np.ptp(y[t_s >= 2.0]) > 0.0
    # No jumps: no sample is further from the one before than the fastest velocity brings it.
    assert np.abs(np.diff(y)).max() <= 1.02 * np.abs(v).max() * DT_S + 1e-12


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", MOTIONS)
def test_velocity_and_acceleration_are_the_derivatives_away_from_corners(name: str, seed: int) -> None:
    h_s = 1e-6
    t_s = np.random.default_rng(seed).uniform(0.0, 12.0, 4000)
    t_s.sort()
    before, at, after = (made(name, seed, t_s + shift_s) for shift_s in (-h_s, 0.0, h_s))
    slope = (after.y_um - before.y_um) / (2.0 * h_s)
    bend = (after.v_um_per_s - before.v_um_per_s) / (2.0 * h_s)
    v_right = np.isclose(at.v_um_per_s, slope, rtol=1e-4, atol=1e-6 * np.abs(at.v_um_per_s).max())
    a_right = np.isclose(at.a_um_per_s2, bend, rtol=1e-3, atol=1e-4 * max(1.0, np.abs(at.a_um_per_s2).max()))
    # A corner within h_s of a random time is rare.
    assert v_right.mean() > 0.998
    assert a_right.mean() > 0.998


@pytest.mark.parametrize("name", ["raster", "rounded", "sawtooth", "tone"])
@pytest.mark.parametrize("frequency_Hz", [1.0, 10.0, 50.0])
def test_the_frequency_is_the_one_asked_for(name: str, frequency_Hz: float) -> None:
    t_s = BEGIN_S + times(80_000, DT_S) + 1e-7
    one, later = (made(f"{name}:{frequency_Hz:g}", 3, t_s + shift_s) for shift_s in (0.0, 1.0 / frequency_Hz))
    for values, again in zip(one, later, strict=True):
        assert np.allclose(values, again, rtol=1e-6, atol=1e-6 * max(1.0, np.abs(values).max()))
    turns = np.flatnonzero((one.v_um_per_s[:-1] <= 0.0) & (one.v_um_per_s[1:] > 0.0))
    assert turns.size == pytest.approx(8.0 * frequency_Hz, abs=1)


@pytest.mark.parametrize("seed", range(3))
def test_a_rest_lasts_as_long_as_it_is_to_and_the_motion_goes_on(seed: int) -> None:
    t_s = times(120_000, DT_S)
    for name, from_s in (("hold", None), ("night", NIGHT_FROM_S)):
        maker: MotionMaker = replace(MOTIONS[name], still_s=STILL_S)
        begin_s = maker.begin_s(seed)
        y, v, a = maker(wish(seed))(t_s)
        first_s = begin_s - STILL_S if from_s is None else from_s
        still = (t_s > first_s + DT_S) & (t_s < first_s + STILL_S - DT_S)
        assert np.ptp(y[still]) < 1e-9
        assert not v[still].any()
        assert not a[still].any()
        assert y[-1] != y[still][0]
        assert np.abs(v[t_s >= begin_s][:2000]).max() > 0.0
