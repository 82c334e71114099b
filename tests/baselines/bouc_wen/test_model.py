"""The Bouc-Wen stage and its inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse, BoucWenParameters
from dehyst.baselines.bouc_wen.step import hysteresis_step, settled
from dehyst.baselines.common import Domain

# --- The Bouc-Wen stage and its inverse: closed forms against fine integration, and round trips.

WIDE = Domain(-1e6, 1e6, 1e9)
#: Resonant at 297 Hz; critically damped; with beta = gamma, where one branch is a straight line.
RESONANT = BoucWenParameters(1.0, 300.0, 3.5e6, 11.0, 0.4, 0.9, 0.3, offset_um=-4.0)
CRITICAL = BoucWenParameters(1.0, 2000.0, 1e6, 11.0, 0.4, 0.9, 0.3)
EQUAL = BoucWenParameters(0.5, 3e3, 1e6, 9.0, 0.3, 0.8, 0.8)
MODELS = [TABLE_2_1, RESONANT, CRITICAL, EQUAL]


def chapter_input(dt_s: float, n: int) -> FloatArray:
    t = np.arange(n) * dt_s
    return 4 * np.exp(-0.11 * t) * (np.sin(6 * np.pi * t * np.exp(-0.345 * t) - 1.55) + 1)


def test_hysteresis_against_fine_euler() -> None:
    alpha, beta, gamma = 0.4754, 0.8718, 0.9925
    for u0, u1, g0 in [(0.0, 3.0, -0.2), (3.0, 0.0, 0.25), (1.0, 1.4, -0.25), (1.0, 0.9, 0.1)]:
        g, steps = g0, 200_000
        du = (u1 - u0) / steps
        for _ in range(steps):  # (2.2) word for word
            g += alpha * du - beta * abs(du) * g - gamma * du * abs(g)
        assert hysteresis_step(g0, u1 - u0, alpha, beta, gamma) == pytest.approx(g, abs=2e-6)


@settings(max_examples=100, deadline=None)
@given(
    u=st.lists(st.floats(-5, 5), min_size=3, max_size=3),
    share=st.floats(-1, 1),
    gamma=st.sampled_from([-0.4, 0.0, 0.5, 0.5 + 1e-9, 1.7]),
)
def test_a_monotone_way_may_be_cut_anywhere(u: list[float], share: float, gamma: float) -> None:
    a, b, c = sorted(u)
    alpha, beta = 0.3, 0.5
    g = share * alpha / (beta + gamma)
    whole = hysteresis_step(g, c - a, alpha, beta, gamma)
    parts = hysteresis_step(hysteresis_step(g, b - a, alpha, beta, gamma), c - b, alpha, beta, gamma)
    assert whole == pytest.approx(parts, abs=1e-8)
    assert abs(whole) <= alpha / (beta + gamma) + 1e-12


@pytest.mark.parametrize("model", MODELS)
def test_no_error_depends_on_the_step(model: BoucWenParameters) -> None:
    """The same voltage, joined by lines, at a sixteenth of the step gives the same displacement."""
    u = chapter_input(0.02, 200)
    fine = np.interp(np.arange(199 * 16 + 1) / 16, np.arange(200), u)
    np.testing.assert_allclose(model.simulate(fine, 0.02 / 16)[::16], model.simulate(u, 0.02), atol=1e-7)


def test_against_a_differential_equation_solver() -> None:
    """(2.1), (2.2) integrated as they stand, on the resonant stage, linear hold."""
    p, dt = RESONANT, 2e-3
    u = chapter_input(0.02, 40)
    rate = np.diff(u) / dt
    value = np.array([0.0, 0.0, 0.0])
    value[0] = p.simulate(u, dt)[0]
    g0 = hysteresis_step(0.0, u[0], p.alpha, p.beta_per_V, p.gamma_per_V)
    value[2] = p.d_um_per_V * g0
    model = [value[0]]
    for k in range(u.size - 1):

        def slope(t: float, s: FloatArray, k: int = k) -> list[float]:
            drive = p.d_um_per_V * (u[k] + rate[k] * t) - s[2] + p.offset_um
            a = (p.k_N_per_m * (drive - s[0]) - p.b_N_s_per_m * s[1]) / p.m_kg
            h = p.alpha * p.d_um_per_V * rate[k]
            h -= p.beta_per_V * abs(rate[k]) * s[2] + p.gamma_per_V * rate[k] * abs(s[2])
            return [s[1], a, h]

        value = solve_ivp(slope, (0, dt), value, rtol=1e-10, atol=1e-12).y[:, -1]
        model.append(value[0])
    np.testing.assert_allclose(p.simulate(u, dt), model, atol=2e-6)


@pytest.mark.parametrize("model", MODELS)
def test_inverse_of_motion_is_the_voltage(model: BoucWenParameters) -> None:
    u = chapter_input(0.02, 500)
    y, v, a = model.motion(u, 0.02)
    inverse = BoucWenInverse(model, 0.02, WIDE)
    answer = inverse.feedforward(y, v, a, model.at_rest(float(u[0]))[:2])
    np.testing.assert_allclose(answer.u_V, u, atol=1e-8)
    np.testing.assert_allclose(answer.memory, inverse.track(y, v, a, u, model.at_rest(float(u[0]))[:2]), atol=1e-8)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    alpha=st.floats(0.0, 0.95),
    rate=st.floats(1e-3, 20.0),
    rho=st.floats(0.0, 0.5),
)
def test_static_round_trip_over_random_walks(seed: int, alpha: float, rate: float, rho: float) -> None:
    model = BoucWenParameters(1e-6, 1.0, 1e6, 10.0, alpha, rho * rate, (1 - rho) * rate)
    u = np.random.default_rng(seed).uniform(-5, 9, 60)
    g, w, last = 0.0, [], 0.0
    for value in u:
        g = hysteresis_step(g, value - last, *model.shape)
        last = value
        w.append(10.0 * (value - g))
    zero = np.zeros(u.size)
    answer = BoucWenInverse(model, 1e-3, WIDE).feedforward(np.array(w), zero, zero, np.zeros(2))
    np.testing.assert_allclose(answer.u_V, u, atol=1e-9)


@pytest.mark.parametrize("hold", ["linear", "zero_order"])
def test_feedforward_drives_its_own_stage(hold: str) -> None:
    """A smooth motion wanted, the voltage given, the stage simulated at 1 kHz: it goes where it was wanted."""
    model = replace(TABLE_2_1, hold=hold, offset_um=3.0)
    t = np.arange(3000) * 1e-3
    w = 2 * np.pi * 3.0
    y, v, a = 43 - 35 * np.cos(w * t), 35 * w * np.sin(w * t), 35 * w * w * np.cos(w * t)
    inverse = BoucWenInverse(model, 1e-3, WIDE)
    u = inverse.feedforward(y, v, a, inverse.rest_memory(8.0)).u_V
    got = model.simulate(u, 1e-3, settled(u[0], float(inverse.rest_memory(8.0)[1])))
    assert np.max(np.abs(got - y)[100:]) < 0.03
    blunt = replace(inverse, parameters=replace(model, hold="linear", b_N_s_per_m=1.0))
    late = model.simulate(blunt.feedforward(y, v, a, blunt.rest_memory(8.0)).u_V, 1e-3)
    assert np.max(np.abs(late - y)[100:]) > 0.5


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"m_kg": 0.0}, "m_kg"),
        ({"d_um_per_V": float("nan")}, "d_um_per_V"),
        ({"alpha": 1.0}, "alpha"),
        ({"alpha": 0.9, "beta_per_V": 2.0, "gamma_per_V": 0.1}, "alpha"),
        ({"beta_per_V": 0.0, "gamma_per_V": 0.0}, "beta_per_V"),
        ({"hold": "cubic"}, "hold"),
    ],
)
def test_bad_parameters_are_named(change: dict[str, object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        replace(TABLE_2_1, **change)  # type: ignore[arg-type]
