"""Refreshing beside the work: what was learnt meanwhile is there after the swap."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from adaptive import lssvm
from adaptive.errors import NumericsError
from adaptive.window import healing as window_refresh
from adaptive.window.arrays import CHOLESKY_FORM, FORM, TOLERANCE, Status
from adaptive.window.config import Form, WindowConfig
from adaptive.window.window import Window

N, D = 30, 2
FORMS: list[Form] = ["inverse", "cholesky"]


def point(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    x = rng.random(D)
    return x, float(np.sin(5 * x[0]) + x[1])


def made(form: Form, n: int = N) -> tuple[Window, np.random.Generator]:
    rng, window = np.random.default_rng(0), Window(WindowConfig(N, (0.5, 0.5), 500.0, form))
    for _ in range(n):
        window.append(*point(rng))
    return window, rng


def error(window: Window) -> float:
    expected = lssvm.fit(window.X, window.y, 0.5, 500.0, window.weights).model.alpha
    return float(np.max(np.abs(window.alpha - expected)) / np.max(np.abs(expected)))


@pytest.mark.parametrize("form", FORMS)
def test_catches_up_with_everything_that_came_meanwhile(form: Form) -> None:
    window, rng = made(form, N - 2)
    refresh = window_refresh.begin(window)
    for slot in (3, 3, 17, 0):
        window.replace(slot, *point(rng))
    window.append(*point(rng))
    window.reweight(5, 0.2)
    worker = threading.Thread(target=refresh.factor)
    worker.start()
    worker.join()
    assert set(refresh.changed_slots()) == {0, 3, 5, 17}
    X, y, steps = window.X, window.y, window.counters()["steps"]
    assert refresh.finish() is True
    np.testing.assert_array_equal(window.X, X)
    np.testing.assert_array_equal(window.y, y)
    assert window.counters()["steps"] == steps
    assert window.counters()["refreshes"] == 1
    assert error(window) < 1e-9
    window.replace(1, *point(rng))
    assert error(window) < 1e-8


def test_heals_a_damaged_inverse() -> None:
    window, rng = made("inverse")
    lower = np.tril_indices(N)
    window.arrays.P[lower] *= 1 + 1e-5 * rng.standard_normal(lower[0].size)
    refresh = window_refresh.begin(window)
    window.arrays.F[TOLERANCE] = np.inf  # no refinement, so that the damage shows
    assert window.replace(2, *point(rng)) is Status.ACCEPTED
    assert error(window) > 1e-6
    refresh.factor()
    assert refresh.finish()
    assert error(window) < 1e-9


def test_a_badly_damaged_inverse_refuses_steps_and_keeps_the_solution() -> None:
    window, rng = made("inverse")
    before = window.alpha
    lower = np.tril_indices(N)
    window.arrays.P[lower] *= 1 + 1e-2 * rng.standard_normal(lower[0].size)
    assert window.replace(2, *point(rng)) is Status.ILL_CONDITIONED
    assert window.counters()["ill_conditioned"] == 1
    np.testing.assert_array_equal(window.alpha, before)
    window.rebuild()
    assert window.replace(2, *point(rng)) is Status.ACCEPTED
    assert error(window) < 1e-9


def test_not_swapped_when_it_would_not_fit() -> None:
    window, _ = made("inverse")
    unfinished = window_refresh.begin(window)
    assert unfinished.finish() is False
    refresh = window_refresh.begin(window)
    refresh.factor()
    window.arrays.C[FORM] = CHOLESKY_FORM
    window.rebuild()
    assert refresh.finish() is False
    assert error(window) < 1e-9


def test_an_empty_window_has_nothing_to_refresh() -> None:
    with pytest.raises(NumericsError, match="empty"):
        window_refresh.begin(Window(WindowConfig(3, (1.0,), 10.0)))


def test_an_inverse_form_pushed_past_its_condition_refuses_instead_of_blowing_up() -> None:
    """Forced onto cond 1e9 the recursion has an unstable error: it must stop before the numbers leave the finite."""
    rng = np.random.default_rng(3)
    config = WindowConfig(80, (1.0, 1.0, 1.0), 1e8, form="inverse")
    window = Window(config)
    X, y = rng.random((1500, 3)), rng.random(1500)
    refused, healed = 0, 0
    for k in range(y.size):
        slot = int(rng.integers(80))
        status = window.append(X[k], y[k]) if not window.full else window.replace(slot, X[k], y[k])
        if status is Status.ILL_CONDITIONED:
            refused += 1
            healed += window.heal()
        assert np.all(np.isfinite(window.alpha))
    assert refused > 0
    assert healed > 0
    assert window.counters()["ill_conditioned"] == refused
    assert window.counters()["refreshes"] == healed


def test_healing_changes_to_the_form_that_serves() -> None:
    rng = np.random.default_rng(3)
    window = Window(WindowConfig(80, (1.0, 1.0, 1.0), 3e6))
    assert window.heal() is False  # nothing to factor
    for _ in range(3000):
        x, y = rng.random(3), float(rng.random())
        slot = int(rng.integers(80))
        if (window.replace(slot, x, y) if window.full else window.append(x, y)) is Status.ILL_CONDITIONED:
            assert window.heal()
        if window.form == "cholesky":
            break
    assert window.form == "cholesky"
    refused = window.counters()["ill_conditioned"]
    for _ in range(300):
        assert window.replace(int(rng.integers(80)), rng.random(3), float(rng.random())) is Status.ACCEPTED
    assert window.counters()["ill_conditioned"] == refused
