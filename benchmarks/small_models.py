"""Small models that fuzzers and forged states begin from."""

from __future__ import annotations

import numpy as np

from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import InverseModel
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearParameters


def small_models() -> dict[str, InverseModel]:
    """A linear model and a small LSSVM with memory, of a stage of 11 µm/V that moves 90 µm."""
    features = FeatureMap(
        1e-3, 0.0, 90.0, 1e3, 1e5, thresholds_um=(1.0, 5.0), arc_lengths_um=(3.0,), time_constants_s=(0.1,),
        kernel_plays=(0,), asymmetric=True,
    )  # fmt: skip
    rng = np.random.default_rng(5)
    beta = np.zeros(features.basis_size)
    beta[:2] = 4.0, 4.09
    lssvm = LssvmInverse(
        "lssvm_adaptive", features, beta, rng.uniform(-1.0, 1.0, (20, features.kernel_size)),
        0.01 * rng.normal(size=20), np.ones(features.kernel_size), 1e4,
        domain=np.array([0.0, 90.0, -2e4, 2e4, -1e7, 1e7]), noise_variance=1e-6, kernel_variance=1e-4,
    )  # fmt: skip
    line = LinearInverse(LinearParameters(11.0, 1.0), 1e-3, Domain(0.0, 90.0, 1e4), 0.05)
    return {"linear": line, "lssvm_adaptive": lssvm}
