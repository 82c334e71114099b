"""The sliding window in both forms, against the direct solver and against itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive import lssvm
from adaptive.errors import InputError, NumericsError
from adaptive.window import arrays as ws
from adaptive.window.arrays import Status
from adaptive.window.config import Form, WindowConfig
from adaptive.window.window import Window
from tests.adaptive.window.windows import (
    CAPACITY,
    GAMMA,
    STEPS,
    WIDTHS,
    assert_exact,
    empty,
    filled,
    forms,
    sample,
)


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
    x, y, w = sample(np.random.default_rng(8))
    assert window.replace(slot, x, y, w) is Status.ACCEPTED
    np.testing.assert_array_equal(window.X[slot], x)
    assert (window.y[slot], window.weights[slot]) == (y, w)
    assert_exact(window)


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


@forms
@pytest.mark.parametrize("bad", BAD_SAMPLES)
def test_bad_samples_are_refused_and_counted(form: Form, bad: tuple[np.ndarray, float, float]) -> None:
    window = filled(form, n=CAPACITY - 1)
    alpha = window.alpha
    assert window.replace(3, *bad) is Status.BAD_INPUT
    assert window.append(*bad) is Status.BAD_INPUT
    np.testing.assert_array_equal(window.alpha, alpha)
    assert window.counters()["bad_inputs"] == 2


@forms
def test_slots_that_do_not_exist(form: Form) -> None:
    window = filled(form, n=5)
    x, y, w = sample(np.random.default_rng(1))
    for slot in (-1, 5, 1000):
        assert window.replace(slot, x, y, w) is Status.NO_SLOT
        assert window.reweight(slot, 1.0) is Status.NO_SLOT
    assert window.reweight(0, -1.0) is Status.BAD_INPUT
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
    made = Window.from_samples(grown.config, grown.X, grown.y, grown.weights)
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
    window = filled("inverse")
    alpha, twin = window.alpha, window.copy()
    twin.replace(0, *sample(np.random.default_rng(6)))
    np.testing.assert_array_equal(window.alpha, alpha)


def test_foreign_state_is_refused() -> None:
    state = filled("inverse").state_dict()
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


@forms
def test_a_state_without_what_was_added_since_goes_on(form: Form) -> None:
    """As an older version wrote it: without the diagonal and the position of the sample that was replaced."""
    window, rng = filled(form), np.random.default_rng(6)
    window.replace(1, *sample(rng))
    state = window.state_dict()
    state |= {"V": state["V"][: ws.DIAGONAL], "C": state["C"][: ws.UNDO_PLACE]}
    again = Window.from_state(window.config, state)
    point = sample(rng)
    for w in (window, again):
        assert w.replace(2, *point) is Status.ACCEPTED
    np.testing.assert_array_equal(again.alpha, window.alpha)
    assert_exact(again)
