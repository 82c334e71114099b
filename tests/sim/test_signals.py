"""Voltages and the demo's reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.signals.voltages import (
    generalisation_input,
    training_input,
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


def test_reference_refuses_nonsense() -> None:
    with pytest.raises(InputError, match="range_um"):
        demo_reference(1.0, 1e-3, (5.0, 5.0))
    with pytest.raises(InputError, match="duration_s"):
        demo_reference(-1.0)
