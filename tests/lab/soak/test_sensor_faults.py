"""Faults that lie without being impossible: what the stage sends, and what the judge makes of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dehyst.lab.soak.observed import troubles_since
from dehyst.service.stage_node.faults import Fault, Injector

Y_UM = 40.0 + 10.0 * np.sin(0.05 * np.arange(400))


@pytest.mark.parametrize(
    ("kind", "shown"),
    [
        ("units", lambda u, y: (1e3 * u, 1e3 * y)),
        ("exchanged", lambda u, y: (y, u)),
        ("u_sign", lambda u, y: (-u, y)),
    ],
)
def test_a_message_that_says_something_else_does_so_for_the_fault_alone(kind: str, shown: Any) -> None:
    injector = Injector(1e-3, lambda _: None)
    injector.add(Fault(kind, 0.2))
    injector.reading(100, 0.0)
    seq = np.arange(90, 310)
    u_V, y_um = 0.1 * seq, Y_UM[seq]
    ((_, _, sent_V, sent_um),) = injector.deliver((seq, 1e-3 * seq, u_V, y_um))
    hit = (seq >= 100) & (seq < 300)
    for sent, sound, wrong in zip((sent_V, sent_um), (u_V, y_um), shown(u_V, y_um), strict=True):
        np.testing.assert_array_equal(sent, np.where(hit, wrong, sound))
    assert injector.counts[kind] == 200


def read(kind: str, value: float = 0.0) -> np.ndarray:
    """Readings of `Y_UM` with a fault from sample 100 to 300."""
    injector = Injector(1e-3, lambda _: None)
    read_um = []
    for k, y_um in enumerate(Y_UM.tolist()):
        if k == 100:
            injector.add(Fault(kind, 0.2, value))
        read_um.append(injector.reading(k, y_um))
    return np.array(read_um)


@pytest.mark.parametrize(("kind", "value"), [("stuck_noisy", 1e-6), ("sensor_gain", 0.3), ("sign", 0.0)])
def test_a_lying_sensor_goes_on_from_its_last_reading_and_is_sound_before_and_after(kind: str, value: float) -> None:
    shown = read(kind, value)
    np.testing.assert_array_equal(shown[:100], Y_UM[:100])
    np.testing.assert_array_equal(shown[300:], Y_UM[300:])
    moved = Y_UM[100:300] - Y_UM[100]
    lie = shown[100:300] - Y_UM[99]
    if kind == "stuck_noisy":
        assert 0.3e-6 < lie.std() < 3e-6
        assert np.unique(lie).size == 200, "no two readings are equal"
    else:
        np.testing.assert_allclose(lie, (0.3 if kind == "sensor_gain" else -1.0) * moved, atol=1e-12)


def test_a_trouble_that_stands_when_a_fault_begins_names_it_too() -> None:
    """It is told once, when it begins: before the fault, where late voltages have made it."""
    names = (("trouble", 90), ("recovered", 120), ("trouble", 300))
    events = [{"event": name, "seq": seq, "detail": "voltage_differs (why)"} for name, seq in names]
    assert [seq for seq, _ in troubles_since(events, 100)] == [90, 300]
    assert [seq for seq, _ in troubles_since(events, 130)] == [300]
    assert [seq for seq, _ in troubles_since(events, 301)] == [300]
