"""Compile the compiled loops that serving needs, so that no process waits for the compiler at start.

Other operations are compiled on their first call.
"""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.compiled import all_finite
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.smoothing import smooth_recording
from dehyst.adaptive.types import Sample


def warm() -> None:
    """Call every compiled function that serving needs: smoother, features, snapshot, steps of the learner."""
    features = FeatureMap(1e-3, 0.0, 1.0, 1.0, 1.0, (0.1, 0.2), (0.3,), (0.1,), (0,), asymmetric=True)
    p, d = features.basis_size, features.kernel_size
    model = LssvmInverse(
        "warm", features, np.zeros(p), np.linspace(0.0, 1.0, 12 * d).reshape(12, d), np.zeros(12), np.ones(d), 10.0,
        np.array([0.0, 1.0] * 3),
    )  # fmt: skip
    # One slot stays free: appending is a step of its own.
    learner = Learner(model, LearnerConfig(window=13))
    for k in range(120):
        learner.handle(Sample(k, k * 1e-3, 0.1 * np.sin(0.1 * k), 0.1 * np.sin(0.1 * k)))
    # The gates decide which steps the samples above reach; this calls all of them.
    learner.warm()
    smooth_recording(np.linspace(0.0, 1.0, 200), learner.config.smoother(1e-3))
    snapshot = learner.snapshot()
    still = np.zeros(2)
    memory = snapshot.feedforward(still, still, still, learner.memory()).memory
    snapshot.evaluate_point(0.0, 0.0, 0.0, memory)
    snapshot.track(still, still, still, still, memory)
    features.run(still, still, still, memory)
    all_finite(still)
