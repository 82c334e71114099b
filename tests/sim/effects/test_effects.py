"""The effects library: registry, parameters, composition, exactness of the linear parts."""

from __future__ import annotations

import dataclasses
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, cont2discrete

from adaptive.errors import InputError
from baselines.bouc_wen.model import BoucWenParameters
from baselines.bouc_wen.step import hysteresis_step
from sim.effects import CAUSES, EFFECTS, Chain, effect, simulate
from sim.effects.holds import first_order, second_order

CATALOGUE = [
    "hysteresis_shape",
    "asymmetry",
    "rate_dependence",
    "creep",
    "thermal_drift",
    "gain_drift",
    "resonance",
    "payload_change",
    "amplifier_lag",
    "slew_limit",
    "saturation",
    "delay",
    "sensor_lag",
    "sensor_nonlinearity",
    "cross_talk",
    "mains_hum",
    "quantisation",
    "stick_slip",
    "timing",
]

#: Parameter values with which an effect does nothing.
NEUTRAL: dict[str, dict[str, float]] = {
    "amplifier_lag": {"tau_s": 0.0},
    "asymmetry": {"slope_um_per_V": 0.0},
    "creep": {"gain_per_decade": 0.0},
    "cross_talk": {"static": 0.0, "rate_s": 0.0},
    "dac": {"bits": 0.0},
    "delay": {"delay_s": 0.0},
    "duhem": {"slope_um_per_V": 0.0, "square_um_per_V2": 0.0},
    "gain_drift": {"gain": 0.0, "ramp_per_min": 0.0, "amplitude": 0.0, "walk_per_sqrt_min": 0.0},
    "hysteresis_shape": {"width_um": 0.0},
    "mains_hum": {"amplitude_um": 0.0},
    "payload_change": {"payload_ratio": 0.0},
    "quantisation": {"step_um": 0.0},
    "rate_dependence": {"growth_per_decade": 0.0},
    "resonance": {"frequency_Hz": 1e5, "damping_ratio": 0.7},
    "saturation": {"low_V": -1000.0, "high_V": 1000.0},
    "sensor_lag": {"tau_s": 0.0},
    "sensor_noise": {"rms_um": 0.0},
    "sensor_nonlinearity": {"square": 0.0, "cubic": 0.0},
    "slew_limit": {"rate_V_per_s": 1e6},
    "stick_slip": {"width_um": 0.0},
    "thermal_drift": {"amplitude_um": 0.0, "ramp_um_per_min": 0.0, "walk_um_per_sqrt_min": 0.0},
    "timing": {"repeat_probability": 0.0, "slow_ppm": 0.0},
}

RNG = np.random.default_rng(5)
STAIRS = np.cumsum(RNG.normal(size=300)) * 0.3


def test_registry_holds_the_catalogue() -> None:
    assert sorted(CAUSES) == sorted(CATALOGUE)


@pytest.mark.parametrize("kind", EFFECTS.values(), ids=str)
def test_kind_is_complete(kind: object) -> None:
    from sim.effects import Kind

    assert isinstance(kind, Kind)
    assert kind.signature
    assert kind.source
    assert set(kind.mistaken_for) <= set(CAUSES)
    for p in kind.parameters:
        assert p.low <= p.default <= p.high
        assert p.unit
        assert p.meaning
    kind(**NEUTRAL.get(kind.name, {}))


@pytest.mark.parametrize("name", [n for n in NEUTRAL if n not in ("payload_change", "resonance")])
def test_neutral_does_nothing(name: str) -> None:
    base = Chain((effect("linear_actuator"),)) if name != "linear_actuator" else Chain()
    other = STAIRS * 3.0
    without = simulate(base, STAIRS, 1e-3, other_um=other)
    with_it = simulate(base + effect(name, **NEUTRAL[name]), STAIRS, 1e-3, other_um=other)
    np.testing.assert_allclose(with_it, without, rtol=0.0, atol=1e-11)


def test_names_units_and_ranges_are_checked() -> None:
    with pytest.raises(InputError, match="expected one of"):
        effect("creeep")
    with pytest.raises(InputError, match=r"creep\.gain: no such parameter.*gain_per_decade"):
        effect("creep", gain=0.1)
    for bad in (3.0, math.nan, math.inf, True, "x"):
        with pytest.raises(InputError, match=r"creep\.gain_per_decade.*from -0.02 to 0.1"):
            effect("creep", gain_per_decade=bad)  # type: ignore[arg-type]


def test_chain_orders_composes_and_replaces() -> None:
    chain = effect("quantisation") + effect("creep") + (effect("dac") + effect("bouc_wen"))
    assert [e.name for e in chain] == ["dac", "bouc_wen", "creep", "quantisation"]
    assert chain.replace({"creep.t0_s": 0.2})["creep"].values["t0_s"] == 0.2
    assert chain["creep"].values["t0_s"] == 0.1
    assert "creep" not in chain.without("creep")
    with pytest.raises(InputError, match="twice"):
        chain + effect("creep")
    two = chain + effect("resonance") + effect("resonance", label="second_mode", frequency_Hz=900.0)
    assert two.parameters["second_mode.frequency_Hz"] == 900.0
    with pytest.raises(InputError, match="no 'delay' in this chain"):
        chain.replace({"delay.delay_s": 0.0})
    with pytest.raises(InputError, match="payload_change got no mode"):
        simulate(Chain((effect("payload_change"),)), STAIRS, 1e-3)


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), np.array([]), np.array([0.0, np.nan])])
def test_simulate_refuses_bad_voltages(bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="u_V"):
        simulate(Chain((effect("creep"),)), bad, 1e-3)


LAG = effect("amplifier_lag", tau_s=4e-4)
LINEAR = LAG + effect("linear_actuator") + effect("resonance", damping_ratio=0.02)


@pytest.mark.parametrize("parts", [2, 4])
@pytest.mark.parametrize(
    "chain",
    [LINEAR, effect("bouc_wen") + effect("mechanics"), LAG + effect("linear_actuator") + effect("creep")],
    ids=["lag", "table_2_1", "creep"],
)
def test_no_error_depends_on_the_step(chain: Chain, parts: int) -> None:
    coarse = simulate(chain, STAIRS, 1e-3)
    fine = simulate(chain, np.repeat(STAIRS, parts), 1e-3 / parts)[::parts]
    # the readings at rest before the first command differ by nothing, those after by round-off
    np.testing.assert_allclose(coarse, fine, rtol=0.0, atol=1e-9)


def test_creep_before_a_mode_errs_by_next_to_nothing() -> None:
    coarse = simulate(LINEAR + effect("creep"), STAIRS, 1e-3)
    fine = simulate(LINEAR + effect("creep"), np.repeat(STAIRS, 4), 2.5e-4)[::4]
    assert np.abs(coarse - fine).max() < 1e-4 * np.abs(np.diff(coarse)).max()


def test_amplifier_and_mode_together_match_the_matrix_exponential() -> None:
    tau, omega, zeta, dt = 4e-4, 2 * np.pi * 400.0, 0.02, 1e-3
    a = np.array([[-1 / tau, 0, 0], [0, 0, 1], [omega**2, -(omega**2), -2 * zeta * omega]])
    system = StateSpace(a, np.array([[1 / tau], [0], [0]]), np.array([[0, 1.0, 0]]), np.zeros((1, 1)))
    ad, bd, *_ = cont2discrete((system.A, system.B, system.C, system.D), dt)
    state, expected = np.zeros(3), []
    for u in STAIRS:
        expected.append(state[1])
        state = ad @ state + bd[:, 0] * u
    chain = effect("amplifier_lag", tau_s=tau) + effect("resonance", frequency_Hz=400.0, damping_ratio=zeta)
    np.testing.assert_allclose(simulate(chain, STAIRS, dt), expected, rtol=0.0, atol=1e-10)


@settings(max_examples=60, deadline=None)
@given(
    zeta=st.floats(0.001, 60.0),
    omega=st.floats(10.0, 4e4),
    hold=st.sampled_from([0.0, 50.0, 1e3, 2e4, math.inf]),
    dt=st.sampled_from([1e-4, 1e-3, 1e-2]),
)
def test_second_order_halves_compose(zeta: float, omega: float, hold: float, dt: float) -> None:
    """Two half steps are one whole step, for the same way of the input between."""
    rng = np.random.default_rng(1)
    x0, x1, y, v = rng.normal(size=4)
    v *= omega

    def step(c: tuple[float, ...], y: float, v: float, a: float, b: float) -> tuple[float, float]:
        return c[0] * y + c[1] * v + c[2] * a + c[3] * b, c[4] * y + c[5] * v + c[6] * a + c[7] * b

    if hold == 0.0:
        middle = 0.5 * (x0 + x1)
    elif math.isinf(hold):
        middle = x1
    else:
        middle = x0 + (x1 - x0) * math.expm1(-hold * dt / 2) / math.expm1(-hold * dt)
    whole = step(second_order(omega, zeta, dt, hold), y, v, x0, x1)
    half = second_order(omega, zeta, dt / 2, hold)
    twice = step(half, *step(half, y, v, x0, middle), middle, x1)
    np.testing.assert_allclose(np.array(whole) / [1, omega], np.array(twice) / [1, omega], rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("hold", [0.0, 10.0, 1e4, math.inf])
def test_first_order_keeps_a_level_and_follows_a_ramp(hold: float) -> None:
    a, b0, b1 = first_order(0.01, 1e-3, hold)
    assert a + b0 + b1 == pytest.approx(1.0, abs=1e-12)
    a, b0, b1 = first_order(0.01, 1e-3, 0.0)
    z = 5.0 - 0.01 * 2.0  # steady lag of a ramp of slope 2 at x = 5
    assert a * z + b0 * 5.0 + b1 * 5.002 == pytest.approx(5.002 - 0.02, abs=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    h=st.floats(-4.0, 4.0),
    rise=st.floats(-8.0, 8.0),
    gamma=st.floats(-0.5, 1.2),
)
def test_bouc_wen_closed_form(h: float, rise: float, gamma: float) -> None:
    """Against explicit Euler with a tiny step, and two part steps against a whole one."""
    drive, beta = 5.4, 0.87
    whole = hysteresis_step(h, rise, drive, beta, gamma)
    part = hysteresis_step(hysteresis_step(h, 0.3 * rise, drive, beta, gamma), 0.7 * rise, drive, beta, gamma)
    assert whole == pytest.approx(part, abs=1e-9)
    n, euler = 20000, h
    du = rise / n
    for _ in range(n):
        euler += drive * du - beta * abs(du) * euler - gamma * du * abs(euler)
    assert whole == pytest.approx(euler, abs=5e-3)


def test_parameters_change_without_compiling_anew() -> None:
    import time

    chain = effect("bouc_wen") + effect("creep") + effect("resonance")
    simulate(chain, STAIRS, 1e-3)
    # loading machine code takes tens of ms, compiling more than that
    start = time.perf_counter()
    for gain in np.linspace(0.0, 0.05, 20):
        simulate(chain, STAIRS, 1e-3, params={"creep.gain_per_decade": gain})
    assert (time.perf_counter() - start) / 20 < 0.02


def test_every_effect_file_is_its_own_kind() -> None:
    import sim.effects

    folder = Path(sim.effects.__file__).parent
    for kind in EFFECTS.values():
        assert (folder / f"{kind.name}.py").is_file()
    assert dataclasses.is_dataclass(next(iter(EFFECTS.values())))


def test_chains_travel_between_processes_and_are_hashable() -> None:
    chain = effect("creep", gain_per_decade=0.02) + effect("resonance", label="second")
    again = pickle.loads(pickle.dumps(chain))
    assert again == chain
    assert hash(again) == hash(chain)
    assert again["second"].kind is EFFECTS["resonance"]
    assert repr(chain["creep"]) == "creep(gain_per_decade=0.02, t0_s=0.1)"


def test_bouc_wen_stage_agrees_with_the_baseline_model() -> None:
    """(2.1): the mechanics of the library and the modes of the baseline under the zero-order hold."""
    model = BoucWenParameters(0.2789, 8.9055e5, 3.5244e8, 11.351, 0.4754, 0.8718, 0.9925, hold="zero_order")
    chain = effect("bouc_wen") + effect("mechanics")
    np.testing.assert_allclose(simulate(chain, STAIRS, 1e-3), model.simulate(STAIRS, 1e-3), rtol=0.0, atol=1e-9)
