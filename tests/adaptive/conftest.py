"""A model identified from the simulated stage with the chapter's signal, once for all tests of the learner."""

from __future__ import annotations

import numpy as np
import pytest

from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT = 1e-3


@pytest.fixture(scope="session")
def recording() -> tuple[np.ndarray, np.ndarray]:
    """(u_V, y_um) of 10 s of the chapter's training signal (2.37) at 1 kHz on the rich stage."""
    stage = Stage(preset("rich", seed=1))
    _, u = training_input(DT, 10.0)
    y, _ = stage.run(stage.initial_state(), u)
    return u, y


@pytest.fixture(scope="session")
def model(recording: tuple[np.ndarray, np.ndarray]) -> LssvmInverse:
    """What the adaptive model starts from."""
    return identify_lssvm(*recording, DT, config=IdentifyConfig(tune=False, n=300))[0]


@pytest.fixture(scope="session")
def all_strokes() -> tuple[np.ndarray, np.ndarray]:
    """(u_V, y_um) of 8 s on the rich stage: strokes of all sizes up to 7.7 Hz, without a rest."""
    stage = Stage(preset("rich", seed=6))
    t_s = np.arange(8000) * DT
    tones = ((1.6, 0.7), (1.0, 1.9), (0.6, 4.3), (0.3, 7.7))
    u = np.minimum(t_s / 0.5, 1.0) * (4.0 + sum(size * np.sin(2 * np.pi * hz * t_s + hz) for size, hz in tones))
    return u, stage.run(stage.initial_state(), u)[0]
