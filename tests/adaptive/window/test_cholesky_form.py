"""The factor of the Cholesky form: scipy's for the same rows, and the same to the last bit after a refused step."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import cho_factor

from dehyst.adaptive import lssvm
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import KEPT_STEPS, Status
from dehyst.adaptive.window.window import Window, WindowConfig
from tests.adaptive.window.windows import CAPACITY, STEPS, filled, sample


def factor(window: Window) -> FloatArray:
    """(n, n) L."""
    upper = np.zeros((window.config.capacity, window.config.capacity))
    ws.write_upper(window.arrays, upper)
    return upper[: len(window), : len(window)].T


def assert_factor_is_scipys(window: Window, tolerance: float = 1e-11) -> None:
    """L, and T = L^-1 [1 y], of the same rows in the same order."""
    A, n = window.arrays, len(window)
    order = A.order[:n]
    assert sorted(order) == list(range(n))
    direct = np.tril(cho_factor(A.R[np.ix_(order, order)], lower=True)[0])
    np.testing.assert_allclose(factor(window), direct, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(direct @ A.S[:n], np.ones(n), rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(direct @ A.V[ws.SY, :n], window.y[order], rtol=0.0, atol=tolerance)


def same(a: Window, b: Window) -> bool:
    """Factor, T, alpha and order to the last bit."""
    pairs = [(w.arrays, len(w)) for w in (a, b)]
    of = [
        [factor(w), A.S[:n], A.V[ws.SY, :n], A.V[ws.ALPHA, :n], A.order[:n]]
        for w, (A, n) in zip((a, b), pairs, strict=True)
    ]
    return all(np.array_equal(x, y) for x, y in zip(*of, strict=True))


@pytest.mark.parametrize("n", range(1, CAPACITY + 1))
def test_the_factor_is_scipys_whatever_position_leaves(n: int) -> None:
    """Columns go by four: every remainder, before and behind the position."""
    rng = np.random.default_rng(n)
    for position in range(n):
        window = filled("cholesky", n, seed=position)
        slot = int(window.arrays.order[position])
        assert window.replace(slot, *sample(rng)) is Status.ACCEPTED
        assert window.arrays.order[n - 1] == slot
        assert_factor_is_scipys(window)


def test_the_factor_is_scipys_after_any_steps() -> None:
    window, rng = filled("cholesky", 9), np.random.default_rng(1)
    for _ in range(300):
        name = str(rng.choice(["replace", "replace", "replace", "append"]))
        if name != "append" or rng.random() < 0.2:
            STEPS[name](window, rng)
            assert_factor_is_scipys(window)
    assert window.full


def test_a_hundred_thousand_replacements_do_not_drift() -> None:
    rng, n = np.random.default_rng(2), 14
    X = rng.random((100_000, 3))
    near = np.flatnonzero(rng.random(len(X)) < 0.2)[1:]
    X[near] = X[near - 1] + 1e-7 * rng.standard_normal((near.size, 3))
    y = np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(len(X))
    window = Window.from_samples(WindowConfig(n, (1.0,) * 3, 1e6, form="cholesky"), X[:n], y[:n])
    slots = rng.integers(0, n, len(X)).tolist()
    for k in range(n, len(X)):
        assert window.replace(slots[k], X[k], float(y[k])) is Status.ACCEPTED
        if k % 10_000 == 0:
            direct = lssvm.fit(window.X, window.y, 1.0, 1e6).model.alpha
            assert np.linalg.norm(window.alpha - direct) < 1e-9 * np.linalg.norm(direct)
            assert_factor_is_scipys(window, 1e-9)
    assert window.counters()["refinements"] == 0


@pytest.mark.parametrize("since", [*range(4), KEPT_STEPS - 1, KEPT_STEPS, KEPT_STEPS + 1, 2 * KEPT_STEPS + 3])
def test_a_replacement_is_taken_back_to_the_last_bit_whenever_the_factor_was_copied(since: int) -> None:
    rng, window = np.random.default_rng(since), filled("cholesky", CAPACITY - 1)
    for _ in range(since):
        assert STEPS["replace"](window, rng) is Status.ACCEPTED
    assert window.arrays.C[ws.LOGGED] == (0 if since == 0 else (since - 1) % KEPT_STEPS + 1)
    before = window.copy()
    for slot in (3, 0, CAPACITY - 2):
        assert window.replace(slot, *sample(rng)) is Status.ACCEPTED
        assert not same(window, before)
        steps.take_back(window.arrays)
        assert same(window, before)
    # Both go on alike, though one of them has no copy of its factor.
    for _ in range(KEPT_STEPS + 2):
        slot, point = int(rng.integers(len(window))), sample(rng)
        assert window.replace(slot, *point) is before.replace(slot, *point) is Status.ACCEPTED
    assert window.append(*(point := sample(rng))) is before.append(*point) is Status.ACCEPTED
    steps.take_back(window.arrays)
    assert window.append(*point) is Status.ACCEPTED
    assert same(window, before)


def test_a_stream_with_refused_steps_is_as_one_without_them() -> None:
    """At some steps the window takes all its samples for copies of the new one, which leaves no variance to it."""
    rng, window = np.random.default_rng(5), filled("cholesky")
    A, twin, refused = window.arrays, window.copy(), 0
    for _ in range(400):
        (x, y), slot = sample(rng), int(rng.integers(CAPACITY))
        if rng.random() < 0.2:
            scaled = A.scaled.copy()
            A.scaled[...] = (x * A.inverse_widths)[:, None]
            assert window.replace(slot, x, y) is Status.ILL_CONDITIONED
            A.scaled[...] = scaled
            refused += 1
        else:
            assert window.replace(slot, x, y) is twin.replace(slot, x, y) is Status.ACCEPTED
        assert same(window, twin)
    assert window.counters()["ill_conditioned"] == refused > 50
    assert_factor_is_scipys(window)


def test_singular_samples_are_refused_or_solved() -> None:
    """Copies of samples at the largest precision there is: rounding leaves nothing of the variance of some of them."""
    rng, n = np.random.default_rng(5), 200
    window = Window(WindowConfig(n, (1.5,) * 3, 0.999 * ws.MOST_PRECISION, form="cholesky"))
    for _ in range(1500):
        x = window.X[int(rng.integers(len(window)))] if len(window) and rng.random() < 0.5 else rng.random(3)
        y, slot, before = float(np.sin(x[0])), int(rng.integers(n)), factor(window)
        status = window.replace(slot, x, y) if window.full else window.append(x, y)
        assert status in (Status.ACCEPTED, Status.ILL_CONDITIONED)
        if status is Status.ILL_CONDITIONED:
            np.testing.assert_array_equal(factor(window), before)
        assert np.all(np.isfinite(window.alpha))
    A, order = window.arrays, window.arrays.order
    np.testing.assert_allclose(factor(window) @ factor(window).T, A.R[np.ix_(order, order)], rtol=0.0, atol=1e-12)
