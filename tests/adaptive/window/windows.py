"""Windows of a few samples, every step that one can take, and the direct solver beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from adaptive import lssvm
from adaptive.window.arrays import Status
from adaptive.window.config import Backend, Form, WindowConfig
from adaptive.window.window import Window

KINDS: list[tuple[Form, Backend]] = [("inverse", "compiled"), ("cholesky", "compiled"), ("inverse", "plain")]
LINEAR: list[tuple[int, ...]] = [(), (1,), (0, 2)]
kinds = pytest.mark.parametrize(("form", "backend"), KINDS)
GAMMA, WIDTHS, CAPACITY = 200.0, (0.6, 0.9, 1.5), 17


def empty(
    form: Form = "inverse", backend: Backend = "compiled", linear: tuple[int, ...] = (), n: int = CAPACITY
) -> Window:
    return Window(WindowConfig(n, WIDTHS, GAMMA, linear, form, backend))


def sample(rng: np.random.Generator) -> tuple[np.ndarray, float, float]:
    x = rng.random(3)
    return x, float(np.sin(4 * x[0]) + x[1] * x[2] + 0.02 * rng.standard_normal()), float(rng.random() + 0.3)


def filled(form: Form, backend: Backend, linear: tuple[int, ...] = (), n: int = CAPACITY, seed: int = 0) -> Window:
    window, rng = empty(form, backend, linear), np.random.default_rng(seed)
    for _ in range(n):
        assert window.append(*sample(rng)) is Status.ACCEPTED
    return window


def assert_exact(window: Window, tolerance: float = 1e-8) -> None:
    """Solution, variance, leave-one-out and residuals are those of the direct solver on the same samples."""
    fit = lssvm.fit(window.X, window.y, WIDTHS, GAMMA, window.weights, window.config.linear)
    size = np.max(np.abs(fit.model.alpha))
    np.testing.assert_allclose(window.alpha, fit.model.alpha, atol=tolerance * size)
    np.testing.assert_allclose(window.beta, fit.model.beta, atol=tolerance * 10)
    points = np.random.default_rng(99).random((3, 3)) * 1.3
    for x, mean, variance, noisy in zip(
        points, fit.model.predict(points), fit.variance(points), fit.variance(points, include_noise=True), strict=True
    ):
        assert window.predict(x) == pytest.approx(mean, abs=tolerance * 10)
        got = window.predict_with_variance(x)
        assert got[0] == pytest.approx(mean, abs=tolerance * 10)
        assert got[1] == pytest.approx(variance, rel=1e-5, abs=1e-9)
        assert window.predict_with_variance(x, include_noise=True)[1] == pytest.approx(noisy, rel=1e-5, abs=1e-9)
    np.testing.assert_allclose(window.leave_one_out(), fit.leave_one_out(), rtol=1e-5, atol=tolerance * 10)
    assert window.worst_residual() < tolerance
    assert window.scale == pytest.approx(fit.model.scale, rel=1e-6)


Step = Callable[[Window, np.random.Generator], Status]
STEPS: dict[str, Step] = {
    "append": lambda w, r: w.append(*sample(r)),
    "replace": lambda w, r: w.replace(int(r.integers(len(w))), *sample(r)),
    "remove": lambda w, r: w.remove(int(r.integers(len(w)))),
    "reweight": lambda w, r: w.reweight(int(r.integers(len(w))), float(r.random() * 3 + 0.1)),
    "rescale": lambda w, r: w.rescale_targets(float(r.random() * 0.2 - 0.1), float(r.random() - 0.5)),
    "shift": lambda w, r: w.shift_targets(r.standard_normal(len(w)) * 0.1),
    "undo": lambda w, r: w.undo(),
}
