"""Forward LSSVMs, voltage in and displacement out: the chapter's with two inputs, and one with memory.

The two-input model is (2.19)-(2.36) as printed: (u, du/dt) by the backward difference (2.41) at 0.02 s, min-max
normalised (2.42), gamma and sigma by three levels of Bayesian inference from gamma0 = 100, sigma0 = 1.

The model with memory has a linear part over play operators, arc and slow states of the *voltage* with a Gaussian
prior, and a radial kernel for what is left, its hyper-parameters by the same evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dehyst.adaptive import lssvm
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.identification import IdentifyConfig, design_features, linear_posterior, prior_deviations
from dehyst.adaptive.lssvm import LssvmModel
from dehyst.adaptive.smoothing import backward_difference
from dehyst.adaptive.tuning.evidence import Evidence, evidence_samples
from dehyst.adaptive.tuning.search import InferenceConfig, infer
from dehyst.adaptive.types import FloatArray
from dehyst.sim.chapter.experiments import DT_S, EVERY

# --- Min-max normalisation of features and targets, (2.42), with its inverse.


@dataclass(frozen=True, slots=True)
class MinMaxScaling:
    """x_n = (x - low)/(high - low), per column; ``low``, ``high`` (d,), the values that map to 0 and 1."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def fit(cls, data: FloatArray) -> MinMaxScaling:
        """From samples (N, d), or (N,) of one column. Raises InputError where one is not finite or does not change."""
        low, high = np.atleast_1d(data.min(axis=0)), np.atleast_1d(data.max(axis=0))
        if not (np.isfinite(low).all() and np.isfinite(high).all() and np.all(high > low)):
            raise InputError(
                f"data: got {low.tolist()} to {high.tolist()}, expected finite columns that change; leave out a "
                "constant one, it carries no information"
            )
        return cls(low, high)

    @property
    def span(self) -> FloatArray:
        """high - low, (d,), in the columns' own units."""
        return self.high - self.low

    def normalise(self, x: FloatArray) -> FloatArray:
        """(N, d) or, for one column, (N,): the same shape, dimensionless, not clipped."""
        return (x - self.low) / self.span

    def denormalise(self, x: FloatArray) -> FloatArray:
        """The inverse of ``normalise``."""
        return self.low + x * self.span


# --- Forward models.

#: The chapter's starting values, with one width for both inputs, and the optimum that they lead to.
CHAPTER_INFERENCE = InferenceConfig(method="three_level", ard=False, starts=((100.0, 1.0),), scan_rows=0)
#: Memory of the forward model; it has more plays than the served inverse, because the commanded voltage has no noise.
MEMORY = IdentifyConfig(plays=20, slow=4, kernel_plays=3, arcs=(0.03, 0.1, 0.3, 0.8))
#: Its inference: one width for all inputs, because the small residual would let single widths fit noise.
MEMORY_INFERENCE = InferenceConfig(ard=False, width_range=(0.1, 50.0))
#: Least noise of the linear part, as a share of the range.
_FLOOR = 1e-4


def two_inputs(u_V: FloatArray) -> FloatArray:
    """(n, 2): voltage V and its backward difference V/s (2.41) of (n,) samples 0.02 s apart."""
    return np.column_stack([u_V, backward_difference(u_V, DT_S * EVERY)])


@dataclass(frozen=True, slots=True)
class TwoInputLssvm:
    """The chapter's forward model. ``evidence``: that of its hyper-parameters, None where these were given."""

    model: LssvmModel
    inputs: MinMaxScaling
    output: MinMaxScaling
    evidence: Evidence | None
    leave_one_out_um: float

    def predict(self, u_V: FloatArray) -> FloatArray:
        """Displacement µm of every `EVERY`-th of the voltages ``u_V`` (n,), 1 ms apart."""
        rows = two_inputs(np.ascontiguousarray(u_V[::EVERY]))
        return self.output.denormalise(self.model.predict(self.inputs.normalise(rows)))


def fit_two_inputs(u_V: FloatArray, y_um: FloatArray, hyper: tuple[float, float] | None = None) -> TwoInputLssvm:
    """From (n,) voltages and displacements 0.02 s apart; ``hyper`` = (gamma, sigma) skips the inference.

    Raises InputError on shapes, NumericsError where the evidence cannot be evaluated.
    """
    rows = two_inputs(u_V)
    inputs, output = MinMaxScaling.fit(rows), MinMaxScaling.fit(y_um)
    X, target = inputs.normalise(rows), output.normalise(y_um)
    found = None
    if hyper is None:
        found = infer(evidence_samples(X, target), CHAPTER_INFERENCE).best
        gamma, widths = found.gamma, found.widths
    else:
        gamma, widths = hyper[0], np.full(2, hyper[1])
    fit = lssvm.fit(X, target, widths, gamma)
    left_out = float(np.sqrt(np.mean(fit.leave_one_out() ** 2)) * output.span[0])
    return TwoInputLssvm(fit.model, inputs, output, found, left_out)


@dataclass(frozen=True, slots=True)
class MemoryLssvm:
    """Forward model with memory: ``y = beta' basis + kernel part``, features of the voltage at 1 ms."""

    features: FeatureMap
    beta: FloatArray
    kernel: LssvmModel
    evidence: Evidence

    def predict(self, u_V: FloatArray) -> FloatArray:
        """Displacement µm of every `EVERY`-th of the voltages ``u_V`` (n,), 1 ms apart, from rest at 0 V."""
        basis, kernel = _features(self.features, u_V)
        return np.asarray(basis @ self.beta + self.kernel.predict(kernel), dtype=np.float64)


def _motion(u_V: FloatArray) -> FloatArray:
    """(n, 3) voltage V and its derivatives V/s, V/s², of a commanded voltage without noise."""
    rate = np.gradient(u_V, DT_S)
    return np.column_stack([u_V, rate, np.gradient(rate, DT_S)])


def _features(features: FeatureMap, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
    u, rate, second = (np.ascontiguousarray(column) for column in _motion(u_V).T)
    basis, kernel, _ = features.run(u, rate, second, features.rest_memory(0.0))
    return np.ascontiguousarray(basis[::EVERY]), np.ascontiguousarray(kernel[::EVERY])


def fit_memory(u_fine_V: FloatArray, y_um: FloatArray) -> MemoryLssvm:
    """From the commanded voltage (m,), 1 ms apart, and displacements (ceil(m/20),), 0.02 s apart.

    Raises InputError where the lengths do not fit together.
    """
    if y_um.shape != u_fine_V[::EVERY].shape:
        raise InputError(f"y_um: got {y_um.shape}, expected {u_fine_V[::EVERY].shape}: one for {EVERY} of u_fine_V")
    # Thresholds and scales come from the voltage, which has the role of the displacement in the inverse.
    features = replace(design_features(_motion(u_fine_V), DT_S, MEMORY, True), y_rest_um=0.0)
    basis, kernel = _features(features, u_fine_V)
    span = float(np.ptp(y_um))
    deviations = prior_deviations(features, span)
    beta, _ = linear_posterior(basis, y_um, deviations, float(np.var(y_um)) * 1e-4, _FLOOR * span)
    rest = y_um - basis @ beta
    scale = max(float(np.std(rest)), 1e-12)
    evidence = infer(evidence_samples(kernel, rest / scale), MEMORY_INFERENCE).best
    fit = lssvm.fit(kernel, rest / scale, evidence.widths, evidence.gamma)
    rescaled = replace(
        fit.model, alpha=fit.model.alpha * scale, bias=fit.model.bias * scale, scale=fit.model.scale * scale**2
    )
    return MemoryLssvm(features, beta, rescaled, evidence)
