"""A worn-out window is healed beside its work, at the same sample whatever the thread does."""

from __future__ import annotations

import copy
import pickle
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from adaptive import lapack, lssvm
from adaptive.errors import InputError, NumericsError
from adaptive.inverse_model import LssvmInverse
from adaptive.online import gates as admission
from adaptive.online.kernel_window import ResidualWindow
from adaptive.types import FloatArray
from adaptive.window import healing as window_refresh
from adaptive.window.arrays import CHOLESKY_FORM
from adaptive.window.config import Form, SolverConfig, WindowConfig
from adaptive.window.healing import STEPS, Refresh
from adaptive.window.window import Window

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
    expected = lssvm.fit(w.X, w.y, np.array(w.config.widths), w.config.gamma, w.weights).model.alpha
    return float(np.max(np.abs(w.alpha - expected)) / np.max(np.abs(expected)))


@pytest.mark.parametrize("form", FORMS)
def test_a_refusal_is_healed_after_so_many_steps(model: LssvmInverse, form: Form) -> None:
    window = worn_out(model, form)
    served = window.mean(np.ones(model.widths.size))
    assert go_on(window, 0, 1) == [admission.NUMERICS]
    assert window._healing.open
    # The same solution is served meanwhile, and nothing is factored in line.
    assert window.mean(np.ones(model.widths.size)) == served
    go_on(window, 1, STEPS)
    assert window._healing.open
    assert go_on(window, STEPS, STEPS + 60) == [admission.LEARNT] * 60
    assert not window._healing.open
    assert window.counters()["refreshes"] == 1
    assert error(window) < 1e-9


def slow(refresh: Refresh) -> None:
    time.sleep(0.1)
    FACTOR(refresh)


FACTOR: Callable[[Refresh], None] = Refresh.factor


@pytest.mark.parametrize("form", ["auto", "cholesky"])
@pytest.mark.parametrize("at", [1, 5, STEPS - 1])
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
    restored.restore(state)
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
    factor = lapack.cholesky_lower

    def held(matrix: FloatArray, count: int | None = None) -> None:
        inside.set()
        assert go.wait(20.0)
        factor(matrix, count)

    fresh = ResidualWindow(CAPACITY, model, "fifo")
    for x, y in zip(*samples(CAPACITY, model.widths.size, 1), strict=True):
        fresh.learn(x, float(y))
    monkeypatch.setattr(lapack, "cholesky_lower", held)
    fresh._healing.begin()
    assert inside.wait(20.0)
    assert go_on(fresh, 0, STEPS - 1) == [admission.LEARNT] * (STEPS - 1)
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
    go_on(window, 0, STEPS + 1)
    assert not window._healing.open
    assert window.counters()["refreshes"] == 1
    assert go_on(window, STEPS + 1, 100) == [admission.LEARNT] * (99 - STEPS)
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
    refresh = window_refresh.begin(window, CHOLESKY_FORM)
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
    again.restore(made.state_dict())
    for held in (window, made, again):
        assert (held._window.config.form, held._window.config.accuracy) == (form, 1e-7)
        assert held._window.form == ("inverse" if form == "auto" else form)
    assert window.learn(np.full(model.widths.size, 9.0), 0.1) == admission.LEARNT


def test_a_solver_that_does_not_exist_is_refused() -> None:
    for change, field in (
        ({"form": "lu"}, "form"),
        ({"accuracy": 0.0}, "accuracy"),
    ):
        with pytest.raises(InputError, match=field):
            SolverConfig(**change)  # type: ignore[arg-type]
