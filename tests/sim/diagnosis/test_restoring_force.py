"""Hysteresis in the restoring force of a mode: found beside a linear stage, measured, and given back as a stage."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.diagnose import diagnose_prepared
from dehyst.sim.diagnosis.export import export_stage
from dehyst.sim.diagnosis.prepare import prepare
from dehyst.sim.effects import effect, simulate
from dehyst.sim.fitting.dynamics import Dynamics, ForceLoop, respond
from dehyst.sim.fitting.hysteresis_loops import plays_nested
from dehyst.sim.recordings import Recording
from tests.mechanical_oscillator import MechanicalBoucWen
from tests.sim.diagnosis.plays import plays

DT = 1.0 / 750.0
#: A mode of 32 Hz and, at small motion, half as much stiffness again in its loop. In µm for m, which changes nothing.
TRUTH = MechanicalBoucWen(
    m_kg=1.0, c_N_s_per_m=6.0, k_N_per_m=4.0e4, alpha_N_per_m=2.0e4, g=0.8, d=-0.5, nu=1.0, scale_m=1.0
)


def multisine(n: int, seed: int) -> FloatArray:
    """One period, 5 to 150 Hz, random phases, 1 rms."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, DT)
    lines = np.where((f >= 5.0) & (f <= 150.0), np.exp(2j * np.pi * rng.random(f.size)), 0.0)
    u = np.fft.irfft(lines, n)
    return np.asarray(u / u.std())


def recording(seed: int, n: int = 2048, periods: int = 3, noise_um: float = 0.005) -> Recording:
    """Steady-state periods of the oscillator, integrated by another model at 20 steps a sample."""
    u = multisine(n, seed)
    force = 4.0e4 * u  # such that the spring alone would move by 1 µm a volt
    y = np.tile(TRUTH.steady_state(force, DT), periods)
    y = y + noise_um * np.random.default_rng(seed + 100).standard_normal(y.size)
    return Recording(t_s=np.arange(y.size, dtype=np.float64) * DT, u_V=np.tile(u, periods), y_um=y, dt_s=DT)


def test_hysteresis_in_the_force_is_named_alone_and_measured() -> None:
    diagnosis = diagnose_prepared(prepare(recording(1), nominal="linear", test=recording(2, periods=1)))
    assert [cause.name for cause in diagnosis.causes] == ["hysteresis_shape"]
    assert diagnosis.nominal_heldout_um > 20.0 * diagnosis.noise_floor_um
    assert diagnosis.extended_heldout_um < 1.5 * diagnosis.noise_floor_um
    numbers = diagnosis.causes[0].parameters
    # beta gamma and beta delta of the oscillator's equation.
    beta, gamma = TRUTH.products
    assert numbers["stiffness_share"] == pytest.approx(0.5, rel=0.02)
    assert numbers["beta_per_um"] == pytest.approx(beta, rel=0.02)
    assert numbers["gamma_per_um"] == pytest.approx(gamma, rel=0.05)
    # What it explains is measured against the linear stage as it is without it.
    assert float(np.std(diagnosis.causes[0].before_um)) < 1.5 * diagnosis.nominal_rmse_um
    exported = export_stage(diagnosis)
    assert exported.left_out == ()
    assert "mechanical_hysteresis" in [e.name for e in exported.config.effects]
    assert exported.rms_um < 2.0 * diagnosis.noise_floor_um


def test_the_effect_and_the_fitted_model_are_one_equation() -> None:
    u = np.repeat(np.random.default_rng(3).uniform(-1.0, 1.0, 150), 20)
    u[:20] = 0.0
    mode = effect(
        "mechanical_hysteresis",
        frequency_Hz=20.0,
        damping_ratio=0.05,
        stiffness_share=0.8,
        beta_per_um=0.6,
        gamma_per_um=-0.3,
    )
    stage = simulate(effect("linear_actuator", gain_um_per_V=5.0) + mode, u, DT)
    fitted = respond(5.0 * u, Dynamics((), ((20.0, 0.05),)), DT, ForceLoop(0.8, 0.3, 0.9, substeps=8))
    np.testing.assert_allclose(stage, fitted, atol=1e-6 * float(np.ptp(fitted)))
    without = respond(5.0 * u, Dynamics((), ((20.0, 0.05),)), DT)
    assert float(np.std(fitted - without)) > 0.1 * float(np.std(without))


def test_finer_steps_change_little() -> None:
    u = 5.0 * multisine(2048, 5)
    system = Dynamics((), ((25.0, 0.02),), 0.3 * DT, "first")
    coarse, fine = (respond(u, system, DT, ForceLoop(1.0, 0.05, 0.4, substeps=k)) for k in (4, 32))
    assert float(np.std(coarse - fine)) < 2e-3 * float(np.std(fine))


@pytest.mark.parametrize("seed", [0, 1])
def test_nested_plays_are_plays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.standard_normal(3000))
    u[700:800] = u[700]
    radii, weights = np.sort(rng.random(20)) * 30.0, rng.standard_normal(20)
    np.testing.assert_allclose(plays_nested(u, radii, weights), weights @ plays(u, radii), atol=1e-11)
