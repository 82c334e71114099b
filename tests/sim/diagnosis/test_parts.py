"""The parts of the diagnosis against closed forms and against the effects library, which it does not share."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.nominal import BoucWenStage
from dehyst.sim.diagnosis.prepare import prepare
from dehyst.sim.diagnosis.search.held_out import split
from dehyst.sim.diagnosis.search.screening import ScreenedCause, p_value
from dehyst.sim.effects import effect, simulate
from dehyst.sim.effects.hysteresis_shape import HysteresisShape
from dehyst.sim.effects.rate_dependence import RateDependence
from dehyst.sim.effects.stick_slip import StickSlip, friction
from dehyst.sim.effects.timing import resample
from dehyst.sim.fitting.calibration import calibrate
from dehyst.sim.fitting.dynamics import Dynamics, respond
from dehyst.sim.fitting.fit_data import ActsOn, FitData
from dehyst.sim.fitting.hysteresis_loops import bouc_wen_loop, bouc_wen_paced, path_lag
from dehyst.sim.fitting.stage_model import StageModel
from dehyst.sim.readings.noise import (
    converter_grid,
    has_spectral_line,
    noise_floor,
    repeated_period,
    repeated_readings,
)
from dehyst.sim.recordings import Recording
from tests.sim.diagnosis.plays import plays

DT = 5e-4


def test_loop_is_the_chapters_equation() -> None:
    """h against a fine integration of (2.2) in u, through reversals and through zero."""
    u = np.array([0.0, 3.0, -1.0, 2.0, 0.5, 4.0])
    slope, beta, gamma = 5.4, 0.87, 0.99
    h, expected = 0.0, [0.0]
    for a, b in pairwise(u):
        sign = np.sign(b - a)
        run = solve_ivp(
            lambda _, h, s=sign: slope * s - beta * h - gamma * s * np.abs(h),
            (0, abs(b - a)),
            [h],
            rtol=1e-9,
            atol=1e-12,
        )
        h = float(run.y[0, -1])
        expected.append(h)
    np.testing.assert_allclose(bouc_wen_loop(u, slope, beta, gamma, 0.0), expected, rtol=1e-6)
    np.testing.assert_allclose(bouc_wen_paced(u, slope, beta, gamma, 0.0, np.ones(u.size), 0.0), expected, rtol=1e-6)


@given(st.lists(st.floats(-3.0, 8.0), min_size=3, max_size=40))
@settings(max_examples=40, deadline=None)
def test_loop_does_not_depend_on_how_a_monotone_way_is_cut(levels: list[float]) -> None:
    """Half way stations on every straight way change nothing: the step is exact."""
    u = np.array(levels)
    half = np.empty(2 * u.size - 1)
    half[::2], half[1::2] = u, 0.5 * (u[1:] + u[:-1])
    coarse = bouc_wen_loop(u, 5.0, 0.9, 0.95, 0.0)
    np.testing.assert_allclose(bouc_wen_loop(half, 5.0, 0.9, 0.95, 0.0)[::2], coarse, atol=1e-9)


def test_path_lag_is_its_differential_equation() -> None:
    """w against a fine integration of dw = rate |dz| (f(z) - w), through reversals."""
    z = np.array([-1.0, 0.6, -0.4, 1.0, 0.2, 0.3])
    rate, weights, start = 2.3, np.array([2.0, -0.7, 0.4]), 0.5

    def goal(at: float) -> float:
        return at * float(np.polynomial.polynomial.polyval(at * at, weights))

    w = goal(z[0]) + start
    expected = [w]
    for a, b in pairwise(z):
        way = np.sign(b - a)
        run = solve_ivp(
            lambda s, w, a=a, way=way: rate * (goal(a + way * s) - w), (0, abs(b - a)), [w], rtol=1e-9, atol=1e-12
        )
        w = float(run.y[0, -1])
        expected.append(w)
    np.testing.assert_allclose(path_lag(z, rate, start, weights), expected, atol=1e-3)


@pytest.mark.parametrize("variant", ["", "slanted", "local"])
def test_the_loop_of_a_shape_opens_and_its_reversible_part_does_not_count(variant: str) -> None:
    """Up and down: what a shape adds less its loop is one curve of the voltage."""
    u = np.concatenate([np.linspace(0.0, 8.0, 400), np.linspace(8.0, 0.0, 400)[1:]] * 2)
    data = FitData(DT, u, 10.0 * u)
    shape = HysteresisShape(variant=variant)
    rng = np.random.default_rng(3)
    p = np.array([s.neutral + s.step * rng.normal() for s in shape.parameters(data)])
    added = shape.static(u, u, u, p, p, data)
    assert added is not None
    loop = shape.loop_um(u, added, p, data)
    curve = (added + loop)[799:]
    np.testing.assert_allclose(curve[:399], curve[-399:][::-1], atol=1e-9)
    assert float(np.ptp(loop)) > 0.1


def test_a_rate_dependence_widens_the_loops_of_the_causes_beside_it() -> None:
    """Of a nominal stage without a loop, plays beside it have one."""
    u = 4.0 - 4.0 * np.cos(2.0 * np.pi * 5.0 * np.arange(4000) * DT)
    data = FitData(DT, u, 10.0 * u)
    both = StageModel(data, BoucWenStage("zero"), (RateDependence(), HysteresisShape()))
    p = np.array([s.neutral for s in both.parameters])
    p[: both.n_nominal][[s.name == "alpha" for s in both.parameters[: both.n_nominal]]] = 0.0
    p[both.slice_of(1)] = 0.5
    alone = both.simulate(p)
    p[both.slice_of(0).start] = 0.1
    wider = both.simulate(p).static_um - alone.static_um
    loop = HysteresisShape().loop_um(u, alone.static_um - alone.w_um, p[both.slice_of(1)], data)
    moving = np.abs(wider) > 1e-6
    assert float(np.ptp(wider)) > 0.1
    assert np.all(wider[moving] * loop[moving] < 0.0)


def test_a_simulation_from_a_later_block_gives_what_a_whole_one_gives() -> None:
    """Columns are differences of such simulations; the start, far from equilibrium, must not count twice."""
    u = _steps(4002)
    data = FitData(DT, u, 10.0 * u)
    model = StageModel(data, BoucWenStage("zero", free_memory=True))
    at = {s.name: i for i, s in enumerate(model.parameters)}
    p = np.array([s.neutral for s in model.parameters])
    p[at["start_um"]] = 3.0
    kept = model.simulate(p)
    p[at["tau_s"]] *= 1.1
    np.testing.assert_allclose(model.simulate(p, ActsOn.DYNAMICS, kept).reading_um, model.simulate(p).reading_um)


def test_lag_with_a_fraction_of_a_sample_of_delay() -> None:
    w = np.zeros(200)
    w[50:] = 1.0
    t = (np.arange(200) - 50) * DT
    for delay in (0.0, 0.3 * DT, 1.7 * DT):
        exact = np.where(t - delay > 0.0, 1.0 - np.exp(-np.maximum(t - delay, 0.0) / 2.5e-3), 0.0)
        got = respond(w, Dynamics((2.5e-3,), (), delay), DT)
        np.testing.assert_allclose(got, exact, atol=1e-9)


def test_mode_rings_as_its_closed_form_and_equal_lags_are_no_trouble() -> None:
    w = np.zeros(400)
    w[10:] = 1.0
    t = np.maximum((np.arange(400) - 10) * DT, 0.0)
    z, omega = 0.02, 2.0 * np.pi * 350.0
    damped = omega * np.sqrt(1.0 - z * z)
    exact = 1.0 - np.exp(-z * omega * t) * (np.cos(damped * t) + z / np.sqrt(1.0 - z * z) * np.sin(damped * t))
    np.testing.assert_allclose(respond(w, Dynamics((), ((350.0, z),)), DT), exact, atol=1e-8)
    twice = respond(w, Dynamics((1e-3, 1e-3)), DT)
    np.testing.assert_allclose(twice, 1.0 - np.exp(-t / 1e-3) * (1.0 + t / 1e-3), atol=1e-4)


def test_first_order_hold_is_exact_on_a_ramp() -> None:
    w = np.arange(300) * DT
    got = respond(w, Dynamics((2e-3,), hold="first"), DT)
    t = w
    np.testing.assert_allclose(got[:-1], (t - 2e-3 * (1.0 - np.exp(-t / 2e-3)))[:-1], atol=1e-9)


def test_friction_with_full_share_is_a_play() -> None:
    u = np.cumsum(np.random.default_rng(0).normal(size=500)) * 0.1
    play = plays(u - u[0], np.array([0.4]))[0] + u[0]
    assert np.max(np.abs(friction(u, 0.4, 1.0) - play)) <= 0.4 + 1e-12
    assert np.all(np.abs(friction(u, 0.4, 0.3) - u) <= 0.4 + 1e-12)


def test_contact_that_breaks_free_in_parts_slides_as_friction_with_presliding_does() -> None:
    """After a reversal at full friction z = F (1 - 2 exp(-s / 2F)): Dahl's equation, over the way s, solved."""
    reach = 0.03
    way = np.linspace(0.0, 1.0, 4001)
    x = np.concatenate([way, 1.0 - way[1:]])
    data = FitData(DT, x, 10.0 * x)
    form = StickSlip(variant="gradual")
    held = x - form.motion(x, np.array([reach, 1.0]), data)
    expected = reach * (1.0 - 2.0 * np.exp(-way / (2.0 * reach)))
    np.testing.assert_allclose(-held[way.size - 1 :], expected, atol=0.12 * reach)
    assert np.std(-held[way.size - 1 :] - expected) < 0.03 * reach
    np.testing.assert_allclose(form.motion(x, np.array([0.02, 0.0]), data), plays(x, np.array([0.02]))[0], atol=1e-12)


def test_resampling_is_exact_for_a_parabola() -> None:
    k = np.arange(1000.0)
    got = resample(k * k, 1e-4, 0.25)
    at = k * (1.0 + 1e-4) + 0.25
    np.testing.assert_allclose(got[2:-3], (at * at)[2:-3], rtol=1e-9, atol=1e-6)


def _steps(n: int = 12_000) -> np.ndarray:
    u = np.repeat([0.0, 4.0, 8.0, 2.0, 6.0, 0.0], n // 6).astype(np.float64)
    t = np.arange(n) * DT
    return np.where(t > 3.0, 4.0 * (1.0 - np.cos(2.0 * np.pi * 4.0 * (t - 3.0))), u)


def test_calibration_finds_the_librarys_bouc_wen_stage() -> None:
    """Parameters of another implementation, from another start, within their physical bounds."""
    u = _steps()
    chain = effect("bouc_wen", d_um_per_V=10.2, alpha=0.42, beta_per_V=0.8, gamma_per_V=1.1) + effect(
        "mechanics", damping_N_s_per_m=8e5
    )
    y = 3.0 + simulate(chain, u, DT)
    fit = calibrate(
        model := StageModel(FitData(DT, u, y), BoucWenStage()),
        model.nominal.starts(model.data)[0],
        np.ones(u.size, bool),
        40,
        1e-9,
    )
    got = dict(zip([s.name for s in model.parameters], fit.p, strict=True))
    assert np.sqrt(fit.sse_um2 / u.size) < 2e-3
    assert got["d_um_per_V"] == pytest.approx(10.2, rel=1e-3)
    assert got["rise_per_V"] == pytest.approx(1.9, rel=1e-2)
    assert got["tau_s"] == pytest.approx(8e5 / 3.5244e8, rel=1e-2)
    assert got["offset_um"] == pytest.approx(3.0, abs=0.01)


def test_noise_floor_sees_noise_and_not_creep() -> None:
    rng = np.random.default_rng(1)
    u = np.repeat([0.0, 5.0, 0.0, 3.0], 4000).astype(np.float64)
    y = 10.0 * u + 0.2 * np.log10(1.0 + np.arange(u.size) * DT) + 0.005 * rng.standard_normal(u.size)
    floor = noise_floor(FitData(DT, u, y))
    assert floor.source == "rests"
    assert floor.sigma_um == pytest.approx(0.005, rel=0.05)


def test_noise_floor_of_readings_that_come_before_their_steps() -> None:
    """A recorder's clock that runs 60 ppm fast: after a minute the readings show a step 7 samples early."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(0.0, 8.0, 40), 3000)
    y = 10.0 * np.interp(np.arange(u.size) * (1.0 + 60e-6), np.arange(u.size), u) + 0.004 * rng.normal(size=u.size)
    floor = noise_floor(FitData(DT, u, y))
    assert floor.source == "rests"
    assert 0.0038 < floor.sigma_um < 0.0042


def test_noise_floor_of_what_a_model_leaves() -> None:
    rng = np.random.default_rng(2)
    u = np.repeat([0.0, 5.0, 2.0, 7.0, 0.0, 3.0], 2000)
    noise = 0.004 * rng.normal(size=u.size)
    ringing = np.sin(2.0 * np.pi * 60.0 * np.arange(u.size) * DT)
    data = FitData(DT, u, 10.0 * u + ringing + noise)
    assert noise_floor(data).sigma_um > 0.5
    assert 0.0038 < noise_floor(data, noise).sigma_um < 0.0042


def test_noise_floor_of_repeated_periods() -> None:
    rng = np.random.default_rng(2)
    u = np.tile(rng.standard_normal(1500), 4)
    y = np.convolve(np.tile(u, 2), [0.2, 0.5, 0.3])[u.size : 2 * u.size] + 0.01 * rng.standard_normal(u.size)
    assert repeated_period(u) == 1500
    assert noise_floor(FitData(DT, u, y)).sigma_um == pytest.approx(0.01, rel=0.05)
    assert repeated_period(np.sin(np.arange(3000.0) ** 1.3 * 0.01)) == 0


def test_grid_and_repeats() -> None:
    rng = np.random.default_rng(3)
    y = 5.0 * np.sin(np.arange(20_000) * 0.01) + 0.02 * rng.standard_normal(20_000)
    assert converter_grid(np.round(y / 0.05) * 0.05).step_um == pytest.approx(0.05, rel=1e-3)
    assert converter_grid(y).step_um == 0.0
    fast = 40.0 * np.sin(np.arange(20_000) * 0.03) + 0.005 * rng.standard_normal(20_000)
    assert repeated_readings(fast, 0.005, 0.0).count == 0
    doubled = fast.copy()
    doubled[500::997] = doubled[499::997][: doubled[500::997].size]
    assert repeated_readings(doubled, 0.005, 0.0).count >= 15


def test_a_line_is_told_from_ringing() -> None:
    n = 40_000
    u = np.zeros(n)
    u[::4000] = 1.0
    t = np.arange(n) * DT
    data = FitData(DT, u, np.zeros(n))
    rng = np.random.default_rng(4)
    noise = 0.005 * rng.standard_normal(n)
    assert has_spectral_line(noise + 0.002 * np.sin(2 * np.pi * 50.0 * t), data, 50.0)
    assert not has_spectral_line(noise, data, 50.0)
    since = np.mod(np.arange(n), 4000) * DT
    assert not has_spectral_line(noise + 0.2 * np.exp(-since / 0.02) * np.sin(2 * np.pi * 53.0 * since), data, 50.0)


def test_folds_leave_out_whole_stretches() -> None:
    u = _steps()
    parts = split(FitData(DT, u, u))
    assert parts.edges[0] == 0
    assert parts.edges[-1] == u.size
    assert sum(int(parts.samples(f).sum()) for f in range(parts.n_folds)) == u.size


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda u, y: (u[:100], y[:100]), "100 samples"),
        (lambda u, y: (u, np.zeros_like(y)), "every sample is zero"),
        (lambda u, y: (u, np.where(np.arange(y.size) % 10 == 0, np.nan, y)), "no finite numbers"),
        (lambda u, y: (y, u), "swapped"),
    ],
)
def test_what_cannot_be_diagnosed_is_refused(make: object, said: str) -> None:
    t = np.arange(8000) * DT
    u = 4.0 * (1.0 - np.cos(2.0 * np.pi * 5.0 * t))
    chain = effect("bouc_wen") + effect("mechanics") + effect("sensor_noise", rms_um=0.02)
    u, y = make(u, simulate(chain, u, DT))  # type: ignore[operator]
    with pytest.raises(InputError, match=said):
        prepare(Recording(t_s=np.arange(u.size) * DT, u_V=u, y_um=y, dt_s=DT))


def test_the_reported_height_of_a_loop_is_that_of_its_branches() -> None:
    """At mid-swing of a triangle, from 0 to 10 V; plays of more than half the swing move on the first rise alone."""
    u = 5.0 * (1.0 - np.cos(np.pi * np.linspace(0.0, 4.0, 4001)))
    data = FitData(DT, u, 10.0 * u)
    shape = HysteresisShape()
    p = np.random.default_rng(3).normal(size=shape.radii_V(data).size)
    y = shape.static(u, u, u, p, p, data)
    assert y is not None
    down, up = 1500, 2500  # the middle of the last two branches: both at 5 V
    assert shape.reported(p, data)["width_um"][0] == pytest.approx(y[down] - y[up], abs=1e-6)


def look_of(slopes: FloatArray) -> ScreenedCause:
    """A guess of unit norm with these inner products, block by block."""
    return ScreenedCause(0, np.zeros(1), float(slopes.sum()) ** 2, slopes[None, :], np.eye(1))


def test_slow_noise_seldom_beats_chance() -> None:
    """Noise that keeps its sign for four blocks: with single blocks, a fifth of it would pass at level 0.01."""
    random = np.random.default_rng(4)
    looks = [look_of(np.repeat(random.standard_normal(20), 4)) for _ in range(200)]
    passed = [p_value([look], look.gain_um2, 0, 199) <= 0.01 for look in looks]
    assert np.mean(passed) <= 0.03
    steady = look_of(1.0 + 0.3 * random.standard_normal(80))
    assert p_value([steady], steady.gain_um2, 0) == pytest.approx(0.001)


def test_the_best_of_many_guesses_is_less_surprising() -> None:
    random = np.random.default_rng(5)
    looks = [look_of(random.standard_normal(80)) for _ in range(30)]
    gain = max(look.gain_um2 for look in looks)
    alone = p_value([max(looks, key=lambda look: look.gain_um2)], gain, 0)
    assert alone < 0.1 < p_value(looks, gain, 0)
    assert p_value([], gain, 0) == 1.0
