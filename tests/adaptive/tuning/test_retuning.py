"""Re-tuning of the window: proposals, trials and adoption."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import column
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.tuning.config import RetuneConfig
from dehyst.adaptive.tuning.evidence import evaluate, evidence_samples
from dehyst.adaptive.tuning.retuning import Proposal, bounds_of, compare, fresh_rows, pattern, propose, significance
from dehyst.adaptive.types import FloatArray, Hyperparameters, Sample, WindowData

# --- Hyper-parameters from the live window: proposed by the evidence, tried on fresh samples, taken only if better.

NARROW = Hyperparameters(1e5, (0.12, 0.12))
GOOD = Hyperparameters(2e3, (1.0, 0.8))
NOISE_V = 0.004


def truth(X: FloatArray) -> FloatArray:
    """A smooth target, V, of two inputs."""
    return 0.1 * np.sin(3.0 * X[:, 0]) + 0.05 * np.tanh(4.0 * X[:, 1]) + 0.7


def samples(n: int, seed: int, hyper: Hyperparameters = NARROW, noise_V: float = NOISE_V) -> WindowData:
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.0, 1.0, (n, 2))
    return WindowData(X, truth(X) + noise_V * rng.normal(size=n), np.arange(n, 0, -1.0) - 1.0, hyper)


def slid(before: WindowData, fresh: WindowData) -> WindowData:
    """``before`` with its oldest samples replaced by ``fresh``."""
    k = fresh.targets_V.size
    return replace(
        before,
        kernel=np.vstack([before.kernel[k:], fresh.kernel]),
        targets_V=np.concatenate([before.targets_V[k:], fresh.targets_V]),
        age=np.concatenate([before.age[k:] + k, fresh.age]),
    )


@pytest.fixture(scope="module")
def before() -> WindowData:
    return samples(160, 1)


@pytest.fixture(scope="module")
def proposal(before: WindowData) -> Proposal:
    return propose(before, RetuneConfig(rows=80))


def test_the_proposal_has_more_evidence_and_predicts_better(before: WindowData, proposal: Proposal) -> None:
    assert proposal.J2_before - 100.0 > proposal.J2
    trial = compare(before, slid(before, samples(80, 2)), proposal.hyper)
    assert (trial.fresh, trial.better) == (80, True)
    assert trial.after_V < 0.5 * trial.before_V
    assert trial.after_V == pytest.approx(NOISE_V, rel=0.3)


def test_the_proposal_is_an_optimum_of_the_evidence(before: WindowData, proposal: Proposal) -> None:
    y = (before.targets_V - before.targets_V.mean()) / before.targets_V.std()
    found = evaluate(evidence_samples(before.kernel, y), proposal.hyper.gamma, np.array(proposal.hyper.widths))
    assert np.max(np.abs(found.J2_gradient)) < 0.3
    assert pytest.approx(proposal.J2, abs=1e-6) == found.J2


def test_what_is_good_stays(before: WindowData, proposal: Proposal) -> None:
    again = propose(replace(before, hyper=proposal.hyper), RetuneConfig(rows=80))
    assert again.J2_before - again.J2 < 0.05
    trial = compare(replace(before, hyper=proposal.hyper), slid(before, samples(80, 2)), again.hyper)
    assert not trial.better


def test_a_bad_proposal_is_refused(before: WindowData) -> None:
    good = replace(before, hyper=GOOD)
    after = slid(good, samples(80, 3, GOOD))
    for bad in (Hyperparameters(1e6, (0.05, 0.05)), Hyperparameters(1e-2, (0.5, 0.5)), NARROW):
        trial = compare(good, after, bad)
        assert not trial.better
        assert trial.after_V > trial.before_V


def test_a_gain_that_may_be_chance_is_not_taken(before: WindowData) -> None:
    """Better on twenty samples, but by less than their scatter explains."""
    good = replace(before, hyper=GOOD)
    slightly = Hyperparameters(GOOD.gamma, (GOOD.widths[0] * 1.15, GOOD.widths[1]))
    trial = compare(good, slid(good, samples(20, 4, GOOD)), slightly, RetuneConfig(gain=0.0))
    assert trial.better == (trial.after_V < trial.before_V and trial.sigmas >= 2.29)
    assert not compare(good, slid(good, samples(20, 4, GOOD)), GOOD, RetuneConfig(gain=0.0, sigmas=0.1)).better


def correlated(n: int, seed: int, rho: float) -> FloatArray:
    """A first-order autoregression of variance 1."""
    noise = np.random.default_rng(seed).normal(size=n)
    series = np.empty(n)
    series[0] = noise[0]
    for k in range(1, n):
        series[k] = rho * series[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
    return series


def test_samples_that_are_alike_count_as_few() -> None:
    alone = np.median([significance(correlated(400, seed, 0.0))[1] for seed in range(40)])
    alike = np.median([significance(correlated(400, seed, 0.8))[1] for seed in range(40)])
    assert 280.0 < alone <= 400.0
    # (1 - rho) / (1 + rho) of them: 44.
    assert 30.0 < alike < 65.0
    # Chance is seldom taken for a gain, however alike neighbours are; by itself the number of samples would be, often.
    series = [correlated(400, seed, 0.8) for seed in range(300)]
    wrong = np.mean([significance(one)[0] >= 2.29 for one in series])
    naive = np.mean([one.mean() / one.std() * np.sqrt(one.size) >= 2.29 for one in series])
    assert wrong < 0.04 < 0.12 < naive
    assert significance(series[0] + 1.0)[0] > 3.0
    assert significance(np.linspace(0.0, 1.0, 50))[0] == 0.0


def test_what_is_smaller_by_chance_stays_open_and_what_is_not_is_closed(before: WindowData) -> None:
    good = replace(before, hyper=GOOD)
    after = slid(good, samples(80, 2, GOOD))
    never = RetuneConfig(sigmas=1e6)
    wide = replace(before, hyper=Hyperparameters(2e3, (9.0, 9.0)))
    open_trial = compare(wide, replace(after, hyper=wide.hyper), GOOD, never)
    assert (open_trial.better, open_trial.open) == (False, True)
    closed = compare(good, after, wide.hyper, never)
    assert (closed.better, closed.open) == (False, False)
    assert open_trial.sigmas > 2.29 > 0.0 > closed.sigmas


def test_tripled_noise_is_answered_by_more_regularisation(before: WindowData) -> None:
    quiet = Hyperparameters(1e6, (0.4, 0.4))
    noisy = samples(160, 5, quiet, 10.0 * NOISE_V)
    found = propose(noisy, RetuneConfig(rows=80))
    assert found.hyper.gamma < 0.05 * quiet.gamma
    assert compare(noisy, slid(noisy, samples(120, 6, quiet, 10.0 * NOISE_V)), found.hyper).better


def test_fresh_is_what_was_not_there(before: WindowData) -> None:
    after = slid(before, samples(30, 7))
    assert fresh_rows(before, after).tolist() == [False] * 130 + [True] * 30
    with pytest.raises(InputError, match="after"):
        compare(before, before, GOOD)


def test_the_result_is_the_same_each_time(before: WindowData, proposal: Proposal) -> None:
    assert propose(before, RetuneConfig(rows=80)) == proposal


def test_starts_fill_the_box_from_what_is_at_work() -> None:
    low, high = bounds_of(GOOD, RetuneConfig())
    here = np.log([GOOD.gamma, *GOOD.widths])
    points = pattern(here, low, high, 64)
    assert np.array_equal(points[0], here)
    assert np.all((points >= low) & (points <= high))
    # Every eighth of each axis is visited.
    for values in ((points - low) / (high - low)).T:
        assert np.histogram(values, 8, (0.0, 1.0))[0].min() >= 4


def test_what_cannot_be_tuned_is_refused(before: WindowData) -> None:
    with pytest.raises(InputError, match="60"):
        propose(samples(40, 1))
    with pytest.raises(InputError, match="equal"):
        propose(replace(before, targets_V=np.ones(160)))


@pytest.mark.parametrize(
    "bad", [{"starts": 0}, {"rows": 5}, {"gain": 1.0}, {"gamma_reach": 1.0}, {"width_range": (1.0, 0.5)}]
)
def test_bad_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(InputError):
        RetuneConfig(**bad)  # type: ignore[arg-type]


# --- Hyper-parameters from elsewhere: adopted where they foretell better, without a jump, and kept in the state.

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
    point = learner.parts.point
    now, then = (one.beta[0] + column(one.support, point, one.widths) @ one.alpha for one in (after, before))
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
    assert data.targets_V.shape == data.age.shape == (n,)
    assert data.age.min() == 0.0
    learner.window_data().targets_V[:] = 0.0
    assert np.any(learner.window_data().targets_V != 0.0)


_ADOPT = """
import sys
import numpy as np
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.types import Hyperparameters
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import Sample

def loaded():
    found = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("dehyst.adaptive."):
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
