"""Identification of the baselines, and the bounded least squares below it."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines import fit_bouc_wen, fit_linear, fit_mpi
from dehyst.baselines.bouc_wen.identify import identify_bouc_wen
from dehyst.baselines.bouc_wen.model import TABLE_2_1
from dehyst.baselines.bounded_least_squares import bounded_least_squares, bounded_minimum
from dehyst.baselines.linear import identify_linear
from dehyst.baselines.prandtl_ishlinskii.identify import MpiGrid, identify_mpi
from dehyst.baselines.prandtl_ishlinskii.model import inverse_thresholds, inverse_weights
from dehyst.baselines.prandtl_ishlinskii.operators import dead_zone, play_run, play_start
from dehyst.baselines.swarm import SwarmConfig, minimise, swarm_bouc_wen, swarm_mpi

# --- Identification: known parameters come back, scale and offset hold, bad recordings are refused by name.


def chapter_input(dt_s: float, n: int, amplitude_V: float = 4.0) -> FloatArray:
    """(2.37), V."""
    t = np.arange(n) * dt_s
    return amplitude_V * np.exp(-0.11 * t) * (np.sin(6 * np.pi * t * np.exp(-0.345 * t) - 1.55) + 1)


def other_input(dt_s: float, n: int) -> FloatArray:
    """(2.45), V."""
    t = np.arange(n) * dt_s
    return 4 * np.exp(-0.14 * t) * (np.cos(3 * np.pi * t * np.exp(-0.092 * t) - 3.15) + 1)


def measured(name: str) -> tuple[FloatArray, FloatArray]:
    """Voltage V and displacement µm of a measured recording at 5 ms; skips the test where the data are missing."""
    root = Path(os.environ.get("DEHYST_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    path = root / "picma_stack" / name
    if not path.exists():
        pytest.skip(f"measured data are missing: {path} (set DEHYST_DATA)")
    columns = np.genfromtxt(path, delimiter=",", names=True)
    return columns["u_V"], columns["y_um"]


def test_linear_recovers_a_line() -> None:
    u = chapter_input(0.02, 300)
    parameters, report = identify_linear(u, -3.0 + 11.5 * u, 0.02)
    assert parameters.gain_um_per_V == pytest.approx(11.5)
    assert parameters.offset_um == pytest.approx(-3.0)
    assert report.rmse_um < 1e-10


@pytest.mark.parametrize(("dt_s", "n"), [(0.02, 500), (1e-3, 6000)])
def test_bouc_wen_parameters_come_back(dt_s: float, n: int) -> None:
    truth = replace(TABLE_2_1, offset_um=-7.0)
    u = chapter_input(dt_s, n)
    noise = np.random.default_rng(1).normal(0.0, 0.01, n)
    found, report = identify_bouc_wen(u, truth.simulate(u, dt_s) + noise, dt_s)
    assert found.d_um_per_V == pytest.approx(truth.d_um_per_V, rel=2e-3)
    assert found.alpha == pytest.approx(truth.alpha, rel=1e-2)
    assert found.beta_per_V == pytest.approx(truth.beta_per_V, rel=3e-2)
    assert found.gamma_per_V == pytest.approx(truth.gamma_per_V, rel=3e-2)
    assert found.lag_s == pytest.approx(truth.lag_s, rel=2e-2)
    assert found.inertia_s2 == pytest.approx(TABLE_2_1.inertia_s2, rel=1e-9), "m/k that does not show is left out"
    assert found.offset_um == pytest.approx(-7.0, abs=0.02)
    assert report.rmse_um == pytest.approx(0.01, rel=0.1)
    held_out = other_input(dt_s, n)
    assert np.max(np.abs(found.simulate(held_out, dt_s) - truth.simulate(held_out, dt_s))) < 0.05


def test_bouc_wen_finds_a_resonance_that_shows() -> None:
    truth = replace(TABLE_2_1, m_kg=1500.0, b_N_s_per_m=4e4, k_N_per_m=3.5244e8)  # 77 Hz, damping 0.03
    u = np.repeat(np.random.default_rng(2).uniform(0.5, 7.0, 60), 50)
    u = np.convolve(u, np.ones(8) / 8, mode="valid")
    y = truth.simulate(u, 1e-3) + np.random.default_rng(3).normal(0.0, 0.005, u.size)
    found, _ = identify_bouc_wen(u, y, 1e-3)
    assert found.inertia_s2 == pytest.approx(truth.inertia_s2, rel=0.01)
    assert found.lag_s == pytest.approx(truth.lag_s, rel=0.05)


def test_bouc_wen_start_in_the_middle_and_off_balance() -> None:
    truth = replace(TABLE_2_1, b_N_s_per_m=4e6, offset_um=-120.0)
    u = 3.0 + 2.0 * np.sin(2 * np.pi * np.arange(3000) * 5e-3)
    state = truth.at_rest(0.0)
    state[0] = u[0]
    y = truth.simulate(u, 5e-3, state)  # modes at rest for 0 V, voltage at 3 V: a large transient
    found, report = identify_bouc_wen(u, y, 5e-3)
    assert report.rmse_um < 1e-3
    assert "initial hysteresis free" in report.method
    assert found.d_um_per_V == pytest.approx(truth.d_um_per_V, rel=1e-2)


def mpi_truth(u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An MPI stage on the very thresholds that identification will choose; returns y, w_h, inverse weights."""
    w_h = np.array([7.0, 1.5, 1.0, 0.0, 0.8, 0.5, 0.3, 0, 0, 0, 0, 0, 0])
    r = np.arange(13) / 13 * np.max(np.abs(u))
    x = play_run(u, r, play_start(float(u[0]), r)) @ w_h
    x -= x.min()
    top = float(x.max())
    slopes = np.array([1.2, 1.1, 1.0, 0.9, 0.95, 0.9, 0.95])
    # With the scale constraint the stroke is its own image: mean slope one over seven equal segments.
    slopes /= slopes.mean()
    d_star, w_star = np.arange(7) / 7 * top, np.diff(slopes, prepend=0.0)
    d, w_s = inverse_thresholds(w_star, d_star), inverse_weights(w_star)
    return dead_zone(x, d) @ w_s, w_h, w_star


def test_mpi_weights_come_back_exactly() -> None:
    u = chapter_input(0.02, 500)
    u[0] = 0.0
    y, w_h, w_star = mpi_truth(u)
    found, report = identify_mpi(u, y + 5.0, 0.02)
    assert report.rmse_um < 1e-7
    np.testing.assert_allclose(inverse_weights(found.w_s_), w_star, atol=1e-6)
    # Plays with r above half the stroke move on the first rise only; they and the offset are told apart by it.
    np.testing.assert_allclose(found.w_h_[:6], w_h[:6], atol=1e-5)


def test_mpi_scale_is_fixed_and_the_offset_free() -> None:
    u = chapter_input(0.02, 500)
    y = TABLE_2_1.simulate(u, 0.02)
    found, report = identify_mpi(u, y, 0.02)
    stroke = float(np.ptp(y))
    d_star, w_star = inverse_thresholds(found.w_s_, found.d_), inverse_weights(found.w_s_)
    assert float((dead_zone(np.array([stroke]), d_star) @ w_star)[0]) == pytest.approx(stroke, rel=1e-9)
    moved, _ = identify_mpi(u, y - 100.0, 0.02)
    np.testing.assert_allclose(moved.simulate(u, 0.02), found.simulate(u, 0.02) - 100.0, atol=1e-6)
    assert report.rmse_pct < 0.8
    assert report.rmse_um < 0.3 * identify_linear(u, y, 0.02)[1].rmse_um


def test_mpi_is_the_minimum_among_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convexity at work: no small change of the weights within the bounds makes the residual of (2.40) smaller."""
    u = chapter_input(0.02, 500)
    y = TABLE_2_1.simulate(u, 0.02)
    monkeypatch.setattr(sys.modules[MpiGrid.__module__], "_ROUNDS", 0)  # (2.40) itself
    found, _ = identify_mpi(u, y, 0.02)
    grid = MpiGrid.of(u, y)
    plays = play_run(u, grid.r_V, play_start(float(u[0]), grid.r_V))
    curve = dead_zone(y - grid.y_ref_um, grid.d_star_um)
    w_star = inverse_weights(found.w_s_)

    def cost(w_h: FloatArray, w: FloatArray, c: float) -> float:
        scale = grid.stroke_um / float((dead_zone(np.array([grid.stroke_um]), grid.d_star_um) @ w)[0])
        return float(np.sum((scale * (plays @ w_h + c - curve @ w)) ** 2))

    best = cost(found.w_h_, w_star, found.c_um)
    rng = np.random.default_rng(4)
    for _ in range(200):
        w_h = np.maximum(found.w_h_ + rng.normal(0, 1e-3, 13), 0.0)
        assert cost(w_h, w_star + rng.normal(0, 1e-4, 7), found.c_um + rng.normal(0, 1e-3)) > best * (1 - 1e-9)


def test_mpi_lag_comes_back() -> None:
    u = chapter_input(1e-3, 8000)
    u[0] = 0.0
    y, _, _ = mpi_truth(u)
    model, _ = identify_mpi(u, y, 1e-3)
    late = replace(model, lag_s=4e-3).simulate(u, 1e-3)
    found, report = identify_mpi(u, late, 1e-3, fit_lag=True)
    assert found.lag_s == pytest.approx(4e-3, abs=3e-4)
    assert report.rmse_um < 0.05
    assert identify_mpi(u, late, 1e-3)[1].rmse_um > 3 * report.rmse_um


@pytest.mark.parametrize(
    ("identify", "limit_um", "test_um"),
    [(identify_linear, 3.6, 2.7), (identify_mpi, 0.6, 1.1), (identify_bouc_wen, 0.4, 0.75)],
)
def test_measured_stack(identify: object, limit_um: float, test_um: float) -> None:
    """The measured stack actuator: fit on its 1 Hz sine, held out on the ramped sine (mean offset removed)."""
    u, y = measured("model_sine_1hz.csv")
    parameters, report = identify(u, y, 5e-3)  # type: ignore[operator]
    error = y - parameters.simulate(u, 5e-3)
    assert np.std(error[4000:]) < limit_um  # the recording starts in the middle of a past that nobody knows
    assert report.samples == u.size
    u, y = measured("test_ramped_sine_ff.csv")
    assert np.std((y - parameters.simulate(u, 5e-3))[1000:]) < test_um


def test_fit_gives_models_that_answer() -> None:
    u = chapter_input(0.02, 500)
    y = TABLE_2_1.simulate(u, 0.02)
    for fit in (fit_linear, fit_mpi, fit_bouc_wen):
        model, report = fit(u, y, 0.02, serve_dt_s=1e-3)
        assert model.dt_s == 1e-3
        assert model.voltage_std_V == pytest.approx(report.rmse_um * np.ptp(u) / np.ptp(y))
        assert model.domain == report.domain


@pytest.mark.parametrize("identify", [identify_linear, identify_mpi, identify_bouc_wen])
@pytest.mark.parametrize(
    ("u", "y", "dt", "named"),
    [
        (np.ones(100), np.arange(100.0), 0.02, "u_V"),
        (np.arange(100.0), np.zeros(100), 0.02, "y_um"),
        (np.arange(100.0), np.arange(99.0), 0.02, "y_um"),
        (np.arange(100.0), np.full(100, np.nan), 0.02, "y_um"),
        (np.arange(100.0), np.arange(100.0), 0.0, "dt_s"),
        (np.arange(2.0), np.arange(2.0), 0.02, "u_V"),
        (np.ones((10, 10)), np.arange(100.0), 0.02, "u_V"),
    ],
)
def test_bad_recordings_are_refused_by_name(
    identify: object, u: FloatArray, y: FloatArray, dt: float, named: str
) -> None:
    with pytest.raises(InputError, match=f"^{named}"):
        identify(u, y, dt)  # type: ignore[operator]


class TestSwarm:
    """Batched swarms; torch is part of the test environment."""

    def test_finds_the_minimum_of_a_bowl_and_repeats_itself(self) -> None:
        pytest.importorskip("torch")
        target = np.array([0.3, -0.6])

        def cost(x):  # type: ignore[no-untyped-def]
            return ((x - x.new_tensor(target)) ** 2).sum(dim=1)

        config = SwarmConfig(particles=20, epochs=120, seed=3)
        first = minimise(cost, -np.ones(2), np.ones(2), config)
        np.testing.assert_allclose(first.position, target, atol=1e-4)
        assert np.all(np.diff(first.history) <= 0.0)
        second = minimise(cost, -np.ones(2), np.ones(2), config)
        np.testing.assert_array_equal(first.position, second.position)

    def test_stays_in_the_box_and_shuns_what_is_not_finite(self) -> None:
        torch = pytest.importorskip("torch")

        def cost(x):  # type: ignore[no-untyped-def]
            assert bool((x >= 0).all())
            assert bool((x <= 1).all())
            return torch.where(x[:, 0] > 0.5, x[:, 0], torch.full_like(x[:, 0], float("nan")))

        found = minimise(cost, np.zeros(1), np.ones(1), SwarmConfig(particles=20, epochs=60))
        assert found.position[0] == pytest.approx(0.5, abs=0.01)

        def downhill(x):  # type: ignore[no-untyped-def]
            assert bool((x >= 0).all())
            return x.sum(dim=1)

        assert minimise(downhill, np.zeros(3), np.ones(3), SwarmConfig(particles=20, epochs=60)).cost == 0.0

    def test_bouc_wen_by_swarm_reaches_the_better_route(self) -> None:
        pytest.importorskip("torch")
        u = chapter_input(0.02, 250)
        y = TABLE_2_1.simulate(u, 0.02) + np.random.default_rng(6).normal(0.0, 0.05, 250)
        found, report = swarm_bouc_wen(u, y, 0.02, SwarmConfig(particles=30, epochs=400))
        assert report.rmse_um < 0.1
        assert found.d_um_per_V == pytest.approx(TABLE_2_1.d_um_per_V, rel=0.05)

    def test_mpi_by_swarm_is_no_better_than_the_convex_route(self) -> None:
        pytest.importorskip("torch")
        u = chapter_input(0.02, 500)
        y = TABLE_2_1.simulate(u, 0.02)
        _, swarm = swarm_mpi(u, y, 0.02, SwarmConfig(particles=40, epochs=400))
        _, convex = identify_mpi(u, y, 0.02)
        assert 0.95 * convex.rmse_um < swarm.rmse_um < 2.0 * convex.rmse_um

    def test_missing_torch_is_said_clearly(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "torch", None)
        with pytest.raises(ModuleNotFoundError, match="torch"):
            minimise(lambda x: x, np.zeros(1), np.ones(1), SwarmConfig())


# --- Bounded least squares from normal equations: what scipy finds from the rows, and the conditions for a minimum.


@settings(max_examples=60, deadline=None)
@given(p=st.integers(1, 24), seed=st.integers(0, 2**32 - 1), spread=st.floats(0.0, 2.0))
def test_is_what_scipy_finds_from_the_rows(p: int, seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((3 * p + 2, p)) * 10.0 ** rng.uniform(-spread, spread, p)
    target = rows @ (rng.standard_normal(p) / np.abs(rows).max(axis=0)) + 0.1 * rng.standard_normal(rows.shape[0])
    lower = np.where(rng.uniform(size=p) < 0.2, -np.inf, rng.uniform(-0.1, 0.1, p))
    got = bounded_minimum(rows.T @ rows, rows.T @ target, lower)
    expected = bounded_least_squares(rows, target, lower)
    size = np.linalg.norm(rows, axis=0)
    np.testing.assert_allclose(got * size, expected * size, rtol=1e-6, atol=1e-7)
    # At the bound the error must grow inwards, elsewhere it must be flat (Karush, Kuhn and Tucker).
    slope = rows.T @ (rows @ got - target) / size
    assert (got >= lower - 1e-12).all()
    assert (slope > -1e-7).all()
    assert (np.abs(slope[got > lower + 1e-9]) < 1e-7).all()


@pytest.mark.parametrize("bad", [np.array([[1.0, 1.0], [1.0, 1.0 - 1e-6]]), np.full((2, 2), np.nan)])
def test_a_matrix_without_a_minimum_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(RuntimeError, match="positive definite"):
        bounded_minimum(bad, np.ones(2), np.full(2, -np.inf))
    if np.isnan(bad).any():
        with pytest.raises(RuntimeError, match="positive definite"):
            bounded_minimum(bad, np.ones(2), np.zeros(2))
