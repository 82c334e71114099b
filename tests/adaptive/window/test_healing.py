"""Healing: a new factorisation in the background, and the refresh of a damaged one."""

from __future__ import annotations

import copy
import pickle
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from dehyst.adaptive import lssvm
from dehyst.adaptive.errors import NumericsError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates as admission
from dehyst.adaptive.online.kernel_window import ResidualWindow
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window.arrays import CHOLESKY_FORM, FORM, TOLERANCE, Status
from dehyst.adaptive.window.window import (
    HEALING_STEPS,
    Form,
    Refresh,
    SolverConfig,
    Window,
    WindowConfig,
    begin_refresh,
)

# --- A worn-out window is healed beside its work, at the same sample whatever the thread does.

CAPACITY = 40
FORMS: list[Form] = ["auto", "inverse", "cholesky"]


def samples(count: int, d: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    X = 8.0 * rng.random((count, d))
    return X, np.sin(X[:, 0]) + X[:, 1] + 0.01 * rng.standard_normal(count)


def worn_out(model: LssvmInverse, form: Form = "auto") -> ResidualWindow:
    """A full window whose factorisation has gone wrong, and whose solution is good still."""
    window = ResidualWindow(CAPACITY, model, "fifo", SolverConfig(form))
    for x, y in zip(*samples(CAPACITY, model.widths.size, 1), strict=True):
        assert window.learn(x, float(y)) == admission.LEARNT
    A = window._window.arrays
    damage = 1e-2 * np.random.default_rng(4).standard_normal(A.P.shape)
    # A factor that is somewhat off is one that refinement makes up for.
    A.P[...] *= 3.0 if form == "cholesky" else 1.0 + damage
    return window


def go_on(window: ResidualWindow, first: int, last: int) -> list[str]:
    X, y = samples(400, len(window.hyper.widths), 2)
    return [window.learn(X[k], float(y[k])) for k in range(first, last)]


def error(window: ResidualWindow) -> float:
    w = window._window
    expected = lssvm.fit(w.X, w.y, np.array(w.config.widths), w.config.gamma).model.alpha
    return float(np.max(np.abs(w.alpha - expected)) / np.max(np.abs(expected)))


@pytest.mark.parametrize("form", FORMS)
def test_a_refusal_is_healed_after_so_many_steps(model: LssvmInverse, form: Form) -> None:
    window = worn_out(model, form)
    served = window.mean(np.ones(model.widths.size))
    assert go_on(window, 0, 1) == [admission.NUMERICS]
    assert window._healing.open
    # The same solution is served meanwhile, and nothing is factored in line.
    assert window.mean(np.ones(model.widths.size)) == served
    go_on(window, 1, HEALING_STEPS)
    assert window._healing.open
    assert go_on(window, HEALING_STEPS, HEALING_STEPS + 60) == [admission.LEARNT] * 60
    assert not window._healing.open
    assert window.counters()["refreshes"] == 1
    assert error(window) < 1e-9


def slow(refresh: Refresh) -> None:
    time.sleep(0.1)
    FACTOR(refresh)


FACTOR: Callable[[Refresh], None] = Refresh.factor


@pytest.mark.parametrize("form", ["auto", "cholesky"])
@pytest.mark.parametrize("at", [1, 5, HEALING_STEPS - 1])
def test_what_comes_of_it_is_the_same_to_the_last_bit(
    model: LssvmInverse, form: Form, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However slow the thread; through a state file, a deep copy and a pickle taken while it is open."""
    one = worn_out(model, form)
    go_on(one, 0, 120)
    expected = {name: np.asarray(value) for name, value in one.state_dict().items()}
    monkeypatch.setattr(Refresh, "factor", slow)
    other = worn_out(model, form)
    go_on(other, 0, at)
    assert other._healing.open
    restored = ResidualWindow(CAPACITY, model, "fifo", SolverConfig(form))
    state = other.state_dict()
    restored.take(restored.read(state))
    restored._share.record[...] = other._share.record  # the numbers are its owner's
    assert restored._healing.open
    twins = [other, restored, copy.deepcopy(other), pickle.loads(pickle.dumps(other))]
    for window in twins:
        go_on(window, at, 120)
        found = window.state_dict()
        assert found.keys() == expected.keys()
        for name in expected:
            np.testing.assert_array_equal(np.asarray(found[name]), expected[name], err_msg=name)
    # A state says of an open healing all that it needs, in arrays and numbers.
    assert all(isinstance(value, np.ndarray | int | float) for value in state.values())


def test_samples_are_learnt_while_the_factor_is_being_made(
    model: LssvmInverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Inside of the factorisation itself, in its thread, the window goes on taking steps and answering."""
    inside, go = threading.Event(), threading.Event()
    factor = lssvm.cholesky_lower

    def held(matrix: FloatArray, count: int | None = None) -> None:
        inside.set()
        assert go.wait(20.0)
        factor(matrix, count)

    fresh = ResidualWindow(CAPACITY, model, "fifo")
    for x, y in zip(*samples(CAPACITY, model.widths.size, 1), strict=True):
        fresh.learn(x, float(y))
    monkeypatch.setattr(lssvm, "cholesky_lower", held)
    fresh._healing.begin()
    assert inside.wait(20.0)
    assert go_on(fresh, 0, HEALING_STEPS - 1) == [admission.LEARNT] * (HEALING_STEPS - 1)
    fresh.mean(np.ones(model.widths.size))
    refresh = fresh._healing._refresh
    assert refresh is not None
    assert not refresh.factored
    before = fresh._window.X, fresh._window.y
    go.set()
    fresh._healing.step()
    for got, kept in zip((fresh._window.X, fresh._window.y), before, strict=True):
        np.testing.assert_array_equal(got, kept)
    assert fresh.counters()["refreshes"] == 1
    assert error(fresh) < 1e-9


def test_one_that_can_not_be_swapped_in_is_made_in_line(model: LssvmInverse, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(refresh: Refresh) -> None:
        raise NumericsError("not positive definite")

    monkeypatch.setattr(Refresh, "factor", fails)
    window = worn_out(model)
    go_on(window, 0, HEALING_STEPS + 1)
    assert not window._healing.open
    assert window.counters()["refreshes"] == 1
    assert go_on(window, HEALING_STEPS + 1, 100) == [admission.LEARNT] * (99 - HEALING_STEPS)
    assert error(window) < 1e-9


def test_other_hyper_parameters_are_a_new_factorisation(model: LssvmInverse) -> None:
    window = worn_out(model)
    go_on(window, 0, 3)
    made = window.with_hyperparameters(window.hyper)
    assert not made._healing.open
    assert go_on(made, 3, 60) == [admission.LEARNT] * 57


def test_a_refresh_goes_over_to_another_form() -> None:

    X, y = samples(50, 2)
    window = Window.from_samples(WindowConfig(40, (2.0, 2.0), 50.0), X[:40], y[:40])
    assert window.form == "inverse"
    refresh = begin_refresh(window, CHOLESKY_FORM)
    for k in range(40, 50):
        window.replace(k - 40, X[k], float(y[k]))
    refresh.factor()
    assert refresh.finish()
    assert window.form == "cholesky"
    expected = lssvm.fit(window.X, window.y, 2.0, 50.0).model.alpha
    np.testing.assert_allclose(window.alpha, expected, rtol=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_the_solver_is_the_users_choice(model: LssvmInverse, form: Form) -> None:
    """Through new hyper-parameters and a state file too."""
    solver = SolverConfig(form, accuracy=1e-7)
    window = ResidualWindow.from_model(model, 100, "nearest", solver)
    made = window.with_hyperparameters(window.hyper)
    again = ResidualWindow(100, model, "nearest", solver)
    again.take(again.read(made.state_dict()))
    for held in (window, made, again):
        assert (held._window.config.form, held._window.config.accuracy) == (form, 1e-7)
        assert held._window.form == ("inverse" if form == "auto" else form)
    assert window.learn(np.full(model.widths.size, 9.0), 0.1) == admission.LEARNT


# --- Refreshing beside the work: what was learnt meanwhile is there after the swap.

N, D = 30, 2
BOTH_FORMS: list[Form] = ["inverse", "cholesky"]


def point(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    x = rng.random(D)
    return x, float(np.sin(5 * x[0]) + x[1])


def made(form: Form, n: int = N) -> tuple[Window, np.random.Generator]:
    rng, window = np.random.default_rng(0), Window(WindowConfig(N, (0.5, 0.5), 500.0, form))
    for _ in range(n):
        window.append(*point(rng))
    return window, rng


def window_error(window: Window) -> float:
    expected = lssvm.fit(window.X, window.y, 0.5, 500.0).model.alpha
    return float(np.max(np.abs(window.alpha - expected)) / np.max(np.abs(expected)))


@pytest.mark.parametrize("form", BOTH_FORMS)
def test_catches_up_with_everything_that_came_meanwhile(form: Form) -> None:
    window, rng = made(form, N - 2)
    refresh = begin_refresh(window)
    for slot in (3, 3, 17, 0):
        window.replace(slot, *point(rng))
    window.append(*point(rng))
    worker = threading.Thread(target=refresh.factor)
    worker.start()
    worker.join()
    assert set(refresh.changed_slots()) == {0, 3, 17}
    X, y, steps = window.X, window.y, window.counters()["steps"]
    assert refresh.finish() is True
    np.testing.assert_array_equal(window.X, X)
    np.testing.assert_array_equal(window.y, y)
    assert window.counters()["steps"] == steps
    assert window.counters()["refreshes"] == 1
    assert window_error(window) < 1e-9
    window.replace(1, *point(rng))
    assert window_error(window) < 1e-8


def test_heals_a_damaged_inverse() -> None:
    window, rng = made("inverse")
    lower = np.tril_indices(N)
    window.arrays.P[lower] *= 1 + 1e-5 * rng.standard_normal(lower[0].size)
    refresh = begin_refresh(window)
    window.arrays.F[TOLERANCE] = np.inf  # no refinement, so that the damage shows
    assert window.replace(2, *point(rng)) is Status.ACCEPTED
    assert window_error(window) > 1e-6
    refresh.factor()
    assert refresh.finish()
    assert window_error(window) < 1e-9


def test_not_swapped_when_it_would_not_fit() -> None:
    window, _ = made("inverse")
    unfinished = begin_refresh(window)
    assert unfinished.finish() is False
    refresh = begin_refresh(window)
    refresh.factor()
    window.arrays.C[FORM] = CHOLESKY_FORM
    window.rebuild()
    assert refresh.finish() is False
    assert window_error(window) < 1e-9


def test_an_empty_window_has_nothing_to_refresh() -> None:
    with pytest.raises(NumericsError, match="empty"):
        begin_refresh(Window(WindowConfig(3, (1.0,), 10.0)))


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
