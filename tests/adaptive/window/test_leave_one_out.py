"""What all others foretell for each sample of a window, against fits without it."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive import lssvm
from adaptive.window import arrays as ws
from adaptive.window.arrays import Status
from adaptive.window.config import Form, WindowConfig
from adaptive.window.window import Window
from tests.adaptive.window.windows import (
    CAPACITY,
    GAMMA,
    STEPS,
    WIDTHS,
    assert_exact,
    empty,
    filled,
    forms,
    sample,
)


@forms
def test_leave_one_out_is_what_it_says_for_every_sample(form: Form) -> None:
    """Against a fit without the sample, for all of them, at every step of a window at work."""
    window, rng = filled(form, CAPACITY - 3), np.random.default_rng(11)
    steps = ["replace", "replace", "append", "reweight", "append", "replace", "reweight"]
    for name in [*steps, *["replace"] * (CAPACITY + 2)]:
        STEPS[name](window, rng)
        X, y, w, n = window.X, window.y, window.weights, len(window)
        found = window.leave_one_out()
        for i in range(n):
            rest = np.arange(n) != i
            without = lssvm.fit(X[rest], y[rest], WIDTHS, GAMMA, w[rest]).model
            assert found[i] == pytest.approx(y[i] - without.predict(X[i : i + 1])[0], rel=1e-7, abs=1e-9), (name, i)


@forms
def test_leave_one_out_of_samples_that_determine_a_coefficient_alone_is_no_number(form: Form) -> None:
    window = empty(form)
    assert window.append(np.zeros(3), 2.0) is Status.ACCEPTED
    assert np.isnan(window.leave_one_out()).all()


def test_the_diagonal_is_carried_along_while_it_is_asked_for() -> None:
    """A step with it costs O(N²) and no factor's whole inverse: the elements are those of the step before, moved."""
    window, rng = filled("cholesky"), np.random.default_rng(12)
    A = window.arrays
    assert A.C[ws.CARRIED] == 0
    window.leave_one_out()
    assert A.C[ws.CARRIED] == CAPACITY
    # An element that is off stays off but for its own turn, which comes within a round: nothing is made anew at a call.
    A.V[ws.DIAGONAL, 3] *= 1.5
    A.C[ws.CURSOR] = 4
    window.replace(0, *sample(rng))
    exact = np.diag(np.linalg.inv(A.R))
    window.leave_one_out()
    off = np.abs(A.V[ws.DIAGONAL] / exact - 1.0) > 1e-9
    np.testing.assert_array_equal(np.flatnonzero(off), [3])
    for _ in range(CAPACITY):
        window.replace(0, *sample(rng))
    np.testing.assert_allclose(A.V[ws.DIAGONAL], np.diag(np.linalg.inv(A.R)), rtol=1e-9)
    assert A.C[ws.CARRIED] == 0
    window.replace(5, *sample(rng))
    assert_exact(window)


def test_the_carried_diagonal_does_not_drift_at_cond_1e8() -> None:
    rng, n = np.random.default_rng(1), 60
    X = rng.random((4000, 3))
    y = np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(4000)
    window = Window.from_samples(WindowConfig(n, (1.5,) * 3, 2e6, form="cholesky"), X[:n], y[:n])
    for k in range(n, 4000):
        assert window.replace(int(rng.integers(n)), X[k], y[k]) is Status.ACCEPTED
        if k % 20 == 0:
            window.leave_one_out()
    assert window.arrays.C[ws.CARRIED] > 0
    expected = lssvm.fit(window.X, window.y, 1.5, 2e6).leave_one_out()
    assert np.linalg.norm(window.leave_one_out() - expected) < 1e-7 * np.linalg.norm(expected)
