"""Min-max normalisation and its inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive.errors import InputError
from sim.chapter.forward_lssvm import MinMaxScaling


def test_range_maps_to_zero_and_one() -> None:
    data = np.array([[1.0, -5.0], [3.0, 5.0], [2.0, 0.0]])
    np.testing.assert_array_equal(MinMaxScaling.fit(data).normalise(data), [[0, 0], [1, 1], [0.5, 0.5]])


def test_margin_widens_both_ways() -> None:
    scaling = MinMaxScaling.fit(np.array([0.0, 10.0]), margin=0.1)
    assert (scaling.low[0], scaling.high[0]) == (-1.0, 11.0)


@given(seed=st.integers(0, 10_000), shape=st.sampled_from([(3,), (5, 3), (1, 3)]))
def test_inverse(seed: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    scaling = MinMaxScaling(np.array([-1.0, 0.0, 100.0]), np.array([1.0, 1e-3, 1e5]))
    x = rng.standard_normal(shape) * 50
    back = scaling.denormalise(scaling.normalise(x))
    np.testing.assert_allclose(back, x, rtol=1e-12, atol=1e-9)
    assert back.shape == x.shape


def test_one_column_takes_vectors() -> None:
    scaling = MinMaxScaling.fit(np.array([0.0, 4.0]))
    np.testing.assert_array_equal(scaling.normalise(np.array([0.0, 1.0, 2.0])), [0, 0.25, 0.5])
    np.testing.assert_array_equal(scaling.normalise(np.array([[1.0], [2.0]])), [[0.25], [0.5]])


def test_state_round_trip() -> None:
    scaling = MinMaxScaling.fit(np.random.default_rng(0).random((10, 2)))
    again = MinMaxScaling.from_state(scaling.state_dict())
    np.testing.assert_array_equal(again.low, scaling.low)
    np.testing.assert_array_equal(again.high, scaling.high)


@pytest.mark.parametrize("data", [np.array([[1.0, 2.0], [1.0, 3.0]]), np.empty((0, 2)), np.array([[np.nan], [1.0]])])
def test_data_that_cannot_be_scaled(data: np.ndarray) -> None:
    with pytest.raises(InputError):
        MinMaxScaling.fit(data)


def test_wrong_number_of_columns() -> None:
    with pytest.raises(InputError, match="columns"):
        MinMaxScaling.fit(np.random.default_rng(0).random((4, 2))).normalise(np.zeros((5, 3)))
