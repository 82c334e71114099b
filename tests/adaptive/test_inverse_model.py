"""The served inverse is pure, immutable, fast, and equals its formula."""

from __future__ import annotations

import math
import time
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.features import gram
from dehyst.adaptive.inverse_model import DOMAIN_MARGIN, LssvmInverse
from dehyst.adaptive.types import InverseModel


def points(n: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t, w = np.arange(n) * 1e-3, 2 * np.pi * 4
    return 40 + 25 * np.sin(w * t), 25 * w * np.cos(w * t), -25 * w * w * np.sin(w * t)


def test_is_an_inverse_model(model: LssvmInverse) -> None:
    assert isinstance(model, InverseModel)
    assert model.memory_size == model.rest_memory(10.0).size


def test_equals_its_formula(model: LssvmInverse) -> None:
    y, v, a = points()
    spread = 1e-4 * np.eye(model.features.basis_size) + 1e-5
    for one in (
        model,
        replace(model, beta_covariance=spread),
        replace(model, support=model.support[:0], alpha=model.alpha[:0]),
        replace(model, beta_covariance=spread, anchor=1.1 * model.beta, allowed_V=0.05),
    ):
        basis, kernel, after = one.features.run(y, v, a, one.rest_memory(40.0))
        column = gram(kernel, one.support, one.widths)
        mean = basis @ one.beta + column @ one.alpha
        if one.anchor.size:
            mean = np.clip(mean, basis @ one.anchor - one.allowed_V, basis @ one.anchor + one.allowed_V)
        variance = np.full(y.size, one.noise_variance)
        if one.beta_covariance.size:
            variance += np.sum(basis @ one.beta_covariance * basis, axis=1)
        nearest = column.max(axis=1, initial=0.0)
        variance += one.kernel_variance * (1.0 - nearest**2 / (1.0 + 1.0 / one.gamma))
        low, high = one.domain[::2], one.domain[1::2]
        margin, motion = DOMAIN_MARGIN * (high - low), np.column_stack([y, v, a])
        answer = one.feedforward(y, v, a, one.rest_memory(40.0))
        np.testing.assert_allclose(answer.u_V, mean, atol=1e-10)
        np.testing.assert_allclose(answer.std_V, np.sqrt(np.maximum(variance, 0.0)), atol=1e-9)
        np.testing.assert_array_equal(
            answer.inside, np.all((low - margin <= motion) & (motion <= high + margin), axis=1)
        )
        np.testing.assert_array_equal(answer.memory, after)


def test_no_answer_leaves_what_was_identified_by_more_than_is_allowed(model: LssvmInverse) -> None:
    """Whatever the learnt coefficients are; within the bound nothing changes, to the last bit."""
    y, v, a = points()
    basis, _, _ = model.features.run(y, v, a, model.rest_memory(40.0))
    known = basis @ model.beta
    rng = np.random.default_rng(7)
    for size in (0.0, 1e-3, 1.0, 1e6):
        beta = model.beta + size * rng.standard_normal(model.beta.size)
        free = replace(model, beta=beta)
        held = replace(free, anchor=model.beta, allowed_V=0.3)
        u_V, free_V = (one.feedforward(y, v, a, model.rest_memory(40.0)).u_V for one in (held, free))
        assert np.max(np.abs(u_V - known)) <= 0.3 + 1e-9
        inside = np.abs(free_V - known) < 0.3 - 1e-9
        np.testing.assert_array_equal(u_V[inside], free_V[inside])
        again = LssvmInverse.from_state(held.state_dict())
        np.testing.assert_array_equal(again.feedforward(y, v, a, model.rest_memory(40.0)).u_V, u_V)


def test_a_point_by_itself_is_that_of_the_trajectory(model: LssvmInverse) -> None:
    y, v, a = points()
    whole, memory = model.feedforward(y, v, a, model.rest_memory(40.0)), model.rest_memory(40.0)
    answers = [model.evaluate_point(*map(float, point), memory) for point in zip(y, v, a, strict=True)]
    assert [tuple(answer) for answer in zip(whole.u_V, whole.std_V, whole.inside, strict=True)] == answers
    np.testing.assert_array_equal(memory, whole.memory)


def test_a_trajectory_in_pieces_is_the_same_to_the_last_bit(model: LssvmInverse) -> None:
    y, v, a = points()
    whole = model.feedforward(y, v, a, model.rest_memory(40.0))
    memory, pieces = model.rest_memory(40.0), []
    for part in (slice(0, 1), slice(1, 50), slice(50, 120)):
        answer = model.feedforward(y[part], v[part], a[part], memory)
        memory = answer.memory
        pieces.append(answer.u_V)
    np.testing.assert_array_equal(np.concatenate(pieces), whole.u_V)
    np.testing.assert_array_equal(memory, whole.memory)


def test_changes_no_input_and_cannot_be_changed(model: LssvmInverse) -> None:
    y, v, a = points()
    memory = model.rest_memory(40.0)
    kept = [x.copy() for x in (y, v, a, memory)]
    model.feedforward(y, v, a, memory)
    model.track(y, v, a, y, memory)
    for x, old in zip((y, v, a, memory), kept, strict=True):
        np.testing.assert_array_equal(x, old)
    with pytest.raises(FrozenInstanceError):
        model.gamma = 1.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        model.alpha[0] = 1.0


def test_track_and_feedforward_advance_the_memory_alike(model: LssvmInverse) -> None:
    y, v, a = points()
    memory = model.rest_memory(40.0)
    np.testing.assert_array_equal(model.track(y, v, a, y, memory), model.feedforward(y, v, a, memory).memory)


def test_outside_is_flagged_and_finite(model: LssvmInverse) -> None:
    y = np.array([40.0, 300.0, -200.0])
    answer = model.feedforward(y, np.zeros(3), np.zeros(3), model.rest_memory(40.0))
    assert answer.inside.tolist() == [True, False, False]
    assert np.all(np.isfinite(answer.u_V))
    assert answer.u_V[1] > answer.u_V[0] > answer.u_V[2]


def test_uncertainty_grows_away_from_samples(model: LssvmInverse) -> None:
    near, _, _ = (model.support[50, 0] * 40 + 43, 0, 0)
    answer = model.feedforward(np.array([near, 500.0]), np.zeros(2), np.zeros(2), model.rest_memory(near))
    assert 0 < answer.std_V[0] < answer.std_V[1]


def test_round_trip(model: LssvmInverse) -> None:
    other = LssvmInverse.from_state(model.state_dict())
    y, v, a = points()
    one, two = (m.feedforward(y, v, a, m.rest_memory(40.0)) for m in (model, other))
    np.testing.assert_array_equal(one.u_V, two.u_V)
    np.testing.assert_array_equal(one.std_V, two.std_V)
    assert other.features == model.features


def test_damaged_state_is_refused(model: LssvmInverse) -> None:
    state = model.state_dict()
    del state["alpha"]
    with pytest.raises(ModelFileError, match="alpha"):
        LssvmInverse.from_state(state)
    state = model.state_dict() | {"beta": np.zeros(3)}
    with pytest.raises(ModelFileError, match="beta"):
        LssvmInverse.from_state(state)


def test_bad_shapes_are_named(model: LssvmInverse) -> None:
    y, v, a = points()
    with pytest.raises(InputError, match="y_um"):
        model.feedforward(y, v[:5], a, model.rest_memory(0.0))
    with pytest.raises(InputError, match="memory"):
        model.feedforward(y, v, a, np.zeros(3))
    with pytest.raises(InputError, match="alpha"):
        replace(model, alpha=np.full(model.alpha.shape, np.nan))
    p = model.features.basis_size
    for value in (np.nan, np.inf):
        with pytest.raises(InputError, match="beta_covariance: got"):
            replace(model, beta_covariance=np.full((p, p), value))


@pytest.mark.parametrize("field", ["noise_variance", "kernel_variance", "gamma", "span_V"])
@pytest.mark.parametrize("value", [-1e-9, math.nan, math.inf, 0.0])
def test_a_model_that_could_not_state_a_deviation_is_refused(model: LssvmInverse, field: str, value: float) -> None:
    if value == 0.0 and field.endswith("variance"):
        told = replace(model, **{field: value}).feedforward(*points(), model.rest_memory(40.0))  # type: ignore[arg-type]
        assert np.isfinite(told.std_V).all()
        return
    with pytest.raises(InputError, match=f"{field}: got"):
        replace(model, **{field: value})  # type: ignore[arg-type]
    with pytest.raises(ModelFileError, match=f"{field}: got"):
        LssvmInverse.from_state(model.state_dict() | {field: value})


def test_one_point_takes_some_ten_microseconds(model: LssvmInverse) -> None:
    y, v, a = points(1)
    memory = model.rest_memory(40.0)
    best = np.inf
    for _ in range(200):
        start = time.perf_counter()
        model.feedforward(y, v, a, memory)
        best = min(best, time.perf_counter() - start)
    # Ten times what it takes on an idle machine.
    assert best < 200e-6
