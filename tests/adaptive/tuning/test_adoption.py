"""Hyper-parameters from elsewhere: adopted where they foretell better, without a jump, and kept in the state."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest

from adaptive.inverse_model import LssvmInverse
from adaptive.online.learner import Learner
from adaptive.types import Hyperparameters, Sample

DT = 1e-3
Recording = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def state(model: LssvmInverse, recording: Recording) -> dict[str, object]:
    """Of a learner after three seconds."""
    learner = Learner.from_model(model)
    for k in range(3000):
        learner.handle(Sample(k, k * DT, float(recording[0][k]), float(recording[1][k])))
    return learner.state_dict()


def better(learner: Learner) -> Hyperparameters:
    """Of some candidates the one with the smallest leave-one-out error on the newest samples."""
    data = learner.window_data()
    tried = [
        Hyperparameters(data.hyper.gamma * g, tuple(w * s for w in data.hyper.widths))
        for g in (0.1, 1.0, 10.0)
        for s in (0.6, 1.0, 1.7)
    ]
    return min(tried, key=lambda h: learner.parts.window.with_hyperparameters(h).newest_error_V(100))


def test_better_ones_are_adopted_without_a_jump(state: dict[str, object], recording: Recording) -> None:
    learner = Learner.from_state(state)
    before, data = learner.snapshot(), learner.window_data()
    beta = learner.parts.filter.beta
    hyper = better(learner)
    assert hyper != learner.hyper
    assert learner.adopt(hyper) == ""
    after = learner.snapshot()
    assert learner.hyper == hyper
    assert after.gamma == hyper.gamma
    np.testing.assert_array_equal(after.widths, hyper.widths)
    np.testing.assert_array_equal(learner.parts.filter.beta[1:], beta[1:])
    basis = np.zeros(before.features.basis_size)
    point = learner.parts.point
    now, then = after.mean(basis, point) + after.beta[0], before.mean(basis, point) + before.beta[0]
    assert now == pytest.approx(then, abs=1e-9)
    np.testing.assert_array_equal(learner.window_data().targets_V, data.targets_V)
    assert learner.counters()["adoptions"] == 1
    for k in range(3000, 3600):
        learner.handle(Sample(k, k * DT, float(recording[0][k]), float(recording[1][k])))
    assert learner.diagnostics()["recent_rms_error_pct"] < 0.2


def test_the_state_carries_them(state: dict[str, object], recording: Recording) -> None:
    one = Learner.from_state(state)
    assert one.adopt(better(one)) == ""
    two = Learner.from_state(one.state_dict())
    assert two.hyper == one.hyper
    for k in range(3000, 3300):
        sample = Sample(k, k * DT, float(recording[0][k]), float(recording[1][k]))
        assert one.handle(sample) == two.handle(sample)
    for name, value in one.snapshot().state_dict().items():
        np.testing.assert_array_equal(two.snapshot().state_dict()[name], value, err_msg=name)


@pytest.mark.parametrize(
    ("gamma", "width", "reason"),
    [(1e-4, 1.0, "worse"), (1.0, 0.01, "worse"), (-1.0, 1.0, "numerics"), (1e18, 1e6, "numerics")],
)
def test_others_are_refused_and_change_nothing(
    state: dict[str, object], gamma: float, width: float, reason: str
) -> None:
    learner = Learner.from_state(state)
    before = learner.snapshot()
    h = learner.hyper
    said = learner.adopt(Hyperparameters(h.gamma * gamma, tuple(w * width for w in h.widths)))
    assert said.startswith(reason)
    assert learner.snapshot() is before
    assert learner.hyper == h
    assert learner.counters()["adoptions_refused"] == 1


def test_the_wrong_number_of_widths_is_refused(state: dict[str, object]) -> None:
    learner = Learner.from_state(state)
    assert "widths" in learner.adopt(Hyperparameters(10.0, (1.0,)))


def test_a_large_move_of_the_output_is_refused(state: dict[str, object]) -> None:
    learner = Learner.from_state(state)
    hyper = better(learner)
    learner.parts.judgement.long_V2 = learner.parts.judgement.short_V2 = 1e-18
    learner.parts.judgement.doubt_V2 = 0.0
    assert learner.adopt(hyper).startswith("jump")


def test_window_data_is_a_copy_that_travels(state: dict[str, object]) -> None:
    learner = Learner.from_state(state)
    data = pickle.loads(pickle.dumps(learner.window_data()))
    n = len(learner.parts.window)
    assert data.kernel.shape == (n, learner.base.features.kernel_size)
    assert data.targets_V.shape == data.weights.shape == data.age.shape == (n,)
    assert data.age.min() == 0.0
    learner.window_data().targets_V[:] = 0.0
    assert np.any(learner.window_data().targets_V != 0.0)


_ADOPT = """
import sys
import numpy as np
from adaptive.features import FeatureMap
from adaptive.online.learner import Learner
from adaptive.types import Hyperparameters
from adaptive.online.config import LearnerConfig
from adaptive.inverse_model import LssvmInverse
from adaptive.types import Sample

def loaded():
    found = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("adaptive."):
            for value in vars(module).values():
                if getattr(value, "signatures", None):
                    found.add(f"{value.py_func.__module__}.{value.py_func.__name__}")
    return found

features = FeatureMap(1e-3, 0.0, 1.0, 1.0, 1.0, (0.1, 0.2), (0.3,), (0.1,), (0,), asymmetric=True)
p, d = features.basis_size, features.kernel_size
model = LssvmInverse(
    "m", features, np.zeros(p), np.linspace(0.0, 1.0, 12 * d).reshape(12, d), np.zeros(12), np.ones(d), 10.0,
    np.array([0.0, 1.0] * 3),
)
learner = Learner(model, LearnerConfig(window=10))
for k in range(200):
    learner.handle(Sample(k, k * 1e-3, 0.1 * np.sin(0.1 * k), 0.1 * np.sin(0.1 * k)))
learner.warm()
before = loaded()
learner.adopt(Hyperparameters(20.0, (1.2,) * d))
print(len(before), *sorted(loaded() - before))
"""


def test_nothing_is_compiled_when_other_hyper_parameters_come() -> None:
    """A learner that compiles for seconds while samples come is what a first adoption looked like in a soak."""
    run = subprocess.run([sys.executable, "-c", _ADOPT], capture_output=True, text=True, timeout=300, check=True)
    count, *late = run.stdout.split()
    assert int(count) > 5
    assert late == []
