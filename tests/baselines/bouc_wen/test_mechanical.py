"""The force-driven Bouc-Wen oscillator: integration, identification, and the field's benchmark."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from adaptive.errors import InputError
from adaptive.types import FloatArray
from baselines.bouc_wen.mechanical import MechanicalBoucWen, PeriodicRecord, between_samples, identify_mechanical

DATA = Path(os.environ.get("DEHYST_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
MODEL = MechanicalBoucWen(2.0, 40.0, 5e4, 5e4, 0.5, -0.3, 1.3, 6e-4)
RATE_HZ = 750.0


def multisine(n: int, rms: float, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    lines = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    spectrum = np.where((lines >= 5.0) & (lines <= 150.0), np.exp(2j * np.pi * rng.uniform(size=lines.size)), 0.0)
    u = np.fft.irfft(spectrum, n)
    return np.asarray(u * (rms / np.std(u)), dtype=np.float64)


def test_interpolation_is_exact_for_a_band_limited_signal() -> None:
    t = np.arange(64) / 64
    fine = np.arange(64 * 8) / (64 * 8)

    def wave(t: FloatArray) -> FloatArray:
        return np.asarray(np.sin(2 * np.pi * 5 * t + 0.3) + 0.2 * np.cos(2 * np.pi * 29 * t), dtype=np.float64)

    np.testing.assert_allclose(between_samples(wave(t), 8), wave(fine), atol=1e-12)


def test_integration_agrees_with_an_adaptive_solver_written_from_the_equation() -> None:
    n, dt_s = 256, 1.0 / RATE_HZ
    u = multisine(n, 50.0, 1)
    product_g, product_d = MODEL.products
    nu = MODEL.nu
    spectrum = np.fft.rfft(u) / n
    omega = 2.0 * np.pi * np.fft.rfftfreq(n, dt_s)

    def force(t: float) -> float:
        return float(2.0 * np.real(np.sum(spectrum[1:-1] * np.exp(1j * omega[1:-1] * t))))

    def right(t: float, s: FloatArray) -> list[float]:
        y, v, z = s
        z_rate = MODEL.alpha_N_per_m * v - product_g * abs(v) * abs(z) ** (nu - 1.0) * z - product_d * v * abs(z) ** nu
        return [v, (force(t) - MODEL.c_N_s_per_m * v - MODEL.k_N_per_m * y - z) / MODEL.m_kg, z_rate]

    periods = 3
    at = (np.arange(n) + periods * n) * dt_s
    found = solve_ivp(right, (0.0, at[-1]), [0.0, 0.0, 0.0], t_eval=at, rtol=1e-8, atol=1e-11, max_step=dt_s / 2)
    out = MODEL.steady_state(u, dt_s, oversample=40, settle=float(periods))
    assert np.max(np.abs(out - found.y[0])) < 2e-4 * np.std(out)


def test_steps_of_half_the_size_change_little() -> None:
    u = multisine(1024, 50.0, 2)
    coarse, fine = (MODEL.steady_state(u, 1.0 / RATE_HZ, steps, 2.0) for steps in (10, 20))
    assert np.std(coarse - fine) < 3e-4 * np.std(fine)


def test_identification_finds_the_parameters_of_a_noisy_record() -> None:
    n, periods, noise = 2048, 4, 2e-6
    rng = np.random.default_rng(5)
    records = []
    for seed in (11, 12):
        u = multisine(n, 50.0, seed)
        y = np.tile(MODEL.steady_state(u, 1.0 / RATE_HZ, settle=2.0), periods)
        y = y + noise * rng.standard_normal(y.size)
        records.append(PeriodicRecord.of(np.tile(u, periods), y, 1.0 / RATE_HZ, n))
    assert records[0].noise_m == pytest.approx(noise / np.sqrt(periods), rel=0.1)
    found, report = identify_mechanical(records, oversample=10)
    assert report.rmse_m == pytest.approx(noise / np.sqrt(periods), rel=0.1)
    for name in ("m_kg", "k_N_per_m", "alpha_N_per_m"):
        assert getattr(found, name) == pytest.approx(getattr(MODEL, name), rel=5e-3)
    assert found.nu == pytest.approx(MODEL.nu, abs=0.02)
    np.testing.assert_allclose(found.products, MODEL.products, rtol=0.25)
    test = multisine(n, 50.0, 13)
    truth = MODEL.steady_state(test, 1.0 / RATE_HZ, settle=2.0)
    assert np.sqrt(np.mean((found.steady_state(test, 1.0 / RATE_HZ, settle=2.0) - truth) ** 2)) < 5e-7


def test_bad_input_is_named() -> None:
    u = multisine(64, 1.0, 0)
    with pytest.raises(InputError, match="whole periods"):
        PeriodicRecord.of(u, u, 1e-3, 63)
    with pytest.raises(InputError, match="differs from period to period"):
        PeriodicRecord.of(u, u, 1e-3, 32)
    with pytest.raises(InputError, match="records"):
        identify_mechanical([])
    with pytest.raises(InputError, match="m_kg"):
        replace(MODEL, m_kg=-1.0)
    with pytest.raises(InputError, match="oversample"):
        MODEL.steady_state(u, 1e-3, 0)


def test_benchmark_is_predicted_ten_times_better_than_published() -> None:
    folder = DATA / "boucwen_benchmark"
    if not folder.is_dir():
        pytest.skip("no boucwen_benchmark: set DEHYST_DATA to the folder of measured data")
    with (
        np.load(folder / "train_multisine_5periods_noisy.npz") as train,
        np.load(folder / "test_multisine.npz") as test,
    ):
        record = PeriodicRecord.of(train["u_N"].ravel(), train["y_m"].ravel(), 1.0 / RATE_HZ, 8192)
        u, y = test["u_N"].ravel(), test["y_m"].ravel()
    found, report = identify_mechanical([record])
    assert report.rmse_m < 1.1 * report.noise_m
    assert np.sqrt(np.mean((found.steady_state(u, 1.0 / RATE_HZ) - y) ** 2)) < 1e-6
