"""A window that is handed over by address is the window itself."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from adaptive.types import FloatArray
from adaptive.window import steps
from adaptive.window.arrays import handle_of
from adaptive.window.config import Form, WindowConfig
from adaptive.window.healing import begin
from adaptive.window.window import Window


def samples(count: int, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    X = rng.random((count, 3))
    return X, np.sin(3.0 * X[:, 0]) + X[:, 1] * X[:, 2]


def made(form: Form = "inverse") -> tuple[Window, FloatArray, FloatArray]:
    X, y = samples(80)
    return Window.from_samples(WindowConfig(60, (0.7, 0.8, 0.9), 50.0, form=form), X[:60], y[:60]), X, y


@pytest.mark.parametrize("form", ["inverse", "cholesky"])
def test_answers_are_those_of_the_arrays_to_the_last_bit(form: Form) -> None:
    window, X, y = made(form)
    for k in range(60, 80):
        window.replace(k % 60, X[k], float(y[k]))
        point = X[k] + 0.1
        assert window.predict(point) == steps.predict(window.arrays, point)


def test_a_handle_is_of_its_own_arrays_only() -> None:
    window, X, y = made()
    twins = [window.copy(), copy.deepcopy(window), pickle.loads(pickle.dumps(window))]
    before = window.predict(X[70])
    window.replace(5, X[70], float(y[70]) + 3.0)
    assert window.predict(X[70]) != before
    assert [twin.predict(X[70]) for twin in twins] == [before] * 3


def test_arrays_of_another_kind_are_refused() -> None:
    window, _, _ = made()
    with pytest.raises(TypeError, match="P: a C-ordered"):
        handle_of(window.arrays._replace(P=np.asfortranarray(window.arrays.P)))
    with pytest.raises(TypeError, match="F: a C-ordered"):
        handle_of(window.arrays._replace(F=window.arrays.F.astype(np.float32)))


def test_after_a_refresh_the_new_arrays_answer() -> None:
    window, X, y = made()
    refresh = begin(window)
    window.replace(7, X[71], float(y[71]))
    refresh.factor()
    assert refresh.finish()
    assert window.predict(X[72]) == steps.predict(window.arrays, X[72])
