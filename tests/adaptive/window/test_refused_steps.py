"""No step leaves a window non-finite: what is refused is counted and changes nothing, what is taken is exact."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive import lssvm
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import Status
from dehyst.adaptive.window.window import Form, Window, WindowConfig, begin_refresh
from tests.adaptive.window.windows import CAPACITY, GAMMA, WIDTHS, filled, forms, sample

HELD = 12
POINT = np.array([0.4, 0.3, 0.6])
#: Values that a broken sensor, a division or a wrong unit may bring.
EXTREMES = (np.inf, -np.inf, np.nan, 1e308, -1e308, 1e200, -1e200, 1e100, 1e10, 1e-320, -1e-320, 0.0, -1.0, -1e-300)

Step = Callable[[Window], Status | bool]


def at_work(form: Form, n: int = HELD) -> Window:
    """A window that has taken a replacement: in the inverse form a rank-2 term is pending."""
    window = filled(form, n, seed=3)
    assert window.replace(2, *sample(np.random.default_rng(4))) is Status.ACCEPTED
    return window


def held(window: Window) -> list[np.ndarray]:
    """What a window holds and answers."""
    answers = [window.predict(POINT), window.scale, window.bias, float(window.arrays.F[ws.GRAM])]
    return [window.X, window.y, window.alpha, np.array(answers)]


def assert_same(window: Window, before: list[np.ndarray]) -> None:
    """To the last bit."""
    for got, kept in zip(held(window), before, strict=True):
        np.testing.assert_array_equal(got, kept)


def assert_finite(window: Window) -> None:
    for values in held(window):
        assert np.all(np.isfinite(values))


def assert_exact(window: Window) -> None:
    """As the direct solver, in units of the samples at hand, which may be huge."""
    fit = lssvm.fit(window.X, window.y, WIDTHS, GAMMA)
    size = np.max(np.abs(fit.model.alpha))
    np.testing.assert_allclose(window.alpha, fit.model.alpha, rtol=1e-7, atol=1e-8 * size)
    mean = float(fit.model.predict(POINT[None])[0])
    assert window.predict(POINT) == pytest.approx(mean, rel=1e-7, abs=1e-8 * np.max(np.abs(window.y)))


def refused(window: Window) -> int:
    return window.counters()["bad_inputs"] + window.counters()["ill_conditioned"]


def refresh_around(window: Window, value: float) -> bool:
    """An extreme step while a refresh is open."""
    refresh = begin_refresh(window)
    window.replace(1, POINT, value)
    refresh.factor()
    return refresh.finish()


def steps_with(value: float) -> Iterator[tuple[str, Step]]:
    """Every step, with ``value`` in every place."""
    for i in range(3):
        x = POINT.copy()
        x[i] = value
        yield f"append x{i}", lambda w, x=x: w.append(x, 1.0)  # type: ignore[misc]
        yield f"replace x{i}", lambda w, x=x: w.replace(3, x, 1.0)  # type: ignore[misc]
    yield "append y", lambda w: w.append(POINT, value)
    yield "replace y", lambda w: w.replace(2, POINT, value)
    yield "refresh", lambda w: refresh_around(w, value)


@forms
@pytest.mark.parametrize("value", EXTREMES)
def test_every_step_with_every_extreme(form: Form, value: float) -> None:
    for name, step in steps_with(value):
        window = at_work(form)
        before, count = held(window), refused(window)
        status = step(window)
        # Before anything is taken back, and whatever the status.
        assert_finite(window)
        if status is not True and status is not Status.ACCEPTED:
            assert_same(window, before)
            assert refused(window) == count + 1, name
        assert window.replace(7, *sample(np.random.default_rng(8))) is Status.ACCEPTED, name
        assert_finite(window)
        assert_exact(window)


@forms
def test_what_is_no_number_or_beyond_all_measure_is_refused(form: Form) -> None:
    beyond = (np.inf, -np.inf, np.nan, 1e308, -1e308, 1e200, -1e200, 1e100, 1e10)
    for value in beyond:
        for name, step in steps_with(value):
            if name != "refresh":
                assert step(at_work(form)) is Status.BAD_INPUT, (name, value)


@forms
def test_the_limits_themselves_are_taken(form: Form) -> None:
    for y in (ws.MOST, -ws.MOST):
        window = at_work(form)
        assert window.append(POINT, y) is Status.ACCEPTED
        assert_finite(window)
        assert_exact(window)
        # All digits were of the one: with it gone, a step of refinement brings the others back.
        assert window.replace(HELD, *sample(np.random.default_rng(5))) is Status.ACCEPTED
        assert steps.refine(window.arrays)
        assert_exact(window)


@forms
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), data=st.data())
def test_any_mixture_of_good_and_extreme_steps(form: Form, seed: int, data: st.DataObject) -> None:
    rng, window = np.random.default_rng(seed), filled(form)
    # Equal samples make a matrix that no inverse in double precision is exact for.
    hardest = window.condition()
    for _ in range(data.draw(st.integers(1, 12))):
        before, count, n = held(window), refused(window), len(window)
        if data.draw(st.booleans()):
            steps = list(steps_with(data.draw(st.sampled_from(EXTREMES))))
            status = steps[data.draw(st.integers(0, len(steps) - 1))][1](window) if n > 8 else Status.NO_SLOT
        else:
            slot = int(rng.integers(n))
            status = data.draw(st.sampled_from(["replace", "append"]))  # type: ignore[assignment]
            good: dict[str, Callable[[], Status]] = {
                "replace": lambda slot=slot: window.replace(slot, *sample(rng)),  # type: ignore[misc]
                "append": lambda: window.append(*sample(rng)),
            }
            status = good[str(status)]()
        assert_finite(window)
        hardest = max(hardest, window.condition())
        if isinstance(status, Status) and status in (Status.BAD_INPUT, Status.ILL_CONDITIONED):
            assert_same(window, before)
            assert refused(window) == count + 1
    if hardest > 1e6:
        assert window.heal()
    assert window.replace(0, *sample(rng)) is Status.ACCEPTED
    assert_finite(window)
    if hardest <= 1e6:
        assert_exact(window)


@forms
@pytest.mark.parametrize("name", ["replace", "append"])
def test_a_worn_out_factorisation_refuses_and_keeps_all(form: Form, name: str) -> None:
    """P (or its factor) spoilt where the step must notice: refused, counted, and all as before to the last bit."""
    window = at_work(form)
    window.predict(POINT)
    A = window.arrays
    # What every one of these steps multiplies by; the solution itself is still good.
    A.P[: len(window), : len(window)] = np.nan
    kept, count = [window.alpha, np.array(window.bias), window.X, window.y], refused(window)
    rng = np.random.default_rng(2)
    possible: dict[str, Step] = {
        "replace": lambda w: w.replace(4, *sample(rng)),
        "append": lambda w: w.append(*sample(rng)),
    }
    with np.errstate(invalid="ignore"):
        assert possible[name](window) is Status.ILL_CONDITIONED
        assert refused(window) == count + 1
        for got, before in zip([window.alpha, np.array(window.bias), window.X, window.y], kept, strict=True):
            np.testing.assert_array_equal(got, before)
    window.rebuild()
    assert window.replace(4, *sample(rng)) is Status.ACCEPTED
    assert_exact(window)


@forms
def test_a_refinement_that_does_not_help_refuses_the_step(form: Form) -> None:
    """Whichever row is looked at: R and its factorisation no longer belong together, so that nothing contracts."""
    window = at_work(form)
    window.arrays.F[ws.TOLERANCE] = 1e-12
    window.arrays.P[:HELD, :HELD] *= 3.0
    before, count = [window.alpha, np.array(window.bias), window.X, window.y, window.round_residual], refused(window)
    refinements = window.counters()["refinements"]
    assert window.replace(3, POINT, 1.0) is Status.ILL_CONDITIONED
    assert refused(window) == count + 1
    for got, kept in zip(
        [window.alpha, np.array(window.bias), window.X, window.y, window.round_residual], before, strict=True
    ):
        np.testing.assert_array_equal(got, kept)
    assert window.counters()["refinements"] >= refinements
    assert window.heal()
    assert window.replace(3, POINT, 1.0) is Status.ACCEPTED
    assert_exact(window)


@forms
def test_a_refinement_that_leaves_the_finite_refuses_the_step(form: Form) -> None:
    """R holds what is no number, in a row that the factorisation was made without: only refining meets it."""
    window = at_work(form)
    window.arrays.F[ws.TOLERANCE] = 0.0
    window.arrays.C[ws.CURSOR] = 6
    window.arrays.R[9, 6] = np.inf
    window.arrays.R[6, 9] = np.inf
    window.arrays.V[ws.SY] *= 1.0 + 1e-6
    kept, count = [window.alpha, np.array(window.bias), window.X, window.y], refused(window)
    with np.errstate(invalid="ignore"):
        assert window.replace(3, POINT, 1.0) is Status.ILL_CONDITIONED
    assert refused(window) == count + 1
    for got, before in zip([window.alpha, np.array(window.bias), window.X, window.y], kept, strict=True):
        np.testing.assert_array_equal(got, before)
    assert np.isfinite(window.round_residual)


def triangle(window: Window) -> FloatArray:
    """The elements of the factor of a window, column by column of L."""
    A, n = window.arrays, len(window)
    return np.concatenate([A.P[A.order[k], : n - k] for k in range(n)])


@forms
def test_taking_a_step_back_is_exact_to_the_last_bit(form: Form) -> None:
    window, rng = at_work(form), np.random.default_rng(5)
    before, order = held(window), window.arrays.order[:HELD].copy()
    factor = triangle(window)
    for step in (lambda: window.replace(3, *sample(rng)), lambda: window.append(*sample(rng))):
        assert step() is Status.ACCEPTED
        steps.take_back(window.arrays)
        assert_same(window, before)
        np.testing.assert_array_equal(window.arrays.order[:HELD], order)
        if form == "cholesky":
            np.testing.assert_array_equal(triangle(window), factor)
    assert window.replace(3, *sample(rng)) is Status.ACCEPTED
    assert_exact(window)


def test_a_refactorisation_that_fails_changes_nothing_not_even_the_form() -> None:
    window = Window.from_samples(WindowConfig(6, (1.0,), 100.0, accuracy=1e-6), np.arange(6.0)[:, None], np.arange(6.0))
    window.config = WindowConfig(6, (1.0,), 100.0, accuracy=1e-30)
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = 50.0
    before = [field.copy() for field in window.arrays]
    assert window.heal() is False
    for got, kept in zip(window.arrays, before, strict=True):
        np.testing.assert_array_equal(got, kept)


def test_a_window_is_not_made_of_what_a_step_would_refuse() -> None:
    X, y = np.random.default_rng(0).random((6, 3)), np.arange(6.0)
    config = WindowConfig(CAPACITY, WIDTHS, GAMMA)
    for change in ({"X": X * 1e12}, {"y": y * 1e200}):
        with pytest.raises(InputError, match="X, y: got values"):
            Window.from_samples(config, **{"X": X, "y": y, **change})
    with pytest.raises(InputError, match="gamma"):
        WindowConfig(CAPACITY, WIDTHS, 1e16)
