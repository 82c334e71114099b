"""Each effect's own signature is visible in what it does to a simple stage."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sim.effects import Chain, Effect, effect, simulate
from sim.signals.voltages import sine, triangle

DT = 1e-3
LINEAR = Chain((effect("linear_actuator", gain_um_per_V=10.0),))


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
    chain = LINEAR + effect("hysteresis_shape", width_um=5.0, largest_V=2.0)
    assert loop_height(chain, 1e-3) == pytest.approx(5.0, rel=0.02)
    assert loop_height(chain, 10.0) == pytest.approx(5.0, rel=0.02)


def test_delay_loop_vanishes_at_low_rate() -> None:
    chain = LINEAR + effect("delay", delay_s=1e-3)
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
        chain = LINEAR.without("linear_actuator") + effect(name, **values)
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
    plain = LINEAR + effect("hysteresis_shape")
    bent = Chain((effect("generalised_play", rate_growth_V=0.0, lower_slope=0.3, upper_slope=0.3),))
    assert loop_height(plain, 1.0, 1.0, 3.0) == pytest.approx(loop_height(plain, 1.0, 5.0, 7.0), rel=1e-6)
    assert abs(loop_height(bent, 1.0, 5.0, 7.0) / loop_height(bent, 1.0, 1.0, 3.0) - 1.0) > 0.05


def test_asymmetry_makes_even_harmonics() -> None:
    _, u = sine(-4.0, 4.0, 1.0, 4.0)
    odd = shifted(LINEAR + effect("hysteresis_shape"), u)[-1000:]
    even = shifted(LINEAR + effect("hysteresis_shape") + effect("asymmetry", dead_zone_V=1.0), u)[-1000:]
    spectrum_odd, spectrum_even = np.abs(np.fft.rfft(odd)), np.abs(np.fft.rfft(even))
    assert spectrum_odd[3] > 20 * spectrum_odd[2]
    assert spectrum_even[2] > 20 * spectrum_odd[2]


def test_rate_dependence_widens_the_loop() -> None:
    chain = LINEAR + effect("hysteresis_shape", width_um=5.0) + effect("rate_dependence", width_um=5.0, largest_V=2.0)
    slow, middle, fast = (loop_height(chain, f) for f in (1e-3, 1.0, 10.0))
    assert slow == pytest.approx(loop_height(chain.without("rate_dependence"), 1e-3), rel=5e-3)
    assert fast > middle + 0.2 > slow + 0.3


def test_creep_rises_linearly_in_log_time() -> None:
    step = np.full(300_000, 4.0)
    y = shifted(LINEAR + effect("creep", gain_per_decade=0.015), step)
    marks = np.array([0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 290.0])
    at = y[np.round(marks / DT).astype(int)]
    slope, _ = np.polyfit(np.log10(marks), at, 1)
    assert slope == pytest.approx(0.015 * 40.0, rel=0.05)
    down = shifted(LINEAR + effect("creep"), np.concatenate((step[:100_000], np.zeros(100_000))))
    assert down[100_100] > down[150_000] > down[-1] > 0.0  # it follows the last step, downwards


def test_thermal_drift_is_there_at_rest_and_creep_is_not() -> None:
    rest = np.zeros(60_000)
    assert np.all(shifted(LINEAR + effect("creep"), rest) == 0.0)
    y = shifted(LINEAR + effect("thermal_drift", amplitude_um=0.5, tau_s=20.0), rest)
    t = (np.arange(60_000) + 1) * DT
    np.testing.assert_allclose(y, 0.5 * (1 - np.exp(-t / 20.0)), atol=1e-9)
    walk = shifted(LINEAR + effect("thermal_drift", amplitude_um=0.0, walk_um_per_sqrt_min=0.1), rest)
    assert np.std(np.diff(walk)) == pytest.approx(0.1 * np.sqrt(DT / 60.0), rel=0.02)


def test_gain_drift_is_in_proportion() -> None:
    _, u = sine(0.0, 8.0, 1.0, 60.0)
    plain, drifting = shifted(LINEAR, u), shifted(LINEAR + effect("gain_drift", ramp_per_min=0.02), u)
    t = (np.arange(u.size) + 1) * DT
    np.testing.assert_allclose(drifting, plain * (1 + 0.02 * t / 60.0), atol=1e-9)


@pytest.mark.parametrize("change", [{"resonance.payload_ratio": 1.0}, {"payload_change.payload_ratio": 1.0}])
def test_payload_moves_the_mode_and_not_the_gain(change: dict[str, float]) -> None:
    chain = LINEAR + effect("resonance", frequency_Hz=300.0, damping_ratio=0.01)
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
    reference = lag_of_line(shifted(LINEAR, u, 2.5e-4), u, 100.0, 2.5e-4)
    amplifier, sensor, delay = (
        lag_of_line(shifted(LINEAR + e, u, 2.5e-4), u, 100.0, 2.5e-4)
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
    noisy = LINEAR + effect("sensor_noise", rms_um=0.01)
    rest = np.zeros(50_000)
    assert shifted(noisy, rest).std() == pytest.approx(0.01, rel=0.02)
    assert shifted(noisy + effect("amplifier_lag", tau_s=1e-3), rest).std() == pytest.approx(0.01, rel=0.02)
    assert shifted(noisy + effect("sensor_lag", tau_s=1e-3), rest).std() < 0.007


def test_slew_limit_ramps_and_saturation_clips() -> None:
    step = np.full(100, 6.0)
    y = shifted(LINEAR + effect("slew_limit", rate_V_per_s=500.0), step)
    assert np.allclose(np.diff(y[:11]), 5.0)
    assert np.all(y[12:] == 60.0)
    _, slow = sine(0.0, 8.0, 0.5, 1.0)
    clipped = LINEAR + effect("saturation", low_V=0.0, high_V=6.5)
    assert shifted(clipped, slow).max() == shifted(clipped, slow[::20]).max() == 65.0


def test_sensor_nonlinearity_is_single_valued_and_of_the_stated_size() -> None:
    _, u = sine(0.0, 10.0, 1.0, 1.0)
    error = shifted(LINEAR + effect("sensor_nonlinearity", square=0.0, cubic=0.001), u) - shifted(LINEAR, u)
    assert np.abs(error).max() == pytest.approx(0.1, rel=1e-3)
    np.testing.assert_allclose(error[1:500], error[:500:-1], atol=1e-12)


def test_cross_talk_follows_the_other_axis() -> None:
    other = np.sin(np.arange(4000) * 0.01) * 20.0
    chain = LINEAR + effect("cross_talk", static=0.0117, rate_s=1e-3)
    y = simulate(chain, np.zeros(4000), DT, other_um=other)
    expected = 0.0117 * other + 1e-3 * np.concatenate(([0.0], np.diff(other))) / DT
    np.testing.assert_allclose(y, expected, atol=1e-12)


def test_hum_is_a_line_at_rest() -> None:
    y = shifted(LINEAR + effect("mains_hum", amplitude_um=0.01, frequency_Hz=50.0, third_share=0.5), np.zeros(10_000))
    spectrum = np.abs(np.fft.rfft(y)) / 5000
    assert spectrum[500] == pytest.approx(0.01, rel=1e-6)
    assert spectrum[1500] == pytest.approx(0.005, rel=1e-6)
    assert np.delete(spectrum, [500, 1500]).max() < 1e-9


def test_quantisation_leaves_few_levels() -> None:
    _, u = sine(0.0, 0.1, 1.0, 1.0)
    assert np.unique(shifted(LINEAR + effect("quantisation", step_um=0.1), u)).size == 11


def test_stick_slip_holds_then_jumps_with_constant_width() -> None:
    chain = LINEAR + effect("stick_slip", width_um=0.05, sliding_share=0.5)
    assert loop_height(chain, 1.0, 0.0, 1.0) == pytest.approx(loop_height(chain, 1.0, 0.0, 8.0), rel=0.2)
    y = along(chain, [0.0, 1.0, 0.9])
    steps = -np.diff(y[y.argmax() :])
    stuck = np.flatnonzero(steps > 0)[0]
    assert stuck >= 2  # flat first
    assert steps[stuck] > 1.5 * steps[stuck + 2]  # then a jump


def test_timing_repeats_readings_and_falls_behind() -> None:
    u = np.arange(20_000) * 1e-4
    y = shifted(LINEAR + effect("timing", repeat_probability=0.02), u)
    assert np.mean(np.diff(y) == 0.0) == pytest.approx(0.02, abs=0.004)
    late = shifted(LINEAR, u) - shifted(LINEAR + effect("timing", repeat_probability=0.0, slow_ppm=500.0), u)
    # 500 ppm of 20000 samples of 1e-3 µm each
    assert late[-1] == pytest.approx(20_000 * 500e-6 * 1e-3, rel=1e-3)


def test_dac_grid() -> None:
    y = shifted(effect("dac", bits=8, span_V=20.0) + Chain(), np.array([0.03, 0.05, 12.0, -12.0]))
    np.testing.assert_allclose(y, [0.0, 20 / 256, 127 * 20 / 256, -10.0])
