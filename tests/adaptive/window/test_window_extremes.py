"""No step leaves a window non-finite: what is refused is counted and changes nothing, what is taken is exact."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive import lssvm
from adaptive.errors import InputError, NumericsError
from adaptive.window import arrays as ws
from adaptive.window import healing as window_refresh
from adaptive.window.arrays import Status
from adaptive.window.config import Backend, Form, WindowConfig
from adaptive.window.window import Window

KINDS: list[tuple[Form, Backend]] = [("inverse", "compiled"), ("cholesky", "compiled"), ("inverse", "plain")]
kinds = pytest.mark.parametrize(("form", "backend"), KINDS)
linears = pytest.mark.parametrize("linear", [(), (0, 2)])
GAMMA, WIDTHS, CAPACITY, HELD = 200.0, (0.6, 0.9, 1.5), 14, 12
POINT = np.array([0.4, 0.3, 0.6])
#: Values that a broken sensor, a division or a wrong unit may bring.
EXTREMES = (np.inf, -np.inf, np.nan, 1e308, -1e308, 1e200, -1e200, 1e100, 1e10, 1e-320, -1e-320, 0.0, -1.0, -1e-300)

Step = Callable[[Window], Status | bool]


def sample(rng: np.random.Generator) -> tuple[np.ndarray, float, float]:
    x = rng.random(3)
    return x, float(np.sin(4 * x[0]) + x[1] * x[2] + 0.02 * rng.standard_normal()), float(rng.random() + 0.3)


def filled(form: Form, backend: Backend, linear: tuple[int, ...] = (), n: int = HELD) -> Window:
    rng, window = np.random.default_rng(3), Window(WindowConfig(CAPACITY, WIDTHS, GAMMA, linear, form, backend))
    for _ in range(n):
        assert window.append(*sample(rng)) is Status.ACCEPTED
    # One more step, so that a rank-2 term is pending, as it is in a window at work.
    assert window.replace(2, *sample(rng)) is Status.ACCEPTED
    return window


def held(window: Window) -> list[np.ndarray]:
    """What a window holds and answers."""
    answers = [window.predict(POINT), *window.predict_with_variance(POINT), window.scale]
    solution = [window.alpha, window.beta, window.arrays.G.copy(), np.array(answers)]
    return [window.X, window.y, window.weights, *solution]


def assert_same(window: Window, before: list[np.ndarray], status: Status | bool) -> None:
    """To the last bit; the variance of an inverse form to rounding where a step took in what was pending."""
    for got, kept in zip(held(window)[:-1], before[:-1], strict=True):
        np.testing.assert_array_equal(got, kept)
    if status is Status.ILL_CONDITIONED and window.form == "inverse":
        np.testing.assert_allclose(held(window)[-1], before[-1], rtol=1e-9)
    else:
        np.testing.assert_array_equal(held(window)[-1], before[-1])


def assert_finite(window: Window) -> None:
    for values in held(window):
        assert np.all(np.isfinite(values))


def assert_exact(window: Window) -> None:
    """As the direct solver, in units of the samples at hand."""
    fit = lssvm.fit(window.X, window.y, WIDTHS, GAMMA, window.weights, window.config.linear)
    size = np.max(np.abs(fit.model.alpha))
    np.testing.assert_allclose(window.alpha, fit.model.alpha, rtol=1e-7, atol=1e-8 * size)
    mean, variance = window.predict_with_variance(POINT)
    reach = np.max(np.abs(window.y))
    assert mean == pytest.approx(float(fit.model.predict(POINT[None])[0]), rel=1e-7, abs=1e-8 * reach)
    assert variance == pytest.approx(float(fit.variance(POINT[None])[0]), rel=1e-5)


def refused(window: Window) -> int:
    return window.counters()["bad_inputs"] + window.counters()["ill_conditioned"]


def refresh_around(window: Window, value: float) -> bool:
    """An extreme step while a refresh is open."""
    refresh = window_refresh.begin(window)
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
    yield "append w", lambda w: w.append(POINT, 1.0, value)
    yield "replace y", lambda w: w.replace(2, POINT, value)
    yield "replace w", lambda w: w.replace(2, POINT, 1.0, value)
    yield "reweight", lambda w: w.reweight(4, value)
    yield "rescale gain", lambda w: w.rescale_targets(value, 0.0)
    yield "rescale offset", lambda w: w.rescale_targets(0.0, value)
    yield "shift one", lambda w: w.shift_targets(np.where(np.arange(len(w)) == 3, value, 0.0))
    yield "shift all", lambda w: w.shift_targets(np.full(len(w), value))
    yield "remove", lambda w: w.remove(5)
    yield "refine", lambda w: w.refine()
    yield "resum", lambda w: w.resum()
    yield "refresh", lambda w: refresh_around(w, value)


@kinds
@linears
@pytest.mark.parametrize("value", EXTREMES)
def test_every_step_with_every_extreme(form: Form, backend: Backend, linear: tuple[int, ...], value: float) -> None:
    for name, step in steps_with(value):
        window = filled(form, backend, linear)
        before, count = held(window), refused(window)
        status = step(window)
        # Before anything is taken back, and whatever the status.
        assert_finite(window)
        if status is not True and status is not Status.ACCEPTED:
            assert_same(window, before, status)
            assert refused(window) == count + 1, name
        assert window.replace(7, *sample(np.random.default_rng(8))) is Status.ACCEPTED, name
        assert_finite(window)
        assert_exact(window)


@kinds
def test_what_is_no_number_or_beyond_all_measure_is_refused(form: Form, backend: Backend) -> None:
    beyond = (np.inf, -np.inf, np.nan, 1e308, -1e308, 1e200, -1e200, 1e100, 1e10)
    for value in beyond:
        for name, step in steps_with(value):
            if name not in ("remove", "refine", "resum", "refresh", "append w", "replace w", "reweight"):
                assert step(filled(form, backend)) is Status.BAD_INPUT, (name, value)
    for value in (np.inf, np.nan, 1e308, 1e200, 1e-320, 0.0, -1.0, -np.inf):
        for name, step in steps_with(value):
            if name in ("append w", "replace w", "reweight"):
                assert step(filled(form, backend)) is Status.BAD_INPUT, (name, value)


@kinds
def test_the_limits_themselves_are_taken(form: Form, backend: Backend) -> None:
    for y in (ws.MOST, -ws.MOST):
        window = filled(form, backend, (0,))
        assert window.append(POINT, y) is Status.ACCEPTED
        assert_finite(window)
        assert_exact(window)
        # All digits were of the one: with it gone, a step of refinement brings the others back.
        assert window.replace(HELD, *sample(np.random.default_rng(5))) is Status.ACCEPTED
        assert window.refine()
        assert_exact(window)
    for weight in (1.000001 * ws.LEAST_PRECISION / GAMMA, 1e-9, 1e6):
        window = filled(form, backend)
        assert window.reweight(3, weight) is Status.ACCEPTED
        assert_exact(window)
        assert window.reweight(3, 1.0) is Status.ACCEPTED
        assert_exact(window)
        assert window.append(POINT, 1.0, weight) is Status.ACCEPTED
        assert_exact(window)


@kinds
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), data=st.data())
def test_any_mixture_of_good_and_extreme_steps(form: Form, backend: Backend, seed: int, data: st.DataObject) -> None:
    rng, window = np.random.default_rng(seed), filled(form, backend, (1,))
    # A weight of 1e10 on two equal samples makes a matrix that no inverse in double precision is exact for.
    hardest = window.condition()
    for _ in range(data.draw(st.integers(1, 12))):
        before, count, n = held(window), refused(window), len(window)
        if data.draw(st.booleans()):
            steps = list(steps_with(data.draw(st.sampled_from(EXTREMES))))
            status = steps[data.draw(st.integers(0, len(steps) - 1))][1](window) if n > 8 else Status.NO_SLOT
        else:
            slot = int(rng.integers(n))
            status = data.draw(st.sampled_from(["replace", "append", "reweight", "undo", "shift"]))  # type: ignore[assignment]
            good: dict[str, Callable[[], Status]] = {
                "replace": lambda slot=slot: window.replace(slot, *sample(rng)),  # type: ignore[misc]
                "append": lambda: window.append(*sample(rng)),
                "reweight": lambda slot=slot: window.reweight(slot, float(rng.random() + 0.1)),  # type: ignore[misc]
                "undo": window.undo,
                "shift": lambda n=n: window.shift_targets(0.1 * rng.standard_normal(n)),  # type: ignore[misc]
            }
            status = good[str(status)]()
        assert_finite(window)
        hardest = max(hardest, window.condition())
        if isinstance(status, Status) and status in (Status.BAD_INPUT, Status.ILL_CONDITIONED):
            assert_same(window, before, status)
            assert refused(window) == count + 1
    if hardest > 1e6:
        assert window.heal()
    assert window.replace(0, *sample(rng)) is Status.ACCEPTED
    assert_finite(window)
    if hardest <= 1e6:
        assert_exact(window)


@pytest.mark.parametrize(("form", "backend"), KINDS)
@pytest.mark.parametrize("name", ["replace", "append", "remove", "reweight", "shift", "rescale"])
def test_a_worn_out_factorisation_refuses_and_keeps_all(form: Form, backend: Backend, name: str) -> None:
    """P (or its factor) spoilt where the step must notice: refused, counted, and all as before to the last bit."""
    window = filled(form, backend, (1,))
    window.predict(POINT)
    A = window.arrays
    # What every one of these steps multiplies by; the solution itself is still good.
    if name == "rescale":
        A.V[ws.SY, 1] = np.inf
    else:
        A.P[: len(window), : len(window)] = np.nan
    kept, count = [window.alpha, window.beta, window.X, window.y, window.weights], refused(window)
    rng = np.random.default_rng(2)
    steps: dict[str, Step] = {
        "replace": lambda w: w.replace(4, *sample(rng)),
        "append": lambda w: w.append(*sample(rng)),
        "remove": lambda w: w.remove(4),
        "reweight": lambda w: w.reweight(4, 0.5),
        "shift": lambda w: w.shift_targets(np.full(len(w), 0.1)),
        "rescale": lambda w: w.rescale_targets(0.1, 0.0),
    }
    with np.errstate(invalid="ignore"):
        assert steps[name](window) is Status.ILL_CONDITIONED
        assert refused(window) == count + 1
        for got, before in zip([window.alpha, window.beta, window.X, window.y, window.weights], kept, strict=True):
            np.testing.assert_array_equal(got, before)
    window.rebuild()
    assert window.replace(4, *sample(rng)) is Status.ACCEPTED
    assert_exact(window)


@kinds
def test_a_refinement_that_does_not_help_refuses_the_step(form: Form, backend: Backend) -> None:
    """Whichever row is looked at: R and its factorisation no longer belong together, so that nothing contracts."""
    window = filled(form, backend)
    window.arrays.F[ws.TOLERANCE] = 1e-12
    window.arrays.P[:HELD, :HELD] *= 3.0
    before, count = [window.alpha, window.beta, window.X, window.y, window.round_residual], refused(window)
    refinements = window.counters()["refinements"]
    assert window.replace(3, POINT, 1.0) is Status.ILL_CONDITIONED
    assert refused(window) == count + 1
    for got, kept in zip([window.alpha, window.beta, window.X, window.y, window.round_residual], before, strict=True):
        np.testing.assert_array_equal(got, kept)
    assert window.counters()["refinements"] >= refinements
    assert window.heal()
    assert window.replace(3, POINT, 1.0) is Status.ACCEPTED
    assert_exact(window)


@kinds
def test_a_refinement_that_leaves_the_finite_refuses_the_step(form: Form, backend: Backend) -> None:
    """R holds what is no number, in a row that the factorisation was made without: only refining meets it."""
    window = filled(form, backend)
    window.arrays.F[ws.TOLERANCE] = 0.0
    window.arrays.C[ws.CURSOR] = 6
    window.arrays.R[9, 6] = np.inf
    window.arrays.R[6, 9] = np.inf
    window.arrays.V[ws.SY] *= 1.0 + 1e-6
    kept, count = [window.alpha, window.beta, window.X, window.y], refused(window)
    with np.errstate(invalid="ignore"):
        assert window.replace(3, POINT, 1.0) is Status.ILL_CONDITIONED
    assert refused(window) == count + 1
    for got, before in zip([window.alpha, window.beta, window.X, window.y], kept, strict=True):
        np.testing.assert_array_equal(got, before)
    assert np.isfinite(window.round_residual)


@kinds
def test_refine_and_resum_called_by_hand_keep_the_solution(form: Form, backend: Backend) -> None:
    window = filled(form, backend)
    before = [window.alpha, window.beta, window.arrays.S.copy(), window.arrays.V[ws.SY].copy()]
    window.arrays.P[:HELD, :HELD] = np.nan
    with np.errstate(invalid="ignore"):
        assert window.refine() is False
        assert window.resum() is False
    for got, kept in zip([window.alpha, window.beta, window.arrays.S, window.arrays.V[ws.SY]], before, strict=True):
        np.testing.assert_array_equal(got, kept)


def test_undo_in_the_cholesky_form_is_exact_to_the_last_bit() -> None:
    window, rng = filled("cholesky", "compiled", (1,)), np.random.default_rng(5)
    before, order = held(window), window.arrays.order[:HELD].copy()
    upper = np.triu(window.arrays.P[:HELD, :HELD])
    for step in (lambda: window.replace(3, *sample(rng)), lambda: window.append(*sample(rng))):
        assert step() is Status.ACCEPTED
        assert window.undo() is Status.ACCEPTED
        assert_same(window, before, Status.BAD_INPUT)
        np.testing.assert_array_equal(np.triu(window.arrays.P[:HELD, :HELD]), upper)
        np.testing.assert_array_equal(window.arrays.order[:HELD], order)


def test_a_refactorisation_that_fails_changes_nothing_not_even_the_form() -> None:
    window = Window.from_samples(WindowConfig(6, (1.0,), 100.0, accuracy=1e-6), np.arange(6.0)[:, None], np.arange(6.0))
    window.config = WindowConfig(6, (1.0,), 100.0, accuracy=1e-30)
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = 50.0
    before = [field.copy() for field in window.arrays]
    assert window.heal() is False
    with pytest.raises(NumericsError, match="pivot"):
        window.switch_form("cholesky")
    for got, kept in zip(window.arrays, before, strict=True):
        np.testing.assert_array_equal(got, kept)


def test_a_window_is_not_made_of_what_a_step_would_refuse() -> None:
    X, y = np.random.default_rng(0).random((6, 3)), np.arange(6.0)
    config = WindowConfig(CAPACITY, WIDTHS, GAMMA)
    for change in ({"X": X * 1e12}, {"y": y * 1e200}, {"weights": np.full(6, 1e-320)}, {"weights": np.full(6, np.inf)}):
        with pytest.raises(InputError, match="X, y, weights"):
            Window.from_samples(config, **{"X": X, "y": y, **change})
    with pytest.raises(InputError, match="gamma"):
        WindowConfig(CAPACITY, WIDTHS, 1e16)
