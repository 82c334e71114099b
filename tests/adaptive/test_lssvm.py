"""The kernel and the least-squares support vector machine."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive import features, lssvm
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.types import FloatArray

# --- The direct solver: the dual system itself, the published reference, leave-one-out and variance by definition.

DATA = Path(os.environ.get("DEHYST_DATA", Path(__file__).parents[3] / "shared" / "data")) / "lssvm-reference"
needs_reference = pytest.mark.skipif(not DATA.is_dir(), reason=f"reference values not found at {DATA}; set DEHYST_DATA")


def samples(n: int = 40, d: int = 3, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    X = rng.random((n, d))
    return X, np.sin(4 * X[:, 0]) + X[:, 1] ** 2 + 0.01 * rng.standard_normal(n)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(6, 30), seed=st.integers(0, 1000))
def test_solves_the_dual_system(n: int, seed: int) -> None:
    X, y = samples(n, 3, seed)
    model = lssvm.fit(X, y, (0.3, 0.8, 2.0), 50.0).model
    R = features.gram(X, None, model.widths) + np.eye(n) / 50.0
    np.testing.assert_allclose(R @ model.alpha + model.bias, y, atol=1e-10)
    assert np.sum(model.alpha) == pytest.approx(0.0, abs=1e-8)


@needs_reference
def test_reference_values() -> None:
    table = np.genfromtxt(DATA / "bw500.csv", delimiter=",", names=True)
    X, y = np.column_stack([table["u_n"], table["udot_n"]]), table["y_n"]
    expected = np.loadtxt(DATA / "alpha_g741_s0.4.csv")
    model = lssvm.fit(X, y, 0.4, 741.0).model
    assert model.bias == pytest.approx(0.565132736966343, rel=1e-11)
    assert np.linalg.norm(model.alpha) == pytest.approx(140.602836292536, rel=1e-11)
    np.testing.assert_allclose(model.alpha, expected[1:], atol=1e-8)
    assert np.sqrt(np.mean((model.predict(X) - y) ** 2)) == pytest.approx(0.00848576247717489, rel=1e-10)


def test_leave_one_out_is_what_it_says() -> None:
    X, y = samples()
    fit = lssvm.fit(X, y, 0.7, 200.0)
    for i in (0, 17, 39):
        others = np.arange(y.size) != i
        without = lssvm.fit(X[others], y[others], 0.7, 200.0).model
        assert fit.leave_one_out()[i] == pytest.approx(y[i] - without.predict(X[i : i + 1])[0], rel=1e-7)


def test_inputs_are_not_changed() -> None:
    X, y = samples()
    kept = X.copy(), y.copy()
    lssvm.fit(X, y, 0.5, 100.0)
    np.testing.assert_array_equal(X, kept[0])
    np.testing.assert_array_equal(y, kept[1])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"y": np.ones(3)}, "X, y"),
        ({"X": np.full((40, 3), np.nan)}, "finite"),
        ({"gamma": 0.0}, "gamma"),
        ({"gamma": np.nan}, "gamma"),
        ({"widths": -1.0}, "widths"),
    ],
)
def test_bad_input_names_the_field(change: dict[str, object], field: str) -> None:
    X, y = samples()
    arguments: dict[str, object] = {"X": X, "y": y, "widths": 0.5, "gamma": 10.0, **change}
    with pytest.raises(InputError, match=field):
        lssvm.fit(**arguments)  # type: ignore[arg-type]


def test_singular_systems_are_refused() -> None:
    X, y = samples()
    with pytest.raises(NumericsError, match="kernel matrix"):
        lssvm.fit(np.ones_like(X), y, 0.5, 1e18)


# --- The kernel: its definition, its column against its Gram matrix, its own exponential.


def test_one_pair_by_hand() -> None:
    x, other, widths = np.array([1.0, 2.0]), np.array([1.5, 1.0]), np.array([0.5, 2.0])
    # (0.5/0.5)² + (1/2)² = 1.25
    assert features.gram(x[None], other[None], widths)[0, 0] == pytest.approx(np.exp(-1.25), rel=1e-15)


def test_column_and_gram_are_made_of_pairs() -> None:
    rng = np.random.default_rng(1)
    X, other, widths = rng.random((7, 3)), rng.random((4, 3)), np.array([0.3, 1.0, 5.0])
    K = features.gram(X, other, widths)
    pairs = [[np.exp(-np.sum(((a - b) / widths) ** 2)) for b in other] for a in X]
    np.testing.assert_allclose(K, pairs, rtol=1e-14)
    np.testing.assert_allclose(features.column(X, other[2], widths), K[:, 2], rtol=1e-14)


@pytest.mark.parametrize(("n", "m"), [(0, 3), (3, 0), (70, 1000), (65, 512), (2, 40_000)])
def test_gram_is_the_same_however_it_is_cut_into_blocks(n: int, m: int) -> None:
    rng = np.random.default_rng(2)
    X, other, widths = rng.random((n, 3)), rng.random((m, 3)), np.array([0.3, 1.0, 5.0])
    whole = np.zeros((n, m))
    for j in range(3):
        whole += ((X[:, j, None] - other[None, :, j]) / widths[j]) ** 2
    np.testing.assert_array_equal(features.gram(X, other, widths), np.exp(-whole))


def test_gram_keeps_the_digits_of_near_duplicates() -> None:
    X = np.array([[1e3, 1.0], [1e3 + 1e-9, 1.0]])
    distance = X[1, 0] - X[0, 0]
    K = features.gram(X, None, np.array([1e-6, 1.0]))
    assert 1.0 - K[0, 1] == pytest.approx((distance / 1e-6) ** 2, rel=1e-6)


def test_exponential_to_two_units_in_the_last_place() -> None:
    rng = np.random.default_rng(2)
    t = -np.concatenate([np.abs(rng.standard_normal(20000)) * np.logspace(-8, 2.5, 20000), [0.0, 707.9]])
    t = t[t > -708.0]
    got = t.copy()
    features.exp_negative(got, np.empty_like(got))
    assert np.max(np.abs(got - np.exp(t)) / np.spacing(np.exp(t))) <= 2.0


def test_exponential_at_its_ends() -> None:
    t = np.array([-709.0, -1e300, -np.inf, np.nan, -0.0])
    features.exp_negative(t, np.empty_like(t))
    np.testing.assert_array_equal(t, [0.0, 0.0, 0.0, np.nan, 1.0])


@settings(max_examples=50, deadline=None)
@given(count=st.integers(1, 40), dimension=st.integers(1, 6), seed=st.integers(0, 1000))
def test_compiled_column_is_the_column(count: int, dimension: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, x, widths = rng.random((count, dimension)), rng.random(dimension), rng.random(dimension) + 0.1
    out = np.full(count + 2, 7.0)
    features.rbf_column(np.ascontiguousarray((X / widths).T), count, x / widths, out, np.empty(count + 2))
    np.testing.assert_allclose(out[:count], features.column(X, x, widths), rtol=1e-12, atol=1e-300)
    np.testing.assert_array_equal(out[count:], 7.0)


@pytest.mark.parametrize("widths", [0.0, -1.0, np.inf, [1.0, 2.0, 3.0], [1.0, np.nan]])
def test_bad_widths_are_refused(widths: object) -> None:
    with pytest.raises(InputError, match="widths"):
        features.as_widths(widths, 2)


@pytest.mark.parametrize("n", [0, 1, 3, 4, 7, 500])
def test_a_column_is_weighed_as_a_sum_and_its_largest(n: int) -> None:
    rng = np.random.default_rng(n)
    k, alpha = rng.random(n), rng.standard_normal(n)
    total, largest = features.weigh(k, alpha)
    assert total == pytest.approx(float(alpha @ k), abs=1e-12)
    assert largest == max(k.tolist(), default=0.0)
    for j in range(n):  # wherever it is
        k[j] += 2.0
        assert features.weigh(k, alpha)[1] == k[j]
        k[j] -= 2.0
