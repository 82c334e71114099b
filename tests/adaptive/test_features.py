"""Memory operators have the properties that hysteresis has, and the frame hides a change of gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.state import load, save

MAP = FeatureMap(
    dt_s=1e-3,
    y_min_um=0.0,
    y_max_um=80.0,
    v_scale_um_per_s=1000.0,
    a_scale_um_per_s2=1e5,
    thresholds_um=(1.0, 5.0, 20.0),
    arc_lengths_um=(10.0,),
    time_constants_s=(0.1, 10.0),
    kernel_plays=(0, 2),
    asymmetric=True,
)
paths = st.lists(st.floats(0, 80), min_size=2, max_size=30)


def walk(path: list[float], memory: np.ndarray | None = None, m: FeatureMap = MAP) -> np.ndarray:
    memory = m.rest_memory(0.0) if memory is None else memory.copy()
    for y in path:
        m.advance(y, memory)
    return memory


def test_plays_on_a_walk_up_and_down() -> None:
    up = walk([0.0, 30.0])
    np.testing.assert_array_equal(up[:3], [29.0, 25.0, 10.0])
    down = walk([28.5], up)
    np.testing.assert_array_equal(down[:3], [29.0, 25.0, 10.0])
    down = walk([10.0], up)
    np.testing.assert_array_equal(down[:3], [11.0, 15.0, 10.0])


@settings(max_examples=50, deadline=None)
@given(paths)
def test_plays_stay_within_their_threshold_and_wipe_out(path: list[float]) -> None:
    memory = walk(path)
    assert np.all(np.abs(path[-1] - memory[:3]) <= np.array([1.0, 5.0, 20.0]) + 1e-9)
    # A larger excursion wipes out all that was before it.
    np.testing.assert_allclose(walk([*path, -100.0, 200.0, 40.0])[:3], walk([-100.0, 200.0, 40.0])[:3])


@settings(max_examples=50, deadline=None)
@given(paths, st.integers(2, 5))
def test_plays_and_arcs_do_not_depend_on_rate(path: list[float], times: int) -> None:
    fine = [a + (b - a) * k / times for a, b in zip([0.0, *path], path, strict=False) for k in range(1, times + 1)]
    np.testing.assert_allclose(walk(fine)[:3], walk(path)[:3], atol=1e-9)
    # An arc state relaxes over the path in closed form only along small steps; its value must agree there.
    finer = [a + (b - a) * k / 400 for a, b in zip([0.0, *path], path, strict=False) for k in range(1, 401)]
    finest = [a + (b - a) * k / 800 for a, b in zip([0.0, *path], path, strict=False) for k in range(1, 801)]
    assert walk(finer)[3] == pytest.approx(walk(finest)[3], abs=0.1)


def test_slow_states_relax_with_their_time_constant() -> None:
    memory = walk([0.0])
    memory = walk([10.0] * 100, memory)
    assert memory[4] == pytest.approx(10 * (1 - np.exp(-1.0)))
    assert memory[5] == pytest.approx(10 * (1 - np.exp(-0.01)))


def test_run_equals_steps_and_changes_no_input() -> None:
    t = np.arange(200) * 1e-3
    y, v, a = 40 + 30 * np.sin(20 * t), 600 * np.cos(20 * t), -12000 * np.sin(20 * t)
    memory = MAP.rest_memory(40.0)
    kept = [x.copy() for x in (y, v, a, memory)]
    basis, kernel, after = MAP.run(y, v, a, memory)
    for x, old in zip((y, v, a, memory), kept, strict=True):
        np.testing.assert_array_equal(x, old)
    step = memory.copy()
    one, two = np.empty(MAP.basis_size), np.empty(MAP.kernel_size)
    for i in range(200):
        MAP.advance(y[i], step)
        MAP.fill(y[i], v[i], a[i], step, one, two)
        np.testing.assert_array_equal(one, basis[i])
        np.testing.assert_array_equal(two, kernel[i])
    np.testing.assert_array_equal(step, after)


def test_columns_are_normalised_and_counted() -> None:
    t = np.arange(3000) * 1e-3
    w = 2 * np.pi
    basis, kernel, _ = MAP.run(
        40 + 40 * np.sin(w * t), 40 * w * np.cos(w * t), -40 * w * w * np.sin(w * t), MAP.rest_memory(0)
    )
    assert basis.shape == (3000, MAP.basis_size) == (3000, 6 + 3 + 3 + 1 + 2)
    assert kernel.shape == (3000, MAP.kernel_size) == (3000, 4)
    assert np.all(np.abs(kernel) <= 1 + 1e-9)
    assert np.all(basis[:, 0] == 1)
    assert np.abs(basis).max() < 2


@settings(max_examples=30, deadline=None)
@given(paths, st.floats(0.8, 1.2), st.floats(-5, 5))
def test_frame_hides_gain_and_offset(path: list[float], gain: float, offset: float) -> None:
    framed = replace(MAP, gain=gain, offset_um=offset)
    there = [gain * y + offset for y in path]
    mine, other = walk(path), walk(there, MAP.rest_memory(0.0), framed)
    np.testing.assert_allclose(mine, other, atol=1e-9)
    rows = [np.empty(MAP.basis_size), np.empty(MAP.kernel_size)], [np.empty(MAP.basis_size), np.empty(MAP.kernel_size)]
    MAP.fill(path[-1], 100.0, 5.0, mine, *rows[0])
    framed.fill(there[-1], 100.0 * gain, 5.0 * gain, other, *rows[1])
    np.testing.assert_allclose(rows[0][0], rows[1][0], atol=1e-9)
    np.testing.assert_allclose(rows[0][1], rows[1][1], atol=1e-9)


def test_noise_at_rest_is_no_path_behind_the_dead_band() -> None:
    """Arcs stay where the noise-free ones stay; without a dead band, noise relaxes them away. A stroke moves both."""
    dead = replace(MAP, dead_um=0.04)
    noise = 30.0 + 0.01 * np.random.default_rng(0).standard_normal(5000)
    start = MAP.rest_memory(30.0)
    still, noisy, relaxed = walk([30.0] * 5000, start, dead), walk([*noise], start, dead), walk([*noise], start)
    assert abs(noisy[3] - still[3]) < 0.05
    assert abs(relaxed[3] - 30.0) < 0.1 < abs(noisy[3] - 30.0)
    moved = walk([*np.linspace(30.0, 50.0, 50)], start, dead)
    np.testing.assert_allclose(moved[3], walk([*np.linspace(30.0, 50.0, 50)], start)[3], atol=0.05)


def test_rest_memory_is_one_stroke_and_settled() -> None:
    memory = MAP.rest_memory(30.0)
    np.testing.assert_allclose(memory[:3], [29.0, 25.0, 10.0])
    np.testing.assert_allclose(memory[4:], 30.0)


def test_two_inputs_have_no_memory() -> None:
    two = FeatureMap(1e-3, 0.0, 80.0, 1000.0, 1.0, linear=False)
    assert (two.memory_size, two.basis_size, two.kernel_size) == (0, 1, 2)
    basis, kernel, _ = two.run(np.array([40.0]), np.array([500.0]), np.zeros(1), two.rest_memory(0.0))
    np.testing.assert_allclose(basis, [[1.0]])
    np.testing.assert_allclose(kernel, [[0.0, 0.5]])


def test_state_round_trip() -> None:
    framed = replace(MAP, gain=0.94, offset_um=1.5, dead_um=0.02)
    assert load(FeatureMap, save(framed)) == framed


@pytest.mark.parametrize(
    "bad",
    [
        {"dt_s": -1.0},
        {"y_min_um": 90.0},
        {"thresholds_um": (2.0, 1.0)},
        {"time_constants_s": (0.0,)},
        {"kernel_plays": (7,)},
        {"gain": 0.0},
        {"dead_um": -0.1},
    ],
)
def test_bad_configuration_is_named(bad: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(bad))):
        replace(MAP, **bad)  # type: ignore[arg-type]


@settings(max_examples=50, deadline=None)
@given(paths, st.floats(0.7, 1.4), st.floats(-20.0, 20.0))
def test_a_memory_in_another_frame_is_of_the_same_readings(path: list[float], gain: float, offset_um: float) -> None:
    """Every entry is a displacement."""
    other = replace(MAP, gain=gain, offset_um=offset_um)
    memory = walk(path)
    there = MAP.memory_in(other, memory)
    np.testing.assert_allclose(there, (memory - offset_um) / gain)
    np.testing.assert_allclose(other.memory_in(MAP, there), memory, atol=1e-9)
    assert there is not memory
    assert MAP.memory_in(MAP, memory) is not memory
