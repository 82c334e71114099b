"""The library of effects, and their signatures."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace, cont2discrete

from dehyst.adaptive.errors import InputError
from dehyst.baselines.bouc_wen.model import BoucWenParameters
from dehyst.baselines.bouc_wen.step import hysteresis_step
from dehyst.sim.effects import CAUSES, EFFECTS, Chain, Effect, effect, simulate
from dehyst.sim.effects.holds import first_order, second_order
from dehyst.sim.signals.voltages import sine, triangle

# --- The effects library: registry, parameters, composition, exactness of the linear parts.


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


@pytest.mark.parametrize("kind", EFFECTS.values(), ids=str)
def test_kind_is_complete(kind: object) -> None:
    from dehyst.sim.effects import Kind

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
    with pytest.raises(InputError, match=r"payload_change got nothing.*resonance or mechanics"):
        simulate(Chain((effect("payload_change"),)), STAIRS, 1e-3)


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


def test_bouc_wen_stage_agrees_with_the_baseline_model() -> None:
    """(2.1): the mechanics of the library and the modes of the baseline under the zero-order hold."""
    model = BoucWenParameters(0.2789, 8.9055e5, 3.5244e8, 11.351, 0.4754, 0.8718, 0.9925, hold="zero_order")
    chain = effect("bouc_wen") + effect("mechanics")
    np.testing.assert_allclose(simulate(chain, STAIRS, 1e-3), model.simulate(STAIRS, 1e-3), rtol=0.0, atol=1e-9)


# --- Each effect's own signature is visible in what it does to a simple stage.

DT = 1e-3
STRAIGHT = Chain((effect("linear_actuator", gain_um_per_V=10.0),))


def shifted(chain: Chain | Effect, u: np.ndarray, dt: float = DT) -> np.ndarray:
    """Displacements at the ends of the steps, in line with the voltages."""
    whole = chain if isinstance(chain, Chain) else Chain((chain,))
    return simulate(whole, np.append(u, u[-1]), dt)[1:]


def loop_height(chain: Chain, frequency_Hz: float, low_V: float = 0.0, high_V: float = 8.0) -> float:
    """Largest height of the third loop, µm."""
    t, u = triangle(low_V, high_V, frequency_Hz, 3.0, 1e-4 / frequency_Hz * 10)
    y = shifted(chain, u, t[1])
    per = u.size // 3
    u, y = u[2 * per :], y[2 * per :]
    top = int(np.argmax(u))
    grid = np.linspace(low_V + 0.05 * (high_V - low_V), high_V - 0.05 * (high_V - low_V), 41)
    falling = np.interp(grid, u[top:][::-1], y[top:][::-1])
    return float((falling - np.interp(grid, u[: top + 1], y[: top + 1])).max())


def lag_of_line(y: np.ndarray, u: np.ndarray, frequency_Hz: float, dt: float) -> tuple[float, float]:
    """Gain and lag in s of a sine against its voltage, over whole periods at the end."""
    n = round(10 / frequency_Hz / dt)
    line = np.exp(-2j * np.pi * frequency_Hz * np.arange(n) * dt)
    ratio = (y[-n:] @ line) / (u[-n:] @ line)
    return float(abs(ratio)), float(-np.angle(ratio) / (2 * np.pi * frequency_Hz))


def test_hysteresis_shape_loop_persists_at_low_rate() -> None:
    chain = STRAIGHT + effect("hysteresis_shape", width_um=5.0, largest_V=2.0)
    assert loop_height(chain, 1e-3) == pytest.approx(5.0, rel=0.02)
    assert loop_height(chain, 10.0) == pytest.approx(5.0, rel=0.02)


def test_delay_loop_vanishes_at_low_rate() -> None:
    chain = STRAIGHT + effect("delay", delay_s=1e-3)
    assert loop_height(chain, 10.0) == pytest.approx(2 * 160.0 * 1e-3 * 10.0, rel=0.05)
    assert loop_height(chain, 0.01) < 0.01


def along(chain: Chain, corners: list[float]) -> np.ndarray:
    """Displacements along straight ways of 200 samples each between voltages."""
    pieces = [np.linspace(a, b, 200, endpoint=False) for a, b in itertools.pairwise(corners)]
    return shifted(chain, np.append(np.concatenate(pieces), corners[-1]))


def test_wiping_out() -> None:
    """A minor loop leaves no trace once the voltage exceeds it, for plays at rest rate."""
    for name in ("generalised_play", "hysteresis_shape", "bouc_wen", "duhem"):
        values = {"rate_growth_V": 0.0} if name == "generalised_play" else {}
        chain = STRAIGHT.without("linear_actuator") + effect(name, **values)
        looped, straight = (float(along(chain, c)[-1]) for c in ([0.0, 4.0, 2.5, 4.0, 5.0], [0.0, 4.0, 5.0]))
        # the smooth part and Bouc-Wen have no return-point memory
        assert (abs(looped - straight) < 1e-12) == (name in ("generalised_play", "hysteresis_shape"))


def test_congruency() -> None:
    """Loops between the same voltages, reached from below and from above, have one shape for plays alone."""
    plays = Chain((effect("hysteresis_shape"),))
    generalised = Chain((effect("generalised_play", rate_growth_V=0.0),))
    for chain, congruent in ((plays, True), (generalised, True), (generalised + effect("duhem"), False)):
        low, high = (along(chain, [0.0, start, 3.0, 5.0, 3.0, 5.0, 3.0])[-401:] for start in (1.0, 8.0))
        difference = (low - low.mean()) - (high - high.mean())
        assert (np.abs(difference).max() < 1e-12) == congruent


def test_loops_depend_on_the_level_for_generalised_plays_only() -> None:
    plain = STRAIGHT + effect("hysteresis_shape")
    bent = Chain((effect("generalised_play", rate_growth_V=0.0, lower_slope=0.3, upper_slope=0.3),))
    assert loop_height(plain, 1.0, 1.0, 3.0) == pytest.approx(loop_height(plain, 1.0, 5.0, 7.0), rel=1e-6)
    assert abs(loop_height(bent, 1.0, 5.0, 7.0) / loop_height(bent, 1.0, 1.0, 3.0) - 1.0) > 0.05


def test_asymmetry_makes_even_harmonics() -> None:
    _, u = sine(-4.0, 4.0, 1.0, 4.0)
    odd = shifted(STRAIGHT + effect("hysteresis_shape"), u)[-1000:]
    even = shifted(STRAIGHT + effect("hysteresis_shape") + effect("asymmetry", dead_zone_V=1.0), u)[-1000:]
    spectrum_odd, spectrum_even = np.abs(np.fft.rfft(odd)), np.abs(np.fft.rfft(even))
    assert spectrum_odd[3] > 20 * spectrum_odd[2]
    assert spectrum_even[2] > 20 * spectrum_odd[2]


def test_rate_dependence_widens_the_loop() -> None:
    chain = STRAIGHT + effect("hysteresis_shape", width_um=5.0) + effect("rate_dependence", width_um=5.0, largest_V=2.0)
    slow, middle, fast = (loop_height(chain, f) for f in (1e-3, 1.0, 10.0))
    assert slow == pytest.approx(loop_height(chain.without("rate_dependence"), 1e-3), rel=5e-3)
    assert fast > middle + 0.2 > slow + 0.3


def test_creep_rises_linearly_in_log_time() -> None:
    step = np.full(300_000, 4.0)
    y = shifted(STRAIGHT + effect("creep", gain_per_decade=0.015), step)
    marks = np.array([0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 290.0])
    at = y[np.round(marks / DT).astype(int)]
    slope, _ = np.polyfit(np.log10(marks), at, 1)
    assert slope == pytest.approx(0.015 * 40.0, rel=0.05)
    down = shifted(STRAIGHT + effect("creep"), np.concatenate((step[:100_000], np.zeros(100_000))))
    assert down[100_100] > down[150_000] > down[-1] > 0.0  # it follows the last step, downwards


def test_thermal_drift_is_there_at_rest_and_creep_is_not() -> None:
    rest = np.zeros(60_000)
    assert np.all(shifted(STRAIGHT + effect("creep"), rest) == 0.0)
    y = shifted(STRAIGHT + effect("thermal_drift", amplitude_um=0.5, tau_s=20.0), rest)
    t = (np.arange(60_000) + 1) * DT
    np.testing.assert_allclose(y, 0.5 * (1 - np.exp(-t / 20.0)), atol=1e-9)
    walk = shifted(STRAIGHT + effect("thermal_drift", amplitude_um=0.0, walk_um_per_sqrt_min=0.1), rest)
    assert np.std(np.diff(walk)) == pytest.approx(0.1 * np.sqrt(DT / 60.0), rel=0.02)


def test_gain_drift_is_in_proportion() -> None:
    _, u = sine(0.0, 8.0, 1.0, 60.0)
    plain, drifting = shifted(STRAIGHT, u), shifted(STRAIGHT + effect("gain_drift", ramp_per_min=0.02), u)
    t = (np.arange(u.size) + 1) * DT
    np.testing.assert_allclose(drifting, plain * (1 + 0.02 * t / 60.0), atol=1e-9)


@pytest.mark.parametrize("change", [{"resonance.payload_ratio": 1.0}, {"payload_change.payload_ratio": 1.0}])
def test_payload_moves_the_mode_and_not_the_gain(change: dict[str, float]) -> None:
    chain = STRAIGHT + effect("resonance", frequency_Hz=300.0, damping_ratio=0.01)
    chain += effect("payload_change", payload_ratio=0.0)
    step = np.ones(20_000)
    peaks, decays = [], []
    for c in (chain, chain.replace(change)):
        y = shifted(c, step, 2.5e-4)
        assert y[-1] == pytest.approx(10.0, abs=1e-6)
        spectrum = np.abs(np.fft.rfft(y[:4000] - y[-1]))
        decays.append(np.log(np.abs(y[:400] - y[-1]).max() / np.abs(y[400:800] - y[-1]).max()))
        peaks.append(np.fft.rfftfreq(4000, 2.5e-4)[np.argmax(spectrum)])
    assert peaks[0] == pytest.approx(300.0, abs=2.0)
    assert peaks[1] == pytest.approx(300.0 / np.sqrt(2.0), abs=2.0)
    # the dashpot stays, the mass doubles: ringing decays at half the rate
    assert decays[1] == pytest.approx(decays[0] / 2.0, rel=0.1)


def test_lags_lose_gain_and_a_delay_does_not() -> None:
    _, u = sine(3.0, 5.0, 100.0, 60.0, 2.5e-4)
    reference = lag_of_line(shifted(STRAIGHT, u, 2.5e-4), u, 100.0, 2.5e-4)
    amplifier, sensor, delay = (
        lag_of_line(shifted(STRAIGHT + e, u, 2.5e-4), u, 100.0, 2.5e-4)
        for e in (
            effect("amplifier_lag", tau_s=5e-4),
            effect("sensor_lag", tau_s=5e-4),
            effect("delay", delay_s=5e-4),
        )
    )
    expected = 10.0 / np.sqrt(1 + (2 * np.pi * 100.0 * 5e-4) ** 2)
    assert reference[0] == pytest.approx(10.0)
    assert amplifier[0] == pytest.approx(expected, rel=0.01)
    assert sensor[0] == pytest.approx(expected, rel=0.01)
    assert delay == pytest.approx((10.0, reference[1] + 5e-4), rel=1e-6)


def test_sensor_lag_filters_the_noise_and_amplifier_lag_does_not() -> None:
    noisy = STRAIGHT + effect("sensor_noise", rms_um=0.01)
    rest = np.zeros(50_000)
    assert shifted(noisy, rest).std() == pytest.approx(0.01, rel=0.02)
    assert shifted(noisy + effect("amplifier_lag", tau_s=1e-3), rest).std() == pytest.approx(0.01, rel=0.02)
    assert shifted(noisy + effect("sensor_lag", tau_s=1e-3), rest).std() < 0.007


def test_slew_limit_ramps_and_saturation_clips() -> None:
    step = np.full(100, 6.0)
    y = shifted(STRAIGHT + effect("slew_limit", rate_V_per_s=500.0), step)
    assert np.allclose(np.diff(y[:11]), 5.0)
    assert np.all(y[12:] == 60.0)
    _, slow = sine(0.0, 8.0, 0.5, 1.0)
    clipped = STRAIGHT + effect("saturation", low_V=0.0, high_V=6.5)
    assert shifted(clipped, slow).max() == shifted(clipped, slow[::20]).max() == 65.0


def test_sensor_nonlinearity_is_single_valued_and_of_the_stated_size() -> None:
    _, u = sine(0.0, 10.0, 1.0, 1.0)
    error = shifted(STRAIGHT + effect("sensor_nonlinearity", square=0.0, cubic=0.001), u) - shifted(STRAIGHT, u)
    assert np.abs(error).max() == pytest.approx(0.1, rel=1e-3)
    np.testing.assert_allclose(error[1:500], error[:500:-1], atol=1e-12)


def test_cross_talk_follows_the_other_axis() -> None:
    other = np.sin(np.arange(4000) * 0.01) * 20.0
    chain = STRAIGHT + effect("cross_talk", static=0.0117, rate_s=1e-3)
    y = simulate(chain, np.zeros(4000), DT, other_um=other)
    expected = 0.0117 * other + 1e-3 * np.concatenate(([0.0], np.diff(other))) / DT
    np.testing.assert_allclose(y, expected, atol=1e-12)


def test_hum_is_a_line_at_rest() -> None:
    y = shifted(STRAIGHT + effect("mains_hum", amplitude_um=0.01, frequency_Hz=50.0, third_share=0.5), np.zeros(10_000))
    spectrum = np.abs(np.fft.rfft(y)) / 5000
    assert spectrum[500] == pytest.approx(0.01, rel=1e-6)
    assert spectrum[1500] == pytest.approx(0.005, rel=1e-6)
    assert np.delete(spectrum, [500, 1500]).max() < 1e-9


def test_stick_slip_holds_then_jumps_with_constant_width() -> None:
    chain = STRAIGHT + effect("stick_slip", width_um=0.05, sliding_share=0.5)
    assert loop_height(chain, 1.0, 0.0, 1.0) == pytest.approx(loop_height(chain, 1.0, 0.0, 8.0), rel=0.2)
    y = along(chain, [0.0, 1.0, 0.9])
    steps = -np.diff(y[y.argmax() :])
    stuck = np.flatnonzero(steps > 0)[0]
    assert stuck >= 2  # flat first
    assert steps[stuck] > 1.5 * steps[stuck + 2]  # then a jump


def test_timing_repeats_readings_and_falls_behind() -> None:
    u = np.arange(20_000) * 1e-4
    y = shifted(STRAIGHT + effect("timing", repeat_probability=0.02), u)
    assert np.mean(np.diff(y) == 0.0) == pytest.approx(0.02, abs=0.004)
    late = shifted(STRAIGHT, u) - shifted(STRAIGHT + effect("timing", repeat_probability=0.0, slow_ppm=500.0), u)
    # 500 ppm of 20000 samples of 1e-3 µm each
    assert late[-1] == pytest.approx(20_000 * 500e-6 * 1e-3, rel=1e-3)
