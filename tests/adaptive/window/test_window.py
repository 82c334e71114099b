"""The sliding window: every step beside the direct solution, leave-one-out errors, residuals, and its handle."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive import lssvm
from dehyst.adaptive.errors import InputError, ModelFileError, NumericsError
from dehyst.adaptive.state import load, save
from dehyst.adaptive.types import FloatArray
from dehyst.adaptive.window import arrays as ws
from dehyst.adaptive.window import steps
from dehyst.adaptive.window.arrays import Status, handle_of
from dehyst.adaptive.window.window import Form, SolverState, Window, WindowConfig, begin_refresh
from tests.adaptive.window.windows import CAPACITY, GAMMA, STEPS, WIDTHS, assert_exact, empty, filled, forms, sample

# --- The sliding window in both forms, against the direct solver and against itself.


@forms
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    steps=st.lists(st.sampled_from(sorted(STEPS)), min_size=1, max_size=25),
)
def test_any_sequence_of_steps_is_exact(form: Form, seed: int, steps: list[str]) -> None:
    rng, window = np.random.default_rng(seed), filled(form, 12, seed)
    for name in steps:
        expected = {Status.ACCEPTED}
        if name == "append" and window.full:
            expected = {Status.NO_SLOT}
        assert STEPS[name](window, rng) in expected, name
    assert_exact(window)


@forms
@pytest.mark.parametrize("seed", range(640, 680))
def test_rounding_in_a_nearly_empty_window_is_no_bad_inverse(form: Form, seed: int) -> None:
    # `filled` asserts that every step is accepted; one was refused once with hardly more samples than coefficients.
    assert_exact(filled(form, 4, seed))


@forms
def test_growing_from_empty_is_exact_at_every_size(form: Form) -> None:
    window, rng = empty(form), np.random.default_rng(4)
    assert window.predict(np.zeros(3)) == 0.0
    for n in range(1, CAPACITY + 1):
        assert window.append(*sample(rng)) is Status.ACCEPTED
        assert len(window) == n
        assert np.all(np.isfinite(window.alpha))
        if n > 1:
            assert_exact(window)
    assert window.full
    assert window.append(*sample(rng)) is Status.NO_SLOT


@forms
@pytest.mark.parametrize("slot", range(0, CAPACITY, 4))
def test_every_slot_can_be_replaced(form: Form, slot: int) -> None:
    window = filled(form)
    x, y = sample(np.random.default_rng(8))
    assert window.replace(slot, x, y) is Status.ACCEPTED
    np.testing.assert_array_equal(window.X[slot], x)
    assert window.y[slot] == y
    assert_exact(window)


@forms
def test_slots_that_do_not_exist(form: Form) -> None:
    window = filled(form, n=5)
    x, y = sample(np.random.default_rng(1))
    for slot in (-1, 5, 1000):
        assert window.replace(slot, x, y) is Status.NO_SLOT
    assert_exact(window)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_order_of_samples_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = [sample(rng) for _ in range(CAPACITY)]
    first, second = empty(), empty()
    for p in points:
        first.append(*p)
    for i in rng.permutation(CAPACITY):
        second.append(*points[i])
    x = rng.random(3)
    assert second.predict(x) == pytest.approx(first.predict(x), abs=1e-9)
    assert second.scale == pytest.approx(first.scale, rel=1e-8)


@forms
def test_from_samples_and_rebuild(form: Form) -> None:
    grown = filled(form)
    made = Window.from_samples(grown.config, grown.X, grown.y)
    np.testing.assert_allclose(made.alpha, grown.alpha, rtol=1e-7, atol=1e-9)
    rng = np.random.default_rng(3)
    for k in range(40):
        made.replace(k % CAPACITY, *sample(rng))
    made.rebuild()
    assert_exact(made, 1e-10)
    made.replace(4, *sample(rng))
    assert_exact(made)


def test_auto_takes_the_form_that_the_accuracy_needs() -> None:
    source = filled("inverse")
    for gamma, accuracy, expected in ((1e2, 1e-6, "inverse"), (1e2, 1e-14, "cholesky"), (1e9, 1e-6, "cholesky")):
        config = WindowConfig(CAPACITY, WIDTHS, gamma, form="auto", accuracy=accuracy)
        assert Window.from_samples(config, source.X, source.y).form == expected


@forms
def test_state_goes_on_to_the_last_bit(form: Form) -> None:
    window, rng = filled(form), np.random.default_rng(6)
    window.replace(1, *sample(rng))
    again = Window.of(window.config, window.state())
    twin = window.copy()
    for _ in range(5):
        point = sample(rng)
        for w in (window, again, twin):
            w.replace(2, *point)
    np.testing.assert_array_equal(again.alpha, window.alpha)
    np.testing.assert_array_equal(twin.alpha, window.alpha)
    assert again.counters() == window.counters()


def test_both_matrices_share_one_in_the_inverse_form() -> None:
    """Only what is used: the lower triangle of P, and one triangle of R, which is symmetric to the last bit."""
    window = filled("inverse")
    state = save(window.state())
    assert sum(state[name].size for name in ("P", "R", "PR") if name in state) == CAPACITY * (CAPACITY + 1)
    again = Window.of(window.config, load(SolverState, state))
    np.testing.assert_array_equal(again.arrays.R, window.arrays.R)
    np.testing.assert_array_equal(np.tril(again.arrays.P), np.tril(window.arrays.P))


def test_a_copy_is_independent() -> None:
    window = filled("inverse")
    alpha, twin = window.alpha, window.copy()
    twin.replace(0, *sample(np.random.default_rng(6)))
    np.testing.assert_array_equal(window.alpha, alpha)


def test_foreign_state_is_refused() -> None:
    state, sizes = save(filled("inverse").state()), {"N": CAPACITY, "d": len(WIDTHS)}
    with pytest.raises(ModelFileError, match="expected an array"):
        load(SolverState, state, sizes | {"N": CAPACITY + 1})
    del state["PR"]
    with pytest.raises(ModelFileError, match="PR: got P and R: False"):
        load(SolverState, state, sizes)


@pytest.mark.parametrize(("form", "gamma", "bound"), [("inverse", 1e3, 1e-8), ("cholesky", 1e6, 1e-7)])
def test_long_stream_with_near_duplicates_stays_exact(form: Form, gamma: float, bound: float) -> None:
    rng, n, steps = np.random.default_rng(1), 60, 4000
    X = rng.random((steps, 3))
    for k in np.flatnonzero(rng.random(steps) < 0.2):
        X[k] = X[max(k - 1 - int(rng.integers(30)), 0)] + 1e-7 * rng.standard_normal(3)
    y = np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(steps)
    window = Window(WindowConfig(n, (1.0, 1.0, 1.0), gamma, form=form, accuracy=1e-8))
    for k in range(steps):
        status = window.append(X[k], y[k]) if k < n else window.replace(int(rng.integers(n)), X[k], y[k])
        assert status is Status.ACCEPTED
    expected = lssvm.fit(window.X, window.y, 1.0, gamma).model.alpha
    assert np.linalg.norm(window.alpha - expected) < bound * np.linalg.norm(expected)


def test_condition_bound_is_a_close_upper_bound() -> None:
    window = filled("inverse")
    true = np.linalg.cond(window.arrays.R)
    assert 0.99 * true <= window.condition() <= 3 * true


def test_inputs_are_not_changed() -> None:
    window = filled("inverse")
    x = np.array([0.1, 0.2, 0.3])
    window.replace(0, x, 1.0)
    window.predict(x)
    window.nearest(x)
    np.testing.assert_array_equal(x, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"capacity": 0}, "capacity"),
        ({"widths": ()}, "widths"),
        ({"widths": (1.0, -1.0)}, "widths"),
        ({"gamma": -1.0}, "gamma"),
        ({"form": "lu"}, "form"),
        ({"accuracy": 0.0}, "accuracy"),
    ],
)
def test_bad_configuration(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        WindowConfig(**{"capacity": 5, "widths": (1.0, 1.0), "gamma": 10.0, **change})  # type: ignore[arg-type]


def test_shapes_are_checked() -> None:
    window = filled("inverse")
    with pytest.raises(InputError, match="x: got shape"):
        window.predict(np.zeros(2))
    with pytest.raises(InputError, match="capacity"):
        Window.from_samples(window.config, np.zeros((CAPACITY + 1, 3)), np.zeros(CAPACITY + 1))


def test_singular_samples_leave_the_window_as_it_was() -> None:
    window = filled("inverse", n=6)
    alpha, R = window.alpha, window.arrays.R[0, 1]
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = 50.0
    with pytest.raises(NumericsError, match="pivot"):
        window.rebuild()
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = R
    np.testing.assert_array_equal(window.alpha, alpha)
    assert_exact(window)


# --- What all others foretell for each sample of a window, against fits without it.


@forms
def test_leave_one_out_is_what_it_says_for_every_sample(form: Form) -> None:
    """Against a fit without the sample, for all of them, at every step of a window at work."""
    window, rng = filled(form, CAPACITY - 3), np.random.default_rng(11)
    steps = ["replace", "replace", "append", "append", "replace"]
    for name in [*steps, *["replace"] * (CAPACITY + 2)]:
        STEPS[name](window, rng)
        X, y, n = window.X, window.y, len(window)
        found = window.leave_one_out()
        for i in range(n):
            rest = np.arange(n) != i
            without = lssvm.fit(X[rest], y[rest], WIDTHS, GAMMA).model
            assert found[i] == pytest.approx(y[i] - without.predict(X[i : i + 1])[0], rel=1e-7, abs=1e-9), (name, i)


@forms
def test_leave_one_out_of_samples_that_determine_a_coefficient_alone_is_no_number(form: Form) -> None:
    window = empty(form)
    assert window.append(np.zeros(3), 2.0) is Status.ACCEPTED
    assert np.isnan(window.leave_one_out()).all()


def test_leave_one_out_of_the_cholesky_form_at_cond_1e8_after_many_steps() -> None:
    rng, n = np.random.default_rng(1), 60
    X = rng.random((1000, 3))
    y = np.sin(4 * X[:, 0]) + X[:, 1] * X[:, 2] + 1e-3 * rng.standard_normal(1000)
    window = Window.from_samples(WindowConfig(n, (1.5,) * 3, 2e6, form="cholesky"), X[:n], y[:n])
    for k in range(n, 1000):
        assert window.replace(int(rng.integers(n)), X[k], y[k]) is Status.ACCEPTED
    expected = lssvm.fit(window.X, window.y, 1.5, 2e6).leave_one_out()
    assert np.linalg.norm(window.leave_one_out() - expected) < 1e-7 * np.linalg.norm(expected)


# --- What a window finds wrong with its own solution, row by row, and how it puts that right.


@forms
def test_residuals_rotate_and_refinement_heals(form: Form) -> None:
    window, rng = filled(form), np.random.default_rng(7)
    exact, A = window.alpha, window.arrays
    # Damage S and Sy as drift would: all rows but the one being replaced feel it.
    A.S[:] *= 1 + 1e-4 * rng.standard_normal(A.S.shape)
    A.V[ws.SY] *= 1 + 1e-4 * rng.standard_normal(CAPACITY)
    assert steps.resum(A)
    np.testing.assert_allclose(window.alpha, exact, rtol=1e-7)
    A.V[ws.SY] *= 1 + 1e-4 * rng.standard_normal(CAPACITY)
    before = window.counters()
    for _ in range(CAPACITY):
        assert window.replace(5, *sample(rng)) is Status.ACCEPTED
    after = window.counters()
    assert after["residuals_exceeded"] > before["residuals_exceeded"]
    assert after["refinements"] > before["refinements"]
    assert after["residual_rounds"] == before["residual_rounds"] + 1
    assert_exact(window)


@forms
def test_each_row_is_looked_at_once_a_round(form: Form) -> None:
    """Row after row, each with the residual that it has then; the round's worst is published at its end."""
    window, rng = filled(form), np.random.default_rng(7)
    A = window.arrays
    A.F[ws.TOLERANCE] = np.inf
    A.V[ws.SY] *= 1 + 1e-3 * rng.standard_normal(CAPACITY)
    while A.C[ws.CURSOR] != 0:
        window.replace(5, *sample(rng))
    worst = 0.0
    for row in range(CAPACITY):
        assert window.replace(int(rng.integers(CAPACITY)), *sample(rng)) is Status.ACCEPTED
        residual = abs(A.V[ws.Y, row] - A.R[row] @ A.V[ws.ALPHA] - A.F[ws.BETA])
        assert A.F[ws.RESIDUAL] == pytest.approx(residual, rel=1e-6, abs=1e-12)
        worst = max(worst, A.F[ws.RESIDUAL])
    assert window.round_residual == worst > 1e-9
    assert A.C[ws.CURSOR] == 0


# --- A window that is handed over by address is the window itself.


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
    refresh = begin_refresh(window)
    window.replace(7, X[71], float(y[71]))
    refresh.factor()
    assert refresh.finish()
    assert window.predict(X[72]) == steps.predict(window.arrays, X[72])
