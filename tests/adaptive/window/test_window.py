"""The sliding window, both forms and both backends, against the direct solver and against itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive import lssvm
from adaptive.errors import InputError, NumericsError
from adaptive.window import arrays as ws
from adaptive.window.arrays import Status
from adaptive.window.config import Backend, Form, WindowConfig
from adaptive.window.window import Window
from tests.adaptive.window.windows import (
    CAPACITY,
    GAMMA,
    LINEAR,
    STEPS,
    WIDTHS,
    assert_exact,
    empty,
    filled,
    kinds,
    sample,
)


@kinds
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    steps=st.lists(st.sampled_from(sorted(STEPS)), min_size=1, max_size=25),
    linear=st.sampled_from(LINEAR),
)
def test_any_sequence_of_steps_is_exact(
    form: Form, backend: Backend, seed: int, steps: list[str], linear: tuple[int, ...]
) -> None:
    rng, window = np.random.default_rng(seed), filled(form, backend, linear, 12, seed)
    for name in steps:
        if name == "remove" and len(window) <= 6:
            continue
        expected = {Status.ACCEPTED}
        if name == "append" and window.full:
            expected = {Status.NO_SLOT}
        if name == "undo":
            expected = {Status.ACCEPTED, Status.NOTHING_TO_UNDO} if len(window) > 6 else {Status.NOTHING_TO_UNDO}
            if len(window) <= 6:
                continue
        assert STEPS[name](window, rng) in expected, name
    assert_exact(window)


@kinds
@pytest.mark.parametrize("seed", range(640, 680))
def test_rounding_in_a_nearly_empty_window_is_no_inverse_gone_wrong(form: Form, backend: Backend, seed: int) -> None:
    # Each step of the growing is asserted; 659 was refused once, with hardly more samples than linear terms.
    assert len(filled(form, backend, (0, 2), 12, seed)) == 12


@kinds
@pytest.mark.parametrize("linear", LINEAR)
def test_growing_from_empty_is_exact_at_every_size(form: Form, backend: Backend, linear: tuple[int, ...]) -> None:
    window, rng = empty(form, backend, linear), np.random.default_rng(4)
    assert window.predict(np.zeros(3)) == 0.0
    for n in range(1, CAPACITY + 1):
        assert window.append(*sample(rng)) is Status.ACCEPTED
        assert len(window) == n
        assert np.all(np.isfinite(window.alpha))
        if n > 1 + len(linear):
            assert_exact(window)
    assert window.full
    assert window.append(*sample(rng)) is Status.NO_SLOT


@kinds
@pytest.mark.parametrize("slot", range(0, CAPACITY, 4))
def test_every_slot_can_be_replaced(form: Form, backend: Backend, slot: int) -> None:
    window = filled(form, backend, (0,))
    x, y, w = sample(np.random.default_rng(8))
    assert window.replace(slot, x, y, w) is Status.ACCEPTED
    np.testing.assert_array_equal(window.X[slot], x)
    assert (window.y[slot], window.weights[slot]) == (y, w)
    assert_exact(window)


@kinds
def test_undo_takes_back_and_goes_on(form: Form, backend: Backend) -> None:
    window, twin = filled(form, backend, (1,)), filled(form, backend, (1,))
    rng = np.random.default_rng(5)
    for step in (lambda: window.replace(3, *sample(rng)), lambda: window.replace(CAPACITY - 1, *sample(rng))):
        assert step() is Status.ACCEPTED
        assert not np.allclose(window.alpha, twin.alpha)
        assert window.undo() is Status.ACCEPTED
        np.testing.assert_array_equal(window.X, twin.X)
        np.testing.assert_array_equal(window.y, twin.y)
        np.testing.assert_allclose(window.alpha, twin.alpha, rtol=1e-9)
        assert window.undo() is Status.NOTHING_TO_UNDO
    assert window.counters()["undone"] == 2
    x, y, w = sample(rng)
    window.replace(0, x, y, w)
    twin.replace(0, x, y, w)
    np.testing.assert_allclose(window.alpha, twin.alpha, rtol=1e-8)
    assert_exact(window)


def test_undo_of_the_compiled_inverse_is_exact_to_the_last_bit() -> None:
    window, rng = filled("inverse", "compiled", n=CAPACITY - 1), np.random.default_rng(5)
    before = window.alpha, window.beta, window.predict_with_variance(np.full(3, 0.4))
    for step in (lambda: window.append(*sample(rng)), lambda: window.replace(2, *sample(rng))):
        step()
        window.undo()
        np.testing.assert_array_equal(window.alpha, before[0])
        np.testing.assert_array_equal(window.beta, before[1])
        assert window.predict_with_variance(np.full(3, 0.4))[0] == before[2][0]


BAD_SAMPLES = [
    (np.array([np.nan, 0, 0]), 1.0, 1.0),
    (np.array([0, np.inf, 0]), 1.0, 1.0),
    (np.zeros(3), np.nan, 1.0),
    (np.zeros(3), -np.inf, 1.0),
    (np.zeros(3), 1.0, 0.0),
    (np.zeros(3), 1.0, -1.0),
    (np.zeros(3), 1.0, np.inf),
    (np.zeros(3), 1.0, np.nan),
]


@kinds
@pytest.mark.parametrize("bad", BAD_SAMPLES)
def test_bad_samples_are_refused_and_counted(
    form: Form, backend: Backend, bad: tuple[np.ndarray, float, float]
) -> None:
    window = filled(form, backend, n=CAPACITY - 1)
    alpha = window.alpha
    assert window.replace(3, *bad) is Status.BAD_INPUT
    assert window.append(*bad) is Status.BAD_INPUT
    np.testing.assert_array_equal(window.alpha, alpha)
    assert window.counters()["bad_inputs"] == 2


@kinds
def test_slots_that_do_not_exist(form: Form, backend: Backend) -> None:
    window = filled(form, backend, n=5)
    x, y, w = sample(np.random.default_rng(1))
    for slot in (-1, 5, 1000):
        assert window.replace(slot, x, y, w) is Status.NO_SLOT
        assert window.remove(slot) is Status.NO_SLOT
        assert window.reweight(slot, 1.0) is Status.NO_SLOT
    assert window.reweight(0, -1.0) is Status.BAD_INPUT
    assert window.rescale_targets(np.nan, 0.0) is Status.BAD_INPUT
    assert window.rescale_targets(-1.0, 0.0) is Status.BAD_INPUT
    assert window.shift_targets(np.full(5, np.nan)) is Status.BAD_INPUT
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


def test_targets_can_be_rescaled_as_if_learnt_so() -> None:
    first, second = filled("inverse", "compiled", (0,)), empty("inverse", "compiled", (0,))
    for x, y, w in zip(first.X, first.y, first.weights, strict=True):
        second.append(x, 1.06 * y - 0.3, w)
    first.rescale_targets(0.06, -0.3)
    np.testing.assert_allclose(first.alpha, second.alpha, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(first.beta, second.beta, rtol=1e-8)


def test_linear_columns_that_do_not_differ_get_no_slope() -> None:
    window, rng = empty(linear=(1,)), np.random.default_rng(0)
    for _ in range(8):
        x, y, w = sample(rng)
        window.append(np.array([x[0], 0.25, x[2]]), y, w)
    assert window.beta[1] == 0.0
    assert window.worst_residual() < 1e-9


@kinds
def test_from_samples_and_rebuild(form: Form, backend: Backend) -> None:
    grown = filled(form, backend, (2,))
    made = Window.from_samples(grown.config, grown.X, grown.y, grown.weights)
    np.testing.assert_allclose(made.alpha, grown.alpha, rtol=1e-7, atol=1e-9)
    rng = np.random.default_rng(3)
    for k in range(40):
        made.replace(k % CAPACITY, *sample(rng))
    made.rebuild()
    assert_exact(made, 1e-10)
    made.replace(4, *sample(rng))
    assert_exact(made)


def test_switching_form_keeps_the_solution() -> None:
    window, rng = filled("inverse", "compiled", (0,)), np.random.default_rng(2)
    for form in ("cholesky", "inverse", "cholesky"):
        window.switch_form(form)
        assert window.form == form
        assert_exact(window)
        window.replace(int(rng.integers(CAPACITY)), *sample(rng))
        assert_exact(window)


def test_auto_takes_the_form_that_the_accuracy_needs() -> None:
    source = filled("inverse", "compiled")
    for gamma, accuracy, expected in ((1e2, 1e-6, "inverse"), (1e2, 1e-14, "cholesky"), (1e9, 1e-6, "cholesky")):
        config = WindowConfig(CAPACITY, WIDTHS, gamma, form="auto", accuracy=accuracy)
        assert Window.from_samples(config, source.X, source.y).form == expected


@kinds
def test_state_goes_on_to_the_last_bit(form: Form, backend: Backend) -> None:
    window, rng = filled(form, backend, (1,)), np.random.default_rng(6)
    window.replace(1, *sample(rng))
    again = Window.from_state(window.config, window.state_dict())
    twin = window.copy()
    for _ in range(5):
        point = sample(rng)
        for w in (window, again, twin):
            w.replace(2, *point)
    np.testing.assert_array_equal(again.alpha, window.alpha)
    np.testing.assert_array_equal(twin.alpha, window.alpha)
    assert again.counters() == window.counters()


def test_a_copy_is_independent() -> None:
    window = filled("inverse", "compiled")
    alpha, twin = window.alpha, window.copy()
    twin.replace(0, *sample(np.random.default_rng(6)))
    np.testing.assert_array_equal(window.alpha, alpha)


def test_foreign_state_is_refused() -> None:
    state = filled("inverse", "compiled").state_dict()
    with pytest.raises(InputError, match="expected an array"):
        Window.from_state(WindowConfig(CAPACITY + 1, WIDTHS, GAMMA), state)
    del state["R"]
    with pytest.raises(InputError, match="R: got nothing"):
        Window.from_state(WindowConfig(CAPACITY, WIDTHS, GAMMA), state)


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
    window = filled("inverse", "compiled")
    true = np.linalg.cond(window.arrays.R)
    assert 0.99 * true <= window.condition() <= 3 * true


def test_inputs_are_not_changed() -> None:
    window = filled("inverse", "compiled")
    x = np.array([0.1, 0.2, 0.3])
    window.replace(0, x, 1.0)
    window.predict_with_variance(x)
    np.testing.assert_array_equal(x, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"capacity": 0}, "capacity"),
        ({"widths": ()}, "widths"),
        ({"widths": (1.0, -1.0)}, "widths"),
        ({"gamma": -1.0}, "gamma"),
        ({"linear": (7,)}, "linear"),
        ({"form": "lu"}, "form"),
        ({"backend": "gpu"}, "backend"),
        ({"form": "cholesky", "backend": "plain"}, "plain"),
        ({"accuracy": 0.0}, "accuracy"),
    ],
)
def test_bad_configuration(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        WindowConfig(**{"capacity": 5, "widths": (1.0, 1.0), "gamma": 10.0, **change})  # type: ignore[arg-type]


def test_shapes_are_checked() -> None:
    window = filled("inverse", "compiled")
    with pytest.raises(InputError, match="x: got shape"):
        window.predict(np.zeros(2))
    with pytest.raises(InputError, match="capacity"):
        Window.from_samples(window.config, np.zeros((CAPACITY + 1, 3)), np.zeros(CAPACITY + 1))


def test_singular_samples_leave_the_window_as_it_was() -> None:
    window = filled("inverse", "compiled", n=6)
    alpha, R = window.alpha, window.arrays.R[0, 1]
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = 50.0
    with pytest.raises(NumericsError, match="pivot"):
        window.rebuild()
    window.arrays.R[0, 1] = window.arrays.R[1, 0] = R
    np.testing.assert_array_equal(window.alpha, alpha)
    assert_exact(window)


@kinds
def test_a_state_without_what_was_added_since_goes_on(form: Form, backend: Backend) -> None:
    """As an older version wrote it: no diagonal, no place of the sample that was replaced, hence nothing to undo."""
    window, rng = filled(form, backend, (1,)), np.random.default_rng(6)
    window.replace(1, *sample(rng))
    state = window.state_dict()
    state |= {"V": state["V"][: ws.DIAGONAL], "C": state["C"][: ws.UNDO_PLACE]}
    again = Window.from_state(window.config, state)
    assert again.undo() is Status.NOTHING_TO_UNDO
    point = sample(rng)
    for w in (window, again):
        assert w.replace(2, *point) is Status.ACCEPTED
    np.testing.assert_array_equal(again.alpha, window.alpha)
    assert_exact(again)
