"""Evidence: the reference values, every gradient against differences, the search against a grid."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from dehyst.adaptive import features, lssvm
from dehyst.adaptive.errors import InputError, NumericsError
from dehyst.adaptive.tuning import evidence
from dehyst.adaptive.tuning import search as inference
from dehyst.adaptive.tuning.search import InferenceConfig

DATA = Path(os.environ.get("DEHYST_DATA", Path(__file__).parents[4] / "shared" / "data")) / "lssvm-reference"
needs_reference = pytest.mark.skipif(not DATA.is_dir(), reason=f"reference values not found at {DATA}; set DEHYST_DATA")


def reference_problem() -> evidence.EvidenceSamples:
    table = np.genfromtxt(DATA / "bw500.csv", delimiter=",", names=True)
    return evidence.evidence_samples(np.column_stack([table["u_n"], table["udot_n"]]), table["y_n"])


def small_problem(n: int = 70) -> evidence.EvidenceSamples:
    rng = np.random.default_rng(3)
    X = rng.random((n, 3))
    y = np.sin(6 * X[:, 0]) + 0.5 * X[:, 1] + 0.05 * rng.standard_normal(n)
    return evidence.evidence_samples(X, y)


def level_two(data: evidence.EvidenceSamples, widths: np.ndarray) -> evidence.Evidence:
    found = inference.level_two(inference.CountedEvidence(data), 100.0, widths, InferenceConfig(), False)
    assert found is not None
    return found


@needs_reference
def test_level_one_and_two_reference_values() -> None:
    found = evidence.evaluate(reference_problem(), 741.0, np.array([0.4, 0.4]))
    assert pytest.approx(1.54823814914, rel=1e-10) == found.E_W
    assert pytest.approx(0.0180020412047, rel=1e-10) == found.E_D
    assert found.effective == pytest.approx(33.161494249, rel=1e-10)
    assert found.mu == pytest.approx(10.3864816, rel=1e-8)
    assert found.zeta == pytest.approx(12966.2659, rel=1e-8)


@needs_reference
def test_level_two_optimum_reference_values() -> None:
    found = level_two(reference_problem(), np.array([0.4, 0.4]))
    assert found.gamma == pytest.approx(2899.888, rel=1e-5)
    assert found.effective == pytest.approx(37.9146, rel=1e-5)
    assert pytest.approx(-1799.74692, rel=1e-8) == found.J2
    assert found.mu == pytest.approx(4.8107448, rel=1e-5)
    assert found.zeta == pytest.approx(13950.622, rel=1e-6)


def test_at_the_optimum_of_gamma_it_is_the_ratio_of_zeta_and_mu() -> None:
    found = level_two(small_problem(), np.array([0.5, 1.0, 2.0]))
    assert found.zeta / found.mu == pytest.approx(found.gamma, rel=1e-4)


def test_gradients() -> None:
    data = small_problem()
    theta, h = np.log([60.0, 0.4, 0.9, 1.7]), 1e-5

    def j2(at: np.ndarray) -> float:
        return evidence.evaluate(data, np.exp(at[0]), np.exp(at[1:])).J2

    numeric = [(j2(theta + h * e) - j2(theta - h * e)) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(evidence.evaluate(data, 60.0, np.exp(theta[1:])).J2_gradient, numeric, rtol=1e-5)


def test_third_level_gradient_follows_the_optimum_of_gamma() -> None:
    data, theta, h = small_problem(), np.log([0.4, 0.9, 1.7]), 1e-3

    def at_optimum(at: np.ndarray) -> evidence.Evidence:
        gamma = level_two(data, np.exp(at)).gamma
        return evidence.evaluate(data, gamma, np.exp(at), third_level=True)

    numeric = [(at_optimum(theta + h * e).J3 - at_optimum(theta - h * e).J3) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(at_optimum(theta).J3_gradient, numeric, rtol=2e-3, atol=1e-3)


def test_effective_parameters_by_eigenvalues() -> None:
    data = evidence.evidence_samples(*_samples())
    widths = np.array([0.5, 0.5, 0.5])
    found = evidence.evaluate(data, 30.0, widths)
    centre = np.eye(data.size) - 1.0 / data.size
    eigenvalues = np.linalg.eigvalsh(centre @ features.gram(data.X, None, widths) @ centre)
    assert found.effective == pytest.approx(1 + np.sum(30 * eigenvalues / (1 + 30 * eigenvalues)), rel=1e-9)


def _samples() -> tuple[np.ndarray, np.ndarray]:
    data = small_problem()
    return data.X, data.y


@pytest.mark.parametrize("method", ["joint", "three_level"])
def test_search_finds_what_matters(method: str) -> None:
    data = small_problem(n=90)
    found = inference.infer(data, InferenceConfig(method=method))  # type: ignore[arg-type]
    widths = found.best.widths
    assert widths[2] > 5 * widths[0], "the third feature carries nothing, its width must grow"
    X, y = np.random.default_rng(9).random((300, 3)), None
    y = np.sin(6 * X[:, 0]) + 0.5 * X[:, 1]
    model = lssvm.fit(data.X, data.y, widths, found.best.gamma).model
    assert np.sqrt(np.mean((model.predict(X) - y) ** 2)) < 0.04


def test_joint_search_ends_at_a_stationary_point_below_all_starts() -> None:
    data = small_problem()
    found = inference.infer(data, InferenceConfig(width_range=(0.05, 5.0)))
    interior = (found.best.widths > 0.051) & (found.best.widths < 4.9)
    assert np.all(np.abs(found.best.J2_gradient[1:][interior]) < 0.05)
    for gamma, sigma in InferenceConfig().starts:
        assert found.best.J2 <= evidence.evaluate(data, gamma, np.full(3, min(sigma, 5.0))).J2


def test_one_width_for_all() -> None:
    found = inference.infer(small_problem(), InferenceConfig(ard=False))
    assert np.unique(found.best.widths).size == 1


def test_the_search_is_deterministic() -> None:
    first, second = (inference.infer(small_problem()) for _ in range(2))
    assert first.best.gamma == second.best.gamma
    np.testing.assert_array_equal(first.best.widths, second.best.widths)


def test_bad_input() -> None:
    X, y = _samples()
    with pytest.raises(InputError, match="equal"):
        evidence.evidence_samples(X, np.ones(y.size))
    with pytest.raises(InputError, match="samples"):
        evidence.evidence_samples(X[:3], y[:3])
    with pytest.raises(InputError, match="starts"):
        InferenceConfig(starts=())
    with pytest.raises(NumericsError):
        evidence.evaluate(evidence.evidence_samples(np.ones((20, 2)), np.arange(20.0)), 1e19, np.ones(2))


# --- The answer is checked against a coarse scan, and does not depend on the environment.


@needs_reference
def test_the_deepest_optimum_with_one_width_is_found_where_no_start_leads_to_it() -> None:
    data = reference_problem()
    unchecked = inference.infer(data, InferenceConfig(ard=False, scan_rows=0)).best
    found = inference.infer(data, InferenceConfig(ard=False)).best
    assert pytest.approx(-2133.43, abs=0.01) == unchecked.J2
    assert pytest.approx(-2205.23, abs=0.01) == found.J2
    assert found.widths == pytest.approx(np.full(2, 0.0611), rel=1e-3)
    # No point of a finer scan is deeper.
    for width in np.geomspace(0.03, 3.0, 7):
        for gamma in np.geomspace(1e2, 1e6, 3):
            at = evidence.evaluate(data, gamma, np.full(2, width))
            assert at.J2 > found.J2


@pytest.mark.parametrize("ard", [False, True])
def test_starts_far_from_the_optimum_do_not_decide(ard: bool) -> None:
    data = small_problem(n=120)
    far = InferenceConfig(ard=ard, starts=((10.0, 40.0),))
    assert inference.infer(data, far).best.J2 <= inference.infer(data, InferenceConfig(ard=ard)).best.J2 + 0.5


def test_length_scales_are_those_of_the_samples() -> None:
    X = np.column_stack([np.arange(10.0), np.zeros(10)])
    scale, least, largest = inference.length_scales(X, ard=False)
    assert (scale.tolist(), least, largest) == ([1.0, 1.0], 1.0, 18.0)
    scale, least, _ = inference.length_scales(np.vstack([X, X[:3]]), ard=True)
    assert scale[1] == 1.0  # a feature that does not change tells nothing
    assert least == pytest.approx(1.0 / scale[0])  # nor do samples that coincide


@pytest.mark.parametrize("called", ["infer", "evaluate", "fit"])
def test_one_blas_thread_is_used_whatever_the_environment_says(called: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    seen: set[int] = set()
    real, data, width = features.gram, small_problem(n=40), np.ones(3)

    def watched(*arguments: Any) -> Any:
        seen.update(threads())
        return real(*arguments)

    monkeypatch.setattr(features, "gram", watched)
    with threadpool_limits(2, "blas"):
        before = threads()
        if called == "infer":
            inference.infer(data, InferenceConfig(iterations=2))
        elif called == "evaluate":
            evidence.evaluate(data, 100.0, width)
        else:
            lssvm.fit(data.X, data.y, width, 100.0)
        assert threads() == before  # the caller's limit is his own
    assert seen == {1}
