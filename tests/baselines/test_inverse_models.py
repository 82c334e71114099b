"""What every served baseline must do: purity, memory that travels, domain, storage, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters

SEEN = Domain(0.0, 88.0, 2000.0)
MPI = MpiParameters((0.0, 0.5, 1.5), (8.0, 1.5, 1.0), (0.0, 30.0), (1.0, -0.1), c_um=0.4, y_ref_um=-3.0, lag_s=1e-3)
MODELS: list[LinearInverse | MpiInverse | BoucWenInverse] = [
    LinearInverse(LinearParameters(11.0, -2.0), 1e-3, SEEN, 0.2),
    MpiInverse(MPI, 1e-3, SEEN, 0.05),
    BoucWenInverse(TABLE_2_1, 1e-3, SEEN, 0.02),
]
every = pytest.mark.parametrize("model", MODELS, ids=lambda model: str(model.name))

t = np.arange(400) * 1e-3
Y = 40 - 30 * np.cos(2 * np.pi * 4 * t) * np.exp(-2 * t)
V = np.gradient(Y, 1e-3)
A = np.gradient(V, 1e-3)


@every
def test_cutting_a_trajectory_changes_nothing(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    memory = model.rest_memory(10.0)
    inputs = [array.copy() for array in (Y, V, A, memory)]
    whole = model.feedforward(Y, V, A, memory)
    for array, before in zip((Y, V, A, memory), inputs, strict=True):
        np.testing.assert_array_equal(array, before)
    parts, carried = [], memory
    for k in range(0, Y.size, 7):
        part = model.feedforward(Y[k : k + 7], V[k : k + 7], A[k : k + 7], carried)
        parts.append(part.u_V)
        carried = part.memory
    np.testing.assert_allclose(np.concatenate(parts), whole.u_V, atol=1e-11)
    np.testing.assert_allclose(carried, whole.memory, atol=1e-11)
    again = model.feedforward(Y, V, A, memory)
    np.testing.assert_array_equal(again.u_V, whole.u_V)


@every
def test_track_over_own_voltages_meets_the_feedforward(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    memory = model.rest_memory(10.0)
    answer = model.feedforward(Y, V, A, memory)
    np.testing.assert_allclose(model.track(Y, V, A, answer.u_V, memory), answer.memory, atol=1e-11)


@every
def test_rest_memory_goes_on_without_a_step(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    zero = np.zeros(1)
    first = model.feedforward(np.array([25.0]), zero, zero, model.rest_memory(25.0)).u_V[0]
    way = np.linspace(0.0, 25.0, 50)
    rest = np.zeros(50)
    slow = model.feedforward(way, rest, rest, model.rest_memory(0.0)).u_V[-1]
    assert first == pytest.approx(slow, abs=1e-9)


@every
def test_inside_is_the_identified_range(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    y, v = np.array([-1.0, 10.0, 50.0, 95.0]), np.array([0.0, 0.0, 5000.0, 0.0])
    answer = model.feedforward(y, v, np.zeros(4), model.rest_memory(5.0))
    expected = [False, True, model.name == "linear", False]
    assert answer.inside.tolist() == expected
    np.testing.assert_array_equal(answer.std_V, np.full(4, model.voltage_std_V))


@every
def test_storage_round_trip(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    state = model.state_dict()
    assert all(isinstance(value, (np.ndarray, float, int, str)) for value in state.values())
    again = type(model).from_state(state)
    assert again == model
    memory = model.rest_memory(10.0)
    np.testing.assert_array_equal(again.feedforward(Y, V, A, memory).u_V, model.feedforward(Y, V, A, memory).u_V)
    for name in state:
        if name != "name":
            with pytest.raises(ModelFileError, match=name):
                type(model).from_state({key: value for key, value in state.items() if key != name})


@every
@pytest.mark.parametrize("std_V", [-0.01, np.inf])
def test_a_deviation_that_is_none_is_refused(model: LinearInverse | MpiInverse | BoucWenInverse, std_V: float) -> None:
    with pytest.raises(ModelFileError, match=f"voltage_std_V: got {std_V}, expected"):
        type(model).from_state(model.state_dict() | {"voltage_std_V": std_V})
    none = replace(model, voltage_std_V=np.nan)
    assert np.isnan(none.feedforward(Y, V, A, none.rest_memory(10.0)).std_V).all()


@every
def test_bad_shapes_are_refused_by_name(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    memory, two, three = model.rest_memory(5.0), np.zeros(2), np.zeros(3)
    with pytest.raises(InputError, match="v_um_per_s"):
        model.feedforward(two, three, two, memory)
    with pytest.raises(InputError, match="a_um_per_s2"):
        model.feedforward(two, two, three, memory)
    with pytest.raises(InputError, match="y_um"):
        model.feedforward(np.zeros((2, 2)), two, two, memory)
    with pytest.raises(InputError, match="memory"):
        model.feedforward(two, two, two, np.zeros(model.memory_size + 1))
    if model.memory_size:
        with pytest.raises(InputError, match="memory"):
            model.feedforward(two, two, two, np.full(model.memory_size, np.nan))
        with pytest.raises(InputError, match="u_V"):
            model.track(two, two, two, three, memory)


@every
def test_nan_points_are_marked_and_forgotten(model: LinearInverse | MpiInverse | BoucWenInverse) -> None:
    memory, zero = model.rest_memory(10.0), np.zeros(3)
    bad = model.feedforward(np.array([11.0, np.nan, 12.0]), zero, zero, memory)
    good = model.feedforward(np.array([11.0, 12.0]), zero[:2], zero[:2], memory)
    assert np.isnan(bad.u_V[1])
    assert not bad.inside[1]
    np.testing.assert_allclose(bad.u_V[[0, 2]], good.u_V, atol=1e-12)
