"""Windows of a few samples, the steps that they can take, and the direct solver beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dehyst.adaptive import lssvm
from dehyst.adaptive.window.arrays import BETA, Status
from dehyst.adaptive.window.window import Form, Window, WindowConfig

FORMS: list[Form] = ["inverse", "cholesky"]
forms = pytest.mark.parametrize("form", FORMS)
GAMMA, WIDTHS, CAPACITY = 200.0, (0.6, 0.9, 1.5), 17


def empty(form: Form = "inverse", n: int = CAPACITY) -> Window:
    return Window(WindowConfig(n, WIDTHS, GAMMA, form))


def sample(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    x = rng.random(3)
    return x, float(np.sin(4 * x[0]) + x[1] * x[2] + 0.02 * rng.standard_normal())


def filled(form: Form, n: int = CAPACITY, seed: int = 0) -> Window:
    window, rng = empty(form), np.random.default_rng(seed)
    for _ in range(n):
        assert window.append(*sample(rng)) is Status.ACCEPTED
    return window


def residuals(window: Window) -> np.ndarray:
    """(n,) y_i - b - R_i alpha of all rows, in target units."""
    A, n = window.arrays, len(window)
    return np.asarray(window.y - A.F[BETA] - A.R[:n, :n] @ window.alpha)


def assert_exact(window: Window, tolerance: float = 1e-8) -> None:
    """Solution, leave-one-out and residuals are those of the direct solver on the same samples."""
    fit = lssvm.fit(window.X, window.y, WIDTHS, GAMMA)
    size = np.max(np.abs(fit.model.alpha))
    np.testing.assert_allclose(window.alpha, fit.model.alpha, atol=tolerance * size)
    assert window.bias == pytest.approx(fit.model.bias, abs=tolerance * 10)
    points = np.random.default_rng(99).random((3, 3)) * 1.3
    for x, mean in zip(points, fit.model.predict(points), strict=True):
        assert window.predict(x) == pytest.approx(mean, abs=tolerance * 10)
    np.testing.assert_allclose(window.leave_one_out(), fit.leave_one_out(), rtol=1e-5, atol=tolerance * 10)
    assert np.max(np.abs(residuals(window))) < tolerance
    assert window.scale == pytest.approx(fit.model.scale, rel=1e-6)


Step = Callable[[Window, np.random.Generator], Status]
STEPS: dict[str, Step] = {
    "append": lambda w, r: w.append(*sample(r)),
    "replace": lambda w, r: w.replace(int(r.integers(len(w))), *sample(r)),
}
