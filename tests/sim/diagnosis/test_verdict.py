"""What decides the verdict: the black box, the share that is explained, defects, and where the rest lies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis import diagnose
from dehyst.sim.diagnosis.diagnose import Options, explained_share, verdict_of
from dehyst.sim.diagnosis.nominal import calibrate_nominal, fit_on_other_recording
from dehyst.sim.diagnosis.result import NamedCause
from dehyst.sim.diagnosis.search.held_out import split
from dehyst.sim.diagnosis.unexplained import black_box_error, black_box_on_other, where_left
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import ModelFit
from dehyst.sim.readings.noise import RepeatedReadings, is_noise, noise_floor, recording_defects, repeated_readings

DT = 1e-3
SIGMA_UM = 0.01
sizes = st.floats(1e-3, 10.0)


@given(nominal=sizes, extended=sizes, ceiling=sizes, floor=sizes)
def test_the_explained_share_is_a_share(nominal: float, extended: float, ceiling: float, floor: float) -> None:
    share = explained_share(nominal, extended, ceiling, floor)
    assert share <= 1.0
    assert (share > 0.0) == (extended < nominal) or share == pytest.approx(0.0, abs=1e-12)
    # Nothing can be explained below the noise, nor better than by causes that beat the black box.
    if extended <= min(ceiling, nominal) and extended < nominal and extended >= floor:
        assert share == pytest.approx(1.0)


def cause(index: int = 0) -> NamedCause:
    none = np.zeros(1)
    return NamedCause("creep", (), {}, {}, 0.5, 0.001, none, none, index)


@pytest.mark.parametrize(
    ("causes", "nominal", "extended", "ceiling", "noise", "verdict"),
    [
        ((), 0.0102, 0.0102, 0.01, False, "adequate"),
        ((), 0.1, 0.1, 0.02, False, "unexplained"),
        # Noise of a colour is above the floor, but not far.
        ((), 0.08, 0.08, 0.02, True, "adequate"),
        ((), 0.5, 0.5, 0.02, True, "unexplained"),
        # That a black box fails as well does not make an error noise.
        ((), 0.08, 0.08, 0.076, False, "unexplained"),
        ((cause(),), 0.5, 0.01, 0.01, False, "effects"),
        ((cause(),), 0.5, 0.3, 0.02, False, "partly"),
        ((cause(),), 0.5, 0.49, 0.02, True, "unexplained"),
        # On a test record the error grew: nothing carries over.
        ((cause(),), 2.19, 4.42, 1.0, False, "unexplained"),
        ((cause(-1),), 0.011, 0.011, 0.011, False, "effects"),
    ],
)
def test_the_verdict_can_fail(
    causes: tuple[NamedCause, ...], nominal: float, extended: float, ceiling: float, noise: bool, verdict: str
) -> None:
    explained = explained_share(nominal, extended, ceiling, 0.01)
    assert verdict_of(causes, nominal, extended, noise, 0.01, explained) == verdict


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_any_colour_is_noise_and_an_error_that_follows_the_drive_is_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 20_000
    t, white, whole = np.arange(n) * DT, rng.standard_normal(n), np.ones(n, dtype=np.bool_)
    correlated = lfilter([0.02], [1.0, -0.98], white)
    f = np.maximum(np.fft.rfftfreq(n, DT), 1.0 / (n * DT))
    pink = np.fft.irfft(np.fft.rfft(white) / np.sqrt(f), n)
    error = np.abs(np.sin(2.0 * np.pi * 1.0 * t)) - 2.0 / np.pi
    for noise in (white, correlated / correlated.std(), pink / pink.std()):
        assert is_noise(noise, whole)
        assert not is_noise(noise + 3.0 * error, whole)


def linear_record(seed: int, extra: FloatArray | float = 0.0, seconds: float = 20.0) -> FitData:
    """A linear stage under triangles of three rates, with white noise and what is added to its readings."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    t = np.arange(n) * DT
    phase = np.cumsum(np.where((t % 9.0) < 3.0, 0.3, np.where((t % 9.0) < 6.0, 1.0, 3.0))) * DT
    u = 4.0 * (1.0 - np.abs(2.0 * (phase % 1.0) - 1.0)) * (0.8 + 0.2 * np.cos(2.0 * np.pi * t / 7.0))
    return FitData(DT, u, 10.0 * u + extra + SIGMA_UM * rng.normal(size=n))


def nominal_fit(data: FitData) -> ModelFit:
    return calibrate_nominal("linear", data, np.ones(data.n, dtype=np.bool_))


def play(u: FloatArray, radius: float) -> FloatArray:
    out, at = np.empty_like(u), u[0]
    for k, v in enumerate(u):
        at = min(max(at, v - radius), v + radius)
        out[k] = at
    return out


def test_the_black_box_predicts_a_loop_and_not_noise() -> None:
    whole = np.ones(20_000, dtype=np.bool_)
    quiet = nominal_fit(linear_record(1))
    assert black_box_error(quiet, quiet, whole, split(quiet.model.data)) == pytest.approx(SIGMA_UM, rel=0.05)
    u = linear_record(2).u_V
    looped = nominal_fit(linear_record(2, 0.8 * play(u, 0.7)))
    before = float(np.sqrt(np.mean(looped.residual_um**2)))
    found = black_box_error(looped, looped, whole, split(looped.model.data))
    assert before > 10.0 * SIGMA_UM
    assert found < 0.2 * before
    there = fit_on_other_recording(looped, replace(looped.model.data, y_um=looped.model.data.y_um), whole)
    assert black_box_on_other(looped, there, whole, whole, split(looped.model.data)) < 0.2 * before


def test_coloured_noise_alone_is_adequate() -> None:
    """First-order noise: correlated over 0.3 s, far longer than the windows from which white noise would be known."""
    rng = np.random.default_rng(6)
    levels = np.repeat(rng.permutation([0.0, 3.0, 5.0, 1.0, 4.0, 2.0]), 2500)
    u = np.concatenate([levels, linear_record(0).u_V])
    keep = math.exp(-DT / 0.3)
    coloured, white = np.zeros(u.size), rng.normal(size=u.size) * 0.03 * math.sqrt(1.0 - keep**2)
    for k in range(1, u.size):
        coloured[k] = keep * coloured[k - 1] + white[k]
    diagnosis = diagnose(FitData(DT, u, 10.0 * u + coloured), None, Options(nominal="linear"))
    assert diagnosis.verdict == "adequate", [c.name for c in diagnosis.causes]


def test_the_floor_of_coloured_noise_comes_from_whole_rests() -> None:
    rng = np.random.default_rng(7)
    u = np.repeat([0.0, 3.0, 5.0, 1.0], 4000)
    keep = math.exp(-DT / 0.1)
    y, white = np.zeros(u.size), rng.normal(size=u.size) * 0.03 * math.sqrt(1.0 - keep**2)
    for k in range(1, u.size):
        y[k] = keep * y[k - 1] + white[k]
    floor = noise_floor(FitData(DT, u, 10.0 * u + y))
    assert floor.source == "rests"
    assert floor.sigma_um == pytest.approx(0.03, rel=0.25)


def test_one_repeat_in_many_readings_is_chance_and_listed() -> None:
    y = np.cumsum(np.full(132_000, 0.5))
    y[60_000] = y[59_999]
    doubles = repeated_readings(y, 0.003, 0.001)
    (defect,) = recording_defects(doubles, 0.003, 0.001, 0, y.size)
    assert (defect.kind, defect.count) == ("repeats", 1)
    assert "repeat the one before" in defect.words
    assert recording_defects(RepeatedReadings(0, 100, np.empty(0)), 0.003, 0.0, 0, 100) == ()
    (gap,) = recording_defects(RepeatedReadings(0, 100, np.empty(0)), 0.003, 0.0, 3, 100)
    assert (gap.kind, gap.count) == ("gaps", 3)


def test_what_is_left_is_located() -> None:
    event = np.zeros(20_000)
    event[8000:8050] = 2.0 * np.sin(np.arange(50) * 2.0)
    fit = nominal_fit(linear_record(3, event))
    said = where_left(fit, np.ones(20_000, dtype=np.bool_), SIGMA_UM)
    assert said[0].startswith("time: half of it lies in")
    assert "about 8 s" in said[0]
    assert {text.split(":")[0] for text in said} == {"time", "frequency", "direction", "position"}
    assert where_left(nominal_fit(linear_record(4)), np.ones(20_000, dtype=np.bool_), SIGMA_UM) == ()


def test_a_healthy_record_is_adequate() -> None:
    told = diagnose(linear_record(5), None, Options(nominal="linear")).as_dict()
    assert (told["schema"], told["verdict"], told["effects"]) == (2, "adequate", [])
