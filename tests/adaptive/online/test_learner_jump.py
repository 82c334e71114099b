"""A jump that begins with a reading too small for a glitch must not be taken for motion."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive.inverse_model import LssvmInverse
from adaptive.online.gates import AdmissionConfig
from adaptive.online.learner import Learner
from adaptive.types import Sample

DT = 1e-3
SHARE = AdmissionConfig().glitch_share


@pytest.mark.parametrize("first", [0.2, 0.5, 0.9, 1.5])
def test_the_frame_moves_by_the_jump_and_no_further(
    model: LssvmInverse, recording: tuple[np.ndarray, np.ndarray], first: float
) -> None:
    """The first reading of the jump is off by ``first`` glitch shares, all later ones by 1.5."""
    u, clean = recording
    span = model.features.y_max_um - model.features.y_min_um
    at = 3000
    y = clean.copy()
    y[at] -= first * SHARE * span
    y[at + 1 :] -= 1.5 * SHARE * span
    learner = Learner.from_model(model)
    for k in range(at + 24):
        learner.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
    assert learner.counters()["jumps"] == 1
    frame = learner.features
    for k in (at + 18, at + 23):
        in_frame = frame.offset_um + frame.gain * (clean[k] - frame.offset_um)
        assert in_frame == pytest.approx(y[k], abs=0.15)


def test_what_is_known_of_a_jump_is_part_of_the_state(
    model: LssvmInverse, recording: tuple[np.ndarray, np.ndarray]
) -> None:
    """Saved between the first surprising reading and the one that makes it a jump: the same to the last bit."""
    u, y = (column.copy() for column in recording)
    span = model.features.y_max_um - model.features.y_min_um
    at = 3000
    y[at] -= 0.9 * SHARE * span
    y[at + 1 :] -= 1.8 * SHARE * span
    learner = Learner.from_model(model)
    for k in range(at + 3):
        learner.handle(Sample(k, k * DT, float(u[k]), float(y[k])))
    twin = Learner.from_state(learner.state_dict())
    for k in range(at + 3, at + 200):
        sample = Sample(k, k * DT, float(u[k]), float(y[k]))
        assert learner.handle(sample) == twin.handle(sample)
    assert learner.counters()["jumps"] == 1
    assert np.array_equal(learner.snapshot().beta, twin.snapshot().beta)
