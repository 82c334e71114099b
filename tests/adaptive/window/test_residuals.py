"""What a window finds wrong with its own solution, row by row, and how it puts that right."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive.window import arrays as ws
from adaptive.window import steps
from adaptive.window.arrays import Status
from adaptive.window.config import Form
from tests.adaptive.window.windows import CAPACITY, assert_exact, filled, forms, sample


@forms
def test_residuals_rotate_and_refinement_heals(form: Form) -> None:
    window, rng = filled(form), np.random.default_rng(7)
    exact, A = window.alpha, window.arrays
    # Damage S and Sy as drift would: all rows but the one being replaced feel it.
    A.S[:] *= 1 + 1e-4 * rng.standard_normal(A.S.shape)
    A.V[ws.SY] *= 1 + 1e-4 * rng.standard_normal(CAPACITY)
    assert steps.resum(A)
    np.testing.assert_allclose(window.alpha, exact, rtol=1e-7)
    A.V[ws.SY] *= 1 + 1e-4 * rng.standard_normal(CAPACITY)
    before = window.counters()
    for _ in range(CAPACITY):
        assert window.replace(5, *sample(rng)) is Status.ACCEPTED
    after = window.counters()
    assert after["residuals_exceeded"] > before["residuals_exceeded"]
    assert after["refinements"] > before["refinements"]
    assert after["residual_rounds"] == before["residual_rounds"] + 1
    assert_exact(window)


@forms
def test_each_row_is_looked_at_once_a_round(form: Form) -> None:
    """Row after row, each with the residual that it has then; the round's worst is published at its end."""
    window, rng = filled(form), np.random.default_rng(7)
    A = window.arrays
    A.F[ws.TOLERANCE] = np.inf
    A.V[ws.SY] *= 1 + 1e-3 * rng.standard_normal(CAPACITY)
    while A.C[ws.CURSOR] != 0:
        window.replace(5, *sample(rng))
    worst = 0.0
    for row in range(CAPACITY):
        assert window.replace(int(rng.integers(CAPACITY)), *sample(rng)) is Status.ACCEPTED
        residual = abs(A.V[ws.Y, row] - A.R[row] @ A.V[ws.ALPHA] - A.F[ws.BETA])
        assert A.F[ws.RESIDUAL] == pytest.approx(residual, rel=1e-6, abs=1e-12)
        worst = max(worst, A.F[ws.RESIDUAL])
    assert window.round_residual == worst > 1e-9
    assert A.C[ws.CURSOR] == 0
