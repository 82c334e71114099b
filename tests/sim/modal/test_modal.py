"""The modal fit on simulated stages: exact without noise, intervals with noise, noise from periods, softening."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.modal import FitSettings, PeriodicRecord, average, fit_modes, frequency_response, output_errors, study
from dehyst.sim.modal.periods import joined, realisations
from dehyst.sim.modal.study import RAYLEIGH_RATIO
from tests.sim.modal import simulated

DT_S = 1e-3
FREQUENCIES_HZ = np.array([37.0, 81.5, 84.0, 190.0, 333.0])
DAMPINGS = np.array([0.02, 0.011, 0.015, 0.008, 0.03])


def three_by_three(seed: int = 4) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return simulated.chain(FREQUENCIES_HZ, DAMPINGS, rng.normal(size=(3, 5)), rng.normal(size=(5, 3)), DT_S)


def by_state_space(system: tuple[FloatArray, FloatArray, FloatArray], u: FloatArray) -> FloatArray:
    """(samples, p, R) steady state, line by line from the state equations."""
    a, b, c = system
    samples = len(u)
    spectrum = np.fft.rfft(u, axis=0)
    z = np.exp(2j * np.pi * np.arange(len(spectrum)) / samples)
    states = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, np.broadcast_to(b, (len(z), *b.shape)) + 0j)
    return np.fft.irfft(c @ states @ spectrum, n=samples, axis=0)


def test_a_3x3_stage_is_recovered_exactly_without_noise() -> None:
    """Five modes, two of them within two bandwidths, stepped in time into the steady state."""
    rng = np.random.default_rng(1)
    u = simulated.orthogonal_multisines(rng, 1024, 3, 2, np.arange(1, 461), 0.2)
    a, b, c = three_by_three()
    y = simulated.run_linear(a, b, c, u, settle=6, periods=2)
    record = PeriodicRecord("simulated", np.repeat(u[..., None], 2, axis=3), y, DT_S)
    spectra = average(record)
    fit = fit_modes([frequency_response(spectra)], FitSettings(start_modes=8, most_steps=60))
    found = [int(np.argmin(np.abs(fit.model.frequencies_hz(0.2) - f))) for f in FREQUENCIES_HZ]
    assert np.allclose(fit.model.frequencies_hz(0.2)[found], FREQUENCIES_HZ, rtol=1e-6)
    assert np.allclose(fit.model.dampings(0.2)[found], DAMPINGS, rtol=1e-6)
    assert np.all(output_errors(fit.model, spectra) < 1e-6 * spectra.signal_um[:, None])


def test_the_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """95 % intervals of frequency and damping of both modes over 20 noise draws: 80 cases, 76 expected inside."""
    system = simulated.chain(
        np.array([60.0, 150.0]), np.array([0.02, 0.01]), np.array([[1.0, 0.4], [0.3, -0.8]]), np.eye(2), DT_S
    )
    inside, widths = 0, []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = simulated.orthogonal_multisines(rng, 512, 2, 2, np.arange(1, 231), 0.2)
        clean = by_state_space(system, u)
        y = clean[..., None] + 0.02 * rng.normal(size=(*clean.shape, 2))
        record = PeriodicRecord("simulated", np.repeat(u[..., None], 2, axis=3), y, DT_S)
        settings = FitSettings(start_modes=2, prune=False)
        fit = fit_modes([frequency_response(average(record))], settings)
        assert fit.model.modes == 2
        for i, (f, zeta) in enumerate(((60.0, 0.02), (150.0, 0.01))):
            for row, truth in ((i, f), (2 + i, zeta)):
                half = fit.interval(row, 0.2)
                inside += abs(fit.model.theta[row, 0] - np.log(truth)) <= half
                widths.append(half)
        assert fit.cost / fit.equations == pytest.approx(1.0, abs=0.25)
    # Binomial(80, 0.95): mean 76, standard deviation 1.9.
    assert inside >= 70
    assert max(widths) < 0.2


def _stage_at_three_amplitudes(kind: str) -> tuple[list[PeriodicRecord], FloatArray]:
    """A mode at 50 Hz with 3 % damping at three amplitudes, and the output's rms at each."""
    records, size = [], []
    for level, rms_V in enumerate((0.1, 0.2, 0.3)):
        rng = np.random.default_rng(10 + level)
        u = simulated.orthogonal_multisines(rng, 1024, 1, 6, np.arange(6, 200), rms_V)
        if kind == "cubic":

            def restoring(x: FloatArray) -> FloatArray:
                return x - 0.005 * x**3
        else:
            restoring = Stops(u.shape[2])
        y = simulated.run_oscillator(50.0, 0.03, restoring, u, 2e-3, settle=2, periods=2)
        records.append(PeriodicRecord(f"{rms_V} V", np.repeat(u[..., None], 2, axis=3), y, 2e-3))
        size.append(float(np.sqrt(np.mean(y**2))))
    return records, np.array(size)


class Stops:
    """Stop operators in parallel with equal steps of their thresholds: the virgin curve bends like Rayleigh's."""

    def __init__(self, count: int) -> None:
        self.thresholds = np.linspace(0.15, 4.0, 24)[:, None]
        self.state = np.zeros((24, count))
        self.last = np.zeros(count)

    def __call__(self, x: FloatArray) -> FloatArray:
        self.state = np.clip(self.state + (x - self.last), -self.thresholds, self.thresholds)
        self.last = x.copy()
        return x + 0.004 * (self.state.sum(axis=0) - 24.0 * x)


def test_an_elastic_softening_is_named_with_its_size() -> None:
    """A cubic restoring force: the Gaussian equivalent stiffness is ``1 - 3 * 0.005 * σ²`` and no loss is added."""
    records, size = _stage_at_three_amplitudes("cubic")
    found = study(records, settings=FitSettings(start_modes=3), hold_out=2)
    mode = max(found.modes, key=lambda m: float(m.participation_um[0]))
    expected = np.sqrt((1.0 - 0.015 * size[2] ** 2) / (1.0 - 0.015 * size[0] ** 2)) - 1.0
    assert expected < -0.003
    assert mode.frequency_change == pytest.approx(expected, rel=0.2)
    assert mode.finding == "softens elastically"
    assert mode.error_share > 0.1
    assert "softens by" in mode.sentence(0.1, 0.3)


def test_a_loop_in_the_stiffness_is_named() -> None:
    """Stop operators in the restoring force: softer and more damped, in Rayleigh's ratio."""
    records, _ = _stage_at_three_amplitudes("stops")
    found = study(records, settings=FitSettings(start_modes=3), hold_out=2)
    mode = max(found.modes, key=lambda m: float(m.participation_um[0]))
    assert mode.frequency_change < -0.003
    assert mode.damping_change > 2.0 * mode.damping_change_half
    assert mode.damping_rise_over_softening == pytest.approx(RAYLEIGH_RATIO, rel=0.35)
    assert mode.finding == "loop inside the mode"


def test_a_linear_stage_is_steady() -> None:
    records = []
    for level, rms_V in enumerate((0.1, 0.3)):
        rng = np.random.default_rng(20 + level)
        u = simulated.orthogonal_multisines(rng, 1024, 3, 2, np.arange(1, 461), rms_V)
        clean = by_state_space(three_by_three(), u)
        y = clean[..., None] + 0.002 * rng.normal(size=(*clean.shape, 2))
        records.append(PeriodicRecord(f"{rms_V} V", np.repeat(u[..., None], 2, axis=3), y, DT_S))
    found = study(records, settings=FitSettings(start_modes=8))
    assert [mode.finding for mode in found.modes] == ["steady"] * 5
    for level in found.levels:
        assert level.test_um is not None
        # Six readings' noise, the model's own uncertainty included.
        assert np.all(level.test_um < 1.3 * 0.002 / np.sqrt(2.0))


def test_records_of_one_amplitude_are_joined() -> None:
    rng = np.random.default_rng(5)
    u = simulated.orthogonal_multisines(rng, 512, 3, 2, np.arange(1, 231), 0.2)
    y = by_state_space(three_by_three(), u)
    whole = average(PeriodicRecord("whole", u[..., None], y[..., None], DT_S))
    parts = [average(PeriodicRecord("part", u[:, :, k : k + 3, None], y[:, :, k : k + 3, None], DT_S)) for k in (0, 3)]
    both = joined(parts)
    assert np.allclose(both.y, whole.y)
    assert both.amplitude_V == pytest.approx(whole.amplitude_V)
    assert np.allclose(realisations(both, slice(3, 6)).u, parts[1].u)


def test_what_cannot_be_solved_is_refused() -> None:
    rng = np.random.default_rng(6)
    u = simulated.orthogonal_multisines(rng, 512, 3, 1, np.arange(1, 231), 0.2)
    y = by_state_space(three_by_three(), u)
    few = average(PeriodicRecord("few", u[:, :, :2, None], y[:, :, :2, None], DT_S))
    with pytest.raises(InputError, match="got 2 for 3 drives"):
        frequency_response(few)
    alike = np.repeat(u[:, :, :1], 3, axis=2)
    with pytest.raises(InputError, match="phases that are alike"):
        frequency_response(average(PeriodicRecord("alike", alike[..., None], y[..., None], DT_S)))
    with pytest.raises(InputError, match="length of the period"):
        PeriodicRecord("cut", np.stack([u, np.roll(u, 7, axis=0)], axis=3), np.stack([y, y], axis=3), DT_S)
    with pytest.raises(InputError, match="constant drive"):
        PeriodicRecord("still", np.ones((64, 1, 1, 1)), np.ones((64, 1, 1, 1)), DT_S)
    response = frequency_response(average(PeriodicRecord("good", u[..., None], y[..., None], DT_S)))
    with pytest.raises(InputError, match="start from fewer modes"):
        fit_modes([response], FitSettings(start_modes=200))
    with pytest.raises(InputError, match="degree: got 1 with 1 amplitudes"):
        fit_modes([response], FitSettings(start_modes=8, degree=1))
