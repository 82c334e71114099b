"""Bounded least squares from normal equations: what scipy finds from the rows, and the conditions for a minimum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines.bounded_least_squares import bounded_least_squares, bounded_minimum


@settings(max_examples=150, deadline=None)
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


def test_all_free_is_ordinary_least_squares_and_all_bound_stays_there() -> None:
    rng = np.random.default_rng(1)
    rows, target = rng.standard_normal((20, 4)), rng.standard_normal(20)
    normal, right = rows.T @ rows, rows.T @ target
    free = bounded_minimum(normal, right, np.full(4, -np.inf))
    assert free == pytest.approx(np.linalg.lstsq(rows, target, rcond=None)[0])
    assert np.array_equal(bounded_minimum(normal, right, np.full(4, 10.0)), np.full(4, 10.0))


@pytest.mark.parametrize("bad", [np.array([[1.0, 1.0], [1.0, 1.0 - 1e-6]]), np.full((2, 2), np.nan)])
def test_a_matrix_without_a_minimum_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(RuntimeError, match="positive definite"):
        bounded_minimum(bad, np.ones(2), np.full(2, -np.inf))
    if np.isnan(bad).any():
        with pytest.raises(RuntimeError, match="positive definite"):
            bounded_minimum(bad, np.ones(2), np.zeros(2))
