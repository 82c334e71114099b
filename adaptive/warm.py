"""Compile the compiled loops once, so that no process pays for it at start; see ``service.warm``.

What the learner needs is compiled at every set-up; the rest of the window's operations, most of a minute of compiling,
only where they are called: by the tests, the benchmarks, and whoever builds on `adaptive.window.window`.
"""

from __future__ import annotations

import numpy as np

from adaptive.compiled import all_finite
from adaptive.features import FeatureMap
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.drift import DriftConfig, DriftFilter
from adaptive.online.learner import Learner
from adaptive.smoothing import smooth_recording
from adaptive.types import Sample


def warm() -> None:
    """What serving needs: smoother, features, snapshot and one step of the learner."""
    features = FeatureMap(1e-3, 0.0, 1.0, 1.0, 1.0, (0.1, 0.2), (0.3,), (0.1,), (0,), asymmetric=True)
    p, d = features.basis_size, features.kernel_size
    model = LssvmInverse(
        "warm", features, np.zeros(p), np.linspace(0.0, 1.0, 12 * d).reshape(12, d), np.zeros(12), np.ones(d), 10.0,
        np.array([0.0, 1.0] * 3),
    )  # fmt: skip
    # With room for one more: growing a window is a step of its own.
    learner = Learner(model, LearnerConfig(window=13))
    for k in range(120):
        learner.handle(Sample(k, k * 1e-3, 0.1 * np.sin(0.1 * k), 0.1 * np.sin(0.1 * k)))
    # Whether the samples above led to any of its steps is the gates' affair.
    learner.warm()
    smooth_recording(np.linspace(0.0, 1.0, 200), learner.config.smoother(1e-3))
    snapshot = learner.snapshot()
    still = np.zeros(2)
    memory = snapshot.feedforward(still, still, still, learner.memory()).memory
    snapshot.evaluate_point(0.0, 0.0, 0.0, memory)
    snapshot.track(still, still, still, still, memory)
    features.run(still, still, still, memory)
    all_finite(still)
    # The library's algebra is a choice; the compiled one is the learner's.
    drift = DriftFilter(DriftConfig(algebra="filterpy"), np.zeros(p), np.eye(p), 1e-3, 1.0)
    for moving in (True, False):
        drift.update(np.ones(p), 0.0, moving)
    drift.expect_change()
