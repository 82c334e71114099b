"""Voltages and the demo's reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.sim.signals.references import DemoReference, demo_reference
from dehyst.sim.signals.voltages import (
    generalisation_input,
    growing_triangles,
    minor_loops,
    multitone,
    sample_times,
    sine,
    training_input,
    triangle,
)


def test_chapters_inputs() -> None:
    t, u = training_input()
    assert t.size == u.size == 500
    assert t[-1] == pytest.approx(9.98)
    k = 123
    expected = 5 * np.exp(-0.11 * t[k]) * (np.sin(6 * np.pi * t[k] * np.exp(-0.345 * t[k]) - 1.55) + 1)
    assert training_input(amplitude_V=5.0)[1][k] == pytest.approx(expected, rel=1e-12)
    # the thresholds of Table 2.2 belong to this peak
    assert training_input(1e-4)[1].max() == pytest.approx(7.2434 * 13 / 12, abs=0.01)
    t, u = generalisation_input(amplitude_V=5.0)
    expected = 5 * np.exp(-0.14 * t[k]) * (np.cos(3 * np.pi * t[k] * np.exp(-0.092 * t[k]) - 3.15) + 1)
    assert u[k] == pytest.approx(expected, rel=1e-12)
    assert u.min() >= 0.0


def test_shapes() -> None:
    _, u = growing_triangles(amplitudes_V=(1.0, 2.0), rate_V_per_s=10.0)
    assert u.max() == pytest.approx(2.0)
    assert np.abs(np.diff(u)).max() == pytest.approx(0.01)
    for _, wave in (triangle(1.0, 5.0, 2.0, 3.0), sine(1.0, 5.0, 2.0, 3.0)):
        assert (wave.size, wave[0], wave.max()) == (1500, 1.0, pytest.approx(5.0))
    _, u = minor_loops(loops=3)
    turns = np.count_nonzero(np.diff(np.sign(np.diff(u))))
    assert turns == 4 * 3 + 1
    _, a = multitone(5.0, seed=1)
    _, b = multitone(5.0, seed=1)
    assert np.array_equal(a, b)
    assert a.min() >= 0.5
    assert a.max() <= 7.5


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**31), low=st.floats(-10.0, 10.0), span=st.floats(1.0, 100.0))
def test_reference_is_consistent_and_stays_in_range(seed: int, low: float, span: float) -> None:
    dt = 2e-4
    r = demo_reference(12.0, dt, (low, low + span), seed)
    assert r.y_um.min() >= low
    assert r.y_um.max() <= low + span
    # integrals of the derivatives give the values back: trapezium, error of order dt²
    v = np.cumsum(0.5 * (r.a_um_per_s2[1:] + r.a_um_per_s2[:-1])) * dt
    y = np.cumsum(0.5 * (r.v_um_per_s[1:] + r.v_um_per_s[:-1])) * dt
    np.testing.assert_allclose(v, r.v_um_per_s[1:] - r.v_um_per_s[0], atol=3e-3 * span)
    np.testing.assert_allclose(y, r.y_um[1:] - r.y_um[0], atol=3e-5 * span)
    # the acceleration has no jumps
    assert np.abs(np.diff(r.a_um_per_s2)).max() < 0.2 * np.abs(r.a_um_per_s2).max()


def test_reference_is_the_same_in_pieces() -> None:
    plan = DemoReference(20.0, 5.0, 80.0, seed=2)
    t = sample_times(20.0, 1e-3)
    whole = plan.at(t)
    pieces = np.concatenate([plan.at(t[a:b]).y_um for a, b in ((0, 1), (1, 777), (777, 15000), (15000, 20000))])
    np.testing.assert_allclose(pieces, whole.y_um, rtol=0.0, atol=1e-12)
    assert not np.array_equal(whole.y_um, DemoReference(20.0, 5.0, 80.0, seed=3).at(t).y_um)
    kinds = {p.kind for p in plan.parts}
    assert {"tones", "loops", "hold", "sine"} <= kinds


def test_reference_refuses_nonsense() -> None:
    with pytest.raises(InputError, match="range_um"):
        demo_reference(1.0, 1e-3, (5.0, 5.0))
    with pytest.raises(InputError, match="duration_s"):
        demo_reference(-1.0)
