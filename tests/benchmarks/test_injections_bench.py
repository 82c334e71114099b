"""The benchmark of injections: what it calls right, and that an effect has the size that is said."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.injections import Answer, judge
from tests.foreign.inject import ACCEPTED, beyond, inject

BOW = Answer("effects", [["asymmetry", "sensor_nonlinearity"]], [{"bend": 0.1}], [{"bend": (0.0, 0.2)}])


def _with(name: str, low: float, high: float) -> Answer:
    return Answer("effects", [*BOW.names, [name]], [*BOW.numbers, {}], [*BOW.intervals, {"gain": (low, high)}])


def test_right_is_what_names_the_effect_and_changes_no_other_name() -> None:
    def judged(before: Answer, after: Answer) -> tuple[bool, bool, bool | None]:
        case = judge("a record", "gain_drift", {"gain": 0.05}, 5.0, before, after)
        assert case is not None
        return case.named, case.others, case.covers

    assert judged(BOW, _with("gain_drift", 0.04, 0.06)) == (True, True, True)
    assert judged(BOW, _with("gain_drift", 0.01, 0.02)) == (True, True, False)
    assert judged(BOW, BOW) == (False, True, None)
    assert judged(BOW, _with("creep", 0.04, 0.06)) == (False, False, None)
    assert judged(_with("creep", 0.0, 1.0), _with("gain_drift", 0.04, 0.06)) == (True, False, True)
    # The untouched record drifts by itself: the sum must be held.
    drifts = Answer("effects", [["gain_drift"]], [{"gain": 0.1}], [{"gain": (0.09, 0.11)}])
    both = Answer("effects", [["gain_drift"]], [{"gain": 0.15}], [{"gain": (0.14, 0.16)}])
    assert judged(drifts, both) == (True, True, True)
    assert judged(drifts, drifts) == (False, True, False)


@pytest.mark.parametrize("cause", [c for c in ACCEPTED if c not in ("slips", "clock", "amplifier_lag")])
def test_each_effect_changes_the_readings_beyond_a_gain(cause: str) -> None:
    t = np.arange(4000) * 0.005
    u = 1.0 - np.cos(2.0 * np.pi * t)
    y = 10.0 * u - 2.0 * np.sin(2.0 * np.pi * t)
    moved_V, moved_um, numbers = inject(0.005, u, y, cause, np.random.default_rng(0))
    assert moved_V is u
    assert moved_um.shape == y.shape
    assert numbers
    assert 1e-3 < beyond(y, moved_um) < 10.0


def test_lost_samples_leave_the_voltage_and_shorten_the_record() -> None:
    u = np.sin(0.05 * np.arange(2000))
    y = np.arange(2000.0)
    moved_V, moved_um, numbers = inject(0.001, u, y, "slips", np.random.default_rng(1))
    lost = round(numbers["lost_samples"])
    assert moved_um.size == moved_V.size == 2000 - lost
    np.testing.assert_array_equal(moved_V, u[: moved_um.size])
    assert moved_um[-1] - moved_um[0] == 1999.0
