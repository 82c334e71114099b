"""The bridge knows where the stage is from the voltage alone, round turning points too."""

from __future__ import annotations

import numpy as np

from adaptive.bridge import Bridge, Bridging
from adaptive.learner import Learner
from adaptive.snapshot import LssvmInverse
from adaptive.types import Sample
from sim.presets import preset
from sim.stage import Stage

DT, GAP = 1e-3, 20


def test_twenty_samples_without_a_reading(model: LssvmInverse) -> None:
    """Mean error below 0.05 µm where a straight line is off by micrometres; a new one begins every 37 samples."""
    t = np.arange(2500) * DT
    u = np.minimum(t / 0.5, 1.0) * (4.0 + 1.2 * np.sin(2 * np.pi * 7.0 * t) + 0.8 * np.sin(2 * np.pi * 2.3 * t))
    stage = Stage(preset("rich", seed=4))
    y, _ = stage.run(stage.initial_state(), u)
    learner = Learner.from_model(model)
    errors, straight = [], []
    for k in range(t.size - GAP):
        track = learner.parts.front.track
        if k > 1500 and k % 37 == 0 and track is not None:
            bridging = Bridging(track.served, learner.parts.voltage, model.span_V / 80.0)
            bridge = bridging.begin(*track.since_motion(), track.memory)
            before = track.memory.copy()
            for i in range(GAP):
                place = bridging.advance(bridge, float(u[k + i]))
            errors.append(abs(place - y[k + GAP - 1]))
            straight.append(abs(y[k - 1] + GAP * (y[k - 1] - y[k - 6]) / 5 - y[k + GAP - 1]))
            np.testing.assert_array_equal(track.memory, before)
            assert bridge.path_um >= abs(place - y[k - 1]) - 0.1
        learner.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
    assert np.mean(errors) < 0.05
    assert np.mean(errors) < 0.03 * np.mean(straight)


def test_state_round_trip(model: LssvmInverse) -> None:
    bridge = Bridge(40.0, 39.9, 5.0, model.rest_memory(40.0), 0.3, 1.5)
    again = Bridge.from_state(bridge.state_dict())
    assert (again.y_um, again.before_um, again.a_um_per_s2, again.path_um) == (40.3, 39.9, 5.0, 1.5)
    np.testing.assert_array_equal(again.memory, bridge.memory)


def test_a_model_gone_wrong_gives_finite_places(model: LssvmInverse) -> None:
    bridging = Bridging(model.features, lambda basis, kernel: float("nan"), 0.1)
    bridge = Bridge(40.0, 39.9, 5.0, model.rest_memory(40.0))
    assert np.isfinite(bridging.advance(bridge, 4.0))
