"""The guarded integral on top of the feedforward: its margins, its stability in loops, and what holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from dehyst.adaptive.correction.integral import GAIN_MARGIN, PHASE_MARGIN, Correction, design, sensitivity
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import Feedforward, FloatArray
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearParameters

DT_S = st.sampled_from([1e-4, 2e-4, 5e-4, 1e-3, 2e-3])
LAG_S = st.floats(0.0, 3e-3)
DAMPING = st.floats(0.01, 0.1)


@given(DT_S, st.integers(1, 20), LAG_S, st.floats(200.0, 2000.0), DAMPING)
@settings(max_examples=150, deadline=None)
def test_the_exact_loop_has_the_stated_margins(
    dt_s: float, age: int, lag_s: float, mode_Hz: float, damping: float
) -> None:
    if 2.0 * mode_Hz * dt_s >= 1.0:
        return  # samples cannot show the mode: see the simulated loops
    gain_per_s, filter_s = design(age * dt_s, lag_s, mode_Hz, dt_s)
    omega = 2.0 * math.pi * mode_Hz
    near = omega * (1.0 + np.linspace(-0.1, 0.1, 4001))
    w = np.sort(np.concatenate([np.geomspace(gain_per_s / 50.0, math.pi / dt_s, 20_000), near]))
    w = w[w < math.pi / dt_s]
    s, z = 1j * w, np.exp(1j * w * dt_s)
    alpha = dt_s / (dt_s + filter_s)
    control = gain_per_s * dt_s / (1.0 - 1.0 / z) * alpha / (1.0 - (1.0 - alpha) / z) * z**-age
    held = (1.0 - 1.0 / z) / (s * dt_s)
    stage = omega**2 / (s * s + 2.0 * damping * omega * s + omega**2) / (1.0 + s * lag_s)
    loop = control * held * stage
    size, phase = np.abs(loop), np.unwrap(np.angle(loop))
    crosses = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    assert (math.pi + phase[crosses]).min() >= PHASE_MARGIN
    turns = np.flatnonzero(np.diff(np.floor((phase + math.pi) / (2.0 * math.pi))) != 0)
    assert size[turns].max(initial=0.0) <= 1.0 / GAIN_MARGIN


def test_older_readings_and_slower_stages_get_less_gain() -> None:
    gains = [design(age * 1e-3, 1e-3, 200.0, 1e-3).gain_per_s for age in (1, 5, 20)]
    assert gains == sorted(gains, reverse=True)
    assert design(1e-3, 0.0, 200.0, 1e-3).gain_per_s > design(1e-3, 3e-3, 200.0, 1e-3).gain_per_s
    assert design(1e-3, 0.0, 400.0, 1e-3).gain_per_s > 1.5 * design(1e-3, 0.0, 200.0, 1e-3).gain_per_s


@dataclass
class Stage:
    """A linear stage: a lag and a mode of gain 1 µm/V under a held voltage, exactly; readings come ``age`` late."""

    dt_s: float
    age: int
    lag_s: float
    mode_Hz: float
    damping: float
    step: FloatArray = field(init=False)
    x: FloatArray = field(init=False)
    factors: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        w = 2.0 * math.pi * self.mode_Hz
        rate = 1.0 / max(self.lag_s, 1e-7)
        a = np.array([[-rate, 0, 0, rate], [0, 0, 1, 0], [w * w, -w * w, -2 * self.damping * w, 0], [0, 0, 0, 0.0]])
        self.step = expm(a * self.dt_s)
        self.x = np.zeros(4)

    def closed(
        self, correction: Correction, wanted: FloatArray, model: FloatArray, noise: FloatArray, speed: FloatArray
    ) -> FloatArray:
        """(n,) positions, µm, under ``model`` (n,), V, and the correction. ``wanted`` (n,) is asked for, µm."""
        position, self.factors = np.zeros(wanted.size), np.ones(wanted.size)
        for k in range(wanted.size):
            position[k] = self.x[1]
            seen = k - self.age
            residual = wanted[seen] - position[seen] - noise[seen] if seen >= 0 else math.nan
            correction.take(float(residual), float(speed[k]))
            self.factors[k] = correction.factor
            self.x[3] = model[k] + correction.u_V
            self.x = self.step @ self.x
        return position


@given(DT_S, st.integers(1, 20), LAG_S, st.floats(200.0, 2000.0), DAMPING, st.floats(0.7, 1.3))
@settings(max_examples=60, deadline=None)
def test_no_loop_is_unstable(dt_s: float, age: int, lag_s: float, mode_Hz: float, damping: float, slope: float) -> None:
    correction = Correction(dt_s, mode_Hz, 0.5)
    correction.set(age, slope, lag_s, 2.0)
    n = 60 * age + round(40.0 / (correction.loop.gain_per_s * dt_s))
    stage = Stage(dt_s, age, lag_s, mode_Hz, damping)
    position = stage.closed(correction, np.ones(n), np.zeros(n), np.zeros(n), np.full(n, 1e9))
    error = np.abs(1.0 - position)
    assert error[-n // 10 :].max() < 0.02
    assert (error.max(), correction.halved) <= (1.5, 0)


def made(dt_s: float = 1e-3, age: int = 1, mode_Hz: float = 200.0, bound_V: float = 2.0) -> Correction:
    correction = Correction(dt_s, mode_Hz, 0.1)
    correction.set(age, 1.0, 0.0, bound_V)
    return correction


def in_motion(correction: Correction, residual_um: float, n: int = 1) -> float:
    for _ in range(n):
        correction.take(residual_um, 1e9)
    return correction.u_V


def test_the_correction_keeps_its_bound_and_comes_back_from_it_at_once() -> None:
    correction = made(bound_V=0.5)
    assert in_motion(correction, 0.4, 2000) == 0.5
    assert in_motion(correction, -0.4, 30) < 0.4  # nothing has wound up


@pytest.mark.parametrize("residual_um", [0.6, -0.6, 1e6, math.nan, math.inf])
def test_a_doubted_reading_leaves_the_correction_as_it_is(residual_um: float) -> None:
    correction = made(bound_V=0.5)
    before_V = in_motion(correction, 0.1, 50)
    assert before_V > 0.0
    assert in_motion(correction, residual_um, 50) == before_V
    assert correction.doubted == 50
    # What stays doubtful is let go, within fade_s after fade_s.
    assert in_motion(correction, residual_um, 152) == 0.0


def test_a_correction_is_let_go_in_equal_steps_over_its_time() -> None:
    correction = made()
    from_V = in_motion(correction, 0.1, 200)
    way = [from_V]
    for _ in range(101):
        correction.release()
        way.append(correction.u_V)
    assert way[50] == pytest.approx(0.5 * from_V)
    assert way[-1] == 0.0
    assert np.abs(np.diff(way)).max() <= 1.001 * abs(from_V) * 1e-3 / 0.1


def test_a_bound_that_comes_down_makes_no_step() -> None:
    correction = made()
    before_V = in_motion(correction, 1.0, 200)
    correction.set(1, 1.0, 0.0, 0.1 * before_V)
    assert in_motion(correction, 0.0) > 0.98 * before_V
    assert in_motion(correction, 0.0, 400) <= 0.1 * before_V


def test_a_bound_that_readings_beyond_it_have_raised_is_not_used() -> None:
    """A fault of the sensor raises the deviation that the model states; only good readings raise the bound."""
    correction = Correction(1e-3, 200.0, 0.1)
    correction.set(1, 1.0, 0.0, 0.1)
    correction.take(0.05, math.inf)
    for _ in range(20):
        correction.set(1, 1.0, 0.0, 5.0)
        correction.take(3.0, math.inf)
    assert correction.doubted == 20
    assert abs(correction.u_V) < 0.1
    for _ in range(100):
        correction.take(0.05, math.inf)
    correction.take(0.2, math.inf)
    assert correction.doubted == 20


def test_what_a_model_takes_over_leaves_the_correction() -> None:
    correction = made()
    carried_V = in_motion(correction, 0.1, 200)
    correction.hand_over(0.25 * carried_V, math.inf)
    assert correction.u_V == pytest.approx(0.75 * carried_V)
    correction.hand_over(-carried_V, math.inf)  # the model has gone the other way: that is not resisted
    assert correction.u_V == pytest.approx(0.75 * carried_V)
    correction.hand_over(2.0 * carried_V, math.inf)
    assert correction.u_V == 0.0


@pytest.mark.parametrize("age", [1, 5])
def test_at_rest_the_noise_of_the_readings_does_not_move_the_stage(age: int) -> None:
    rng = np.random.default_rng(5)
    n, noise_um = 20_000, 0.01
    model = 0.1 * noise_um * rng.standard_normal(n)  # what the feedforward itself does at rest
    noise = noise_um * rng.standard_normal(n)
    jitter = []
    for on in (False, True):
        correction = made(age=age, bound_V=0.5 if on else 0.0)
        stage = Stage(1e-3, age, 1e-3, 200.0, 0.03)
        position = stage.closed(correction, np.zeros(n), model, noise, np.zeros(n))
        jitter.append(float(np.std(position[n // 2 :])))
    assert correction.noise_um == pytest.approx(noise_um, rel=0.15)
    assert jitter[1] <= 1.1 * jitter[0]


def test_at_rest_an_offset_beyond_the_noise_is_still_corrected() -> None:
    rng = np.random.default_rng(6)
    n, noise_um = 5000, 0.01
    stage, correction = Stage(1e-3, 1, 1e-3, 200.0, 0.03), made(bound_V=0.5)
    position = stage.closed(correction, np.full(n, 0.3), np.zeros(n), noise_um * rng.standard_normal(n), np.zeros(n))
    assert abs(0.3 - position[-1000:].mean()) < noise_um


@pytest.mark.parametrize(
    ("dt_s", "stated_Hz", "mode_Hz", "damping"),
    [(2e-4, 400.0, 80.0, 0.02), (2e-4, 400.0, 60.0, 0.01), (1e-3, 200.0, 40.0, 0.02), (1e-3, 1000.0, 200.0, 0.003)],
)
def test_no_unstable_gain_is_kept_for_ten_periods(
    dt_s: float, stated_Hz: float, mode_Hz: float, damping: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage rings at a fraction of the frequency that was stated, or is damped less."""
    n, age = round(1.5 / dt_s), round(1e-3 / dt_s)
    push = np.concatenate([np.full(200, 0.05), np.zeros(n - 200)])

    def run() -> tuple[FloatArray, FloatArray]:
        correction, stage = made(dt_s, age, stated_Hz, bound_V=1.0), Stage(dt_s, age, 0.0, mode_Hz, damping)
        return np.abs(stage.closed(correction, push, np.zeros(n), np.zeros(n), np.full(n, 1e9))), stage.factors

    kept_um, factors = run()
    changes = np.flatnonzero(np.diff(factors))
    assert changes.size
    # From the first residual above the learner's error on, each gain but the last, which is stable.
    begin = int(np.argmax(kept_um > 0.25))
    assert np.diff([begin, *changes]).max() * dt_s * mode_Hz < 10.0
    assert kept_um[-n // 10 :].max() < 0.25
    monkeypatch.setattr("dehyst.adaptive.correction.integral._HALF_PERIODS", 10**9)
    assert run()[0][-n // 10 :].max() > 0.6


def test_a_ring_that_dies_away_and_the_motion_itself_are_no_oscillation_of_the_loop() -> None:
    t = np.arange(4000) * 1e-3
    correction = made(bound_V=1.0)
    for ring in np.exp(-0.01 * 2 * np.pi * 50.0 * t) * np.sin(2 * np.pi * 50.0 * t):
        correction.take(float(ring), 1e9)
    # After a step of the gain: about a place that comes back slowly, behind a small error on the other side.
    correction.set(1, 1.0, 0.0, 0.2)
    in_motion(correction, 0.06, 20)
    correction.set(1, 1.0, 0.0, 1.0)
    for ring in 0.8 * np.exp(-100.0 * t) + np.exp(-0.02 * 2 * np.pi * 110.0 * t) * np.sin(2 * np.pi * 110.0 * t):
        correction.take(-0.6 * float(ring), 1e9)
    for wave in t:  # an error that goes with a motion of 25 Hz
        correction.take(0.5 * math.sin(2 * math.pi * 25.0 * wave), math.cos(2 * math.pi * 25.0 * wave))
    assert correction.halved == 0
    rng, correction = np.random.default_rng(7), made(bound_V=1.0)
    for noise in 0.3 * rng.standard_normal(20_000):
        correction.take(float(noise), 1e9)
    assert correction.halved == 0


def test_the_gain_comes_back_after_a_quiet_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dehyst.adaptive.correction.integral._RECOVER_S", 0.5)
    correction = made(bound_V=1.0)
    for k in range(400):
        correction.take(0.5 * math.sin(2e-3 * math.pi * 20.0 * k), 1e9)
    halved = correction.halved
    assert (halved > 0, correction.factor) == (True, 0.5**halved)
    in_motion(correction, 0.0, 500 * halved + 600)
    assert correction.factor == 1.0


class AfterATurn:
    """A stage that has just turned: 2 V/µm on the way back, 0.5 V/µm on the way that it went; 3 ms late."""

    memory_size = 0

    def feedforward(self, y_um: FloatArray, v: FloatArray, a: FloatArray, memory: FloatArray) -> Feedforward:
        u_V = np.where(y_um > 10.0, 0.5, 2.0) * (y_um - 10.0) + 0.5 * 3e-3 * v
        return Feedforward(u_V, np.zeros(1), np.ones(1, dtype=np.bool_), memory)


def test_slope_and_lag_are_those_of_the_branch_on_which_the_stage_moves() -> None:
    seen = Domain(0.0, 90.0, 2000.0)
    line = LinearInverse(LinearParameters(-4.0), 1e-3, seen)
    assert sensitivity(line, 10.0, np.empty(0), 100.0) == (pytest.approx(-0.25), 0.0)
    assert sensitivity(AfterATurn(), 10.0, np.empty(0), 100.0) == (pytest.approx(0.5), pytest.approx(3e-3))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["dt_s", "mode_Hz", "fade_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_impossible_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name}: got {value}"):
        Correction(**{"dt_s": 1e-3, "mode_Hz": 200.0, "fade_s": 0.5, name: value})


@pytest.mark.parametrize("taken_V", [0.3, -0.2])
def test_at_rest_a_new_model_comes_gradually_and_in_motion_at_once(taken_V: float) -> None:
    def at(speed_um_per_s: float) -> list[float]:
        one, rng = Correction(1e-3, 200.0, 0.5), np.random.default_rng(1)
        one.set(1, 1.0, 0.0, 1.0)
        for _ in range(50):
            one.take(0.01 * rng.standard_normal(), speed_um_per_s)
        before_V = one.u_V
        one.hand_over(taken_V, speed_um_per_s)
        total_V = [taken_V + one.u_V - before_V]
        for k in range(500):
            one.let_in()  # whatever comes of the readings
            one.take(0.01 * rng.standard_normal() if k > 400 else math.nan, speed_um_per_s)
            total_V.append(taken_V + one.u_V - before_V)
        return total_V

    resting = at(0.0)
    assert abs(resting[0]) < 1e-12
    assert np.abs(np.diff(resting)).max() < 0.5 * abs(taken_V)
    assert resting[-1] == pytest.approx(taken_V, abs=0.02)
    assert at(100.0)[0] == pytest.approx(taken_V, abs=0.05)
