"""The batched search for hyper-parameters: the same evidence as elsewhere, and basins that lie far away."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from dehyst.adaptive.tuning.evidence import EvidenceSamples, evaluate, evidence_samples
from dehyst.baselines.swarm.evidence_search import EvidenceSearch, EvidenceSearchConfig, _Batch
from dehyst.baselines.swarm.identification import MissingTorchError

torch = pytest.importorskip("torch", reason="torch is not installed")


@pytest.fixture(scope="module")
def data() -> EvidenceSamples:
    rng = np.random.default_rng(3)
    X = rng.uniform(-1.0, 1.0, (70, 2))
    y = np.sin(3.0 * X[:, 0]) + 0.5 * X[:, 1] + 0.02 * rng.normal(size=70)
    return evidence_samples(X, y, rng.uniform(0.5, 2.0, 70))


def test_values_and_gradients_are_those_of_the_evidence(data: EvidenceSamples) -> None:
    theta = np.log(np.array([[1e3, 0.3, 0.5], [1e5, 0.2, 2.0], [10.0, 5.0, 0.1]]))
    J2, gradient = _Batch(torch, data, "cpu")(torch.as_tensor(theta))
    for i, point in enumerate(np.exp(theta)):
        expected = evaluate(data, point[0], point[1:])
        assert float(J2[i]) == pytest.approx(expected.J2, abs=1e-8)
        np.testing.assert_allclose(gradient[i].numpy(), expected.J2_gradient, atol=1e-6)


def test_a_matrix_that_cannot_be_factored_spoils_no_other(data: EvidenceSamples) -> None:
    theta = np.log(np.array([[1e3, 0.3, 0.5], [1e30, 50.0, 50.0]]))
    J2, gradient = _Batch(torch, data, "cpu")(torch.as_tensor(theta))
    assert float(J2[1]) > 1e11
    assert torch.isfinite(gradient).all()
    assert float(J2[0]) == pytest.approx(evaluate(data, 1e3, np.array([0.3, 0.5])).J2, abs=1e-8)


def test_it_leaves_a_bad_start_within_the_box(data: EvidenceSamples) -> None:
    low, high = np.log([1.0, 0.05, 0.05]), np.log([1e6, 20.0, 20.0])
    start = np.log(np.array([1e6, 0.05, 0.05]))
    search = EvidenceSearch(EvidenceSearchConfig(starts=12, steps=25, device="cpu"))
    found = search(data, start, low, high)
    assert 1 <= len(found) <= 4
    assert np.all((found >= low - 1e-12) & (found <= high + 1e-12))
    values = [evaluate(data, float(np.exp(p[0])), np.exp(p[1:])).J2 for p in found]
    assert values == sorted(values)
    assert values[0] < evaluate(data, 1e6, np.array([0.05, 0.05])).J2 - 50.0
    np.testing.assert_array_equal(found, search(data, start, low, high))


def test_without_torch_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingTorchError, match="pip install"):
        EvidenceSearch()
