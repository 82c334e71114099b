"""Hyper-parameters from the live window: proposed by the evidence, tried on fresh samples, taken only if better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adaptive.errors import InputError
from adaptive.tuning.config import RetuneConfig
from adaptive.tuning.evidence import evaluate, evidence_samples
from adaptive.tuning.retuning import Proposal, bounds_of, compare, fresh_rows, pattern, propose, significance
from adaptive.types import FloatArray, Hyperparameters, WindowData

NARROW = Hyperparameters(1e5, (0.12, 0.12))
GOOD = Hyperparameters(2e3, (1.0, 0.8))
NOISE_V = 0.004


def truth(X: FloatArray) -> FloatArray:
    """A smooth target, V, of two inputs."""
    return 0.1 * np.sin(3.0 * X[:, 0]) + 0.05 * np.tanh(4.0 * X[:, 1]) + 0.7


def samples(n: int, seed: int, hyper: Hyperparameters = NARROW, noise_V: float = NOISE_V) -> WindowData:
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.0, 1.0, (n, 2))
    return WindowData(X, truth(X) + noise_V * rng.normal(size=n), np.ones(n), np.arange(n, 0, -1.0) - 1.0, hyper)


def slid(before: WindowData, fresh: WindowData) -> WindowData:
    """``before`` with its oldest samples replaced by ``fresh``."""
    k = fresh.targets_V.size
    return replace(
        before,
        kernel=np.vstack([before.kernel[k:], fresh.kernel]),
        targets_V=np.concatenate([before.targets_V[k:], fresh.targets_V]),
        weights=np.ones(before.targets_V.size),
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
    for column in ((points - low) / (high - low)).T:
        assert np.histogram(column, 8, (0.0, 1.0))[0].min() >= 4


def test_a_search_gives_the_starts(before: WindowData, proposal: Proposal) -> None:
    asked = []

    def search(data: object, start: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        asked.append(start)
        return np.log([[proposal.hyper.gamma, *proposal.hyper.widths]])

    found = propose(before, RetuneConfig(rows=80), search)
    assert len(asked) == 1
    assert found.J2 <= proposal.J2 + 1e-3
    assert found.evaluations < proposal.evaluations


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
