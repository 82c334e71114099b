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
from dehyst.adaptive.identification import IdentifyConfig, design_features, prior_deviations
from dehyst.adaptive.lssvm import LssvmModel
from dehyst.adaptive.smoothing import backward_difference
from dehyst.adaptive.tuning.evidence import Evidence, evidence_samples
from dehyst.adaptive.tuning.search import InferenceConfig, infer
from dehyst.adaptive.types import FloatArray, StateDict
from dehyst.sim.chapter.experiments import DT_S, EVERY

# --- Min-max normalisation of features and targets, (2.42), with its inverse.


@dataclass(frozen=True, slots=True)
class MinMaxScaling:
    """x_n = (x - low) / (high - low), per column; physical units outside, dimensionless inside.

    Attributes
    ----------
    low, high : (d,) the values that map to 0 and 1, in the columns' own units; ``high > low``.
    """

    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        low = np.atleast_1d(np.asarray(self.low, dtype=np.float64))
        high = np.atleast_1d(np.asarray(self.high, dtype=np.float64))
        if low.ndim != 1 or low.shape != high.shape:
            raise InputError(f"scaling: low {low.shape} and high {high.shape} must be vectors of one length")
        if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(high > low)):
            raise InputError(
                f"scaling: got low {low.tolist()}, high {high.tolist()}, expected finite low < high in every column; "
                "a constant feature carries no information, leave it out"
            )
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @classmethod
    def fit(cls, data: FloatArray, margin: float = 0.0) -> MinMaxScaling:
        """From samples (N, d) or (N,): minimum and maximum, (2.42), widened by ``margin`` of the range each way."""
        table = np.asarray(data, dtype=np.float64)
        table = table[:, None] if table.ndim == 1 else table
        if table.ndim != 2 or table.shape[0] == 0 or not np.all(np.isfinite(table)):
            raise InputError(f"data: got shape {table.shape}, expected (N, d) finite samples, N >= 1; drop the others")
        low, high = table.min(axis=0), table.max(axis=0)
        widen = margin * (high - low)
        return cls(low - widen, high + widen)

    @property
    def dimension(self) -> int:
        """Number of columns d."""
        return int(self.low.size)

    @property
    def span(self) -> FloatArray:
        """high - low, (d,), in the columns' own units."""
        return self.high - self.low

    def normalise(self, x: FloatArray) -> FloatArray:
        """(N, d), (d,) or, for one column, (N,): the same shape, dimensionless, not clipped."""
        return np.asarray((x - self._fit_to(x, self.low)) / self._fit_to(x, self.span), dtype=np.float64)

    def denormalise(self, x: FloatArray) -> FloatArray:
        """The inverse of ``normalise``."""
        return np.asarray(self._fit_to(x, self.low) + x * self._fit_to(x, self.span), dtype=np.float64)

    def state_dict(self) -> StateDict:
        """Two arrays; ``from_state`` builds an equal scaling."""
        return {"low": self.low.copy(), "high": self.high.copy()}

    @classmethod
    def from_state(cls, state: StateDict) -> MinMaxScaling:
        return cls(np.asarray(state["low"], dtype=np.float64), np.asarray(state["high"], dtype=np.float64))

    def _fit_to(self, x: FloatArray, row: FloatArray) -> FloatArray | float:
        shape = np.shape(x)
        if self.dimension == 1 and (not shape or shape[-1] != 1 or len(shape) == 1):
            return float(row[0])
        if not shape or shape[-1] != self.dimension:
            raise InputError(
                f"x: got shape {shape}, expected {self.dimension} columns, those the scaling was fitted on"
            )
        return row


# --- Forward models.

#: The chapter's starting values, with one width for both inputs, and the optimum that they lead to.
CHAPTER_INFERENCE = InferenceConfig(method="three_level", ard=False, starts=((100.0, 1.0),), scan_rows=0)
#: Memory of the forward model; it has more plays than the served inverse, because the commanded voltage has no noise.
MEMORY = IdentifyConfig(plays=20, slow=4, kernel_plays=3, arcs=(0.03, 0.1, 0.3, 0.8))
#: Its inference: one width for all inputs, because the small residual would let single widths fit noise.
MEMORY_INFERENCE = InferenceConfig(ard=False, width_range=(0.1, 50.0))
#: Least noise of the linear part, as a share of the range, and rounds of its estimation.
_FLOOR, _ROUNDS = 1e-4, 4


def two_inputs(u_V: FloatArray, dt_s: float = DT_S * EVERY) -> FloatArray:
    """(n, 2): voltage V and its backward difference V/s (2.41) of (n,) samples ``dt_s`` apart."""
    return np.column_stack([u_V, backward_difference(u_V, dt_s)])


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


def fit_two_inputs(
    u_V: FloatArray, y_um: FloatArray, hyper: tuple[float, float] | None = None, config: InferenceConfig | None = None
) -> TwoInputLssvm:
    """From (n,) voltages and displacements 0.02 s apart; ``hyper`` = (gamma, sigma) skips the inference.

    Raises InputError on shapes, NumericsError where the evidence cannot be evaluated.
    """
    rows = two_inputs(u_V)
    inputs, output = MinMaxScaling.fit(rows), MinMaxScaling.fit(y_um)
    X, target = inputs.normalise(rows), output.normalise(y_um)
    found = None
    if hyper is None:
        found = infer(evidence_samples(X, target), config or CHAPTER_INFERENCE).best
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

    def _inputs(self, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _features(self.features, u_V)

    def predict(self, u_V: FloatArray) -> FloatArray:
        """Displacement µm of every `EVERY`-th of the voltages ``u_V`` (n,), 1 ms apart, from rest at 0 V."""
        basis, kernel = self._inputs(u_V)
        return np.asarray(basis @ self.beta + self.kernel.predict(kernel), dtype=np.float64)


def _motion(u_V: FloatArray) -> FloatArray:
    """(n, 3) voltage V and its derivatives V/s, V/s², of a commanded voltage without noise."""
    rate = np.gradient(u_V, DT_S)
    return np.column_stack([u_V, rate, np.gradient(rate, DT_S)])


def _features(features: FeatureMap, u_V: FloatArray) -> tuple[FloatArray, FloatArray]:
    u, rate, second = (np.ascontiguousarray(column) for column in _motion(u_V).T)
    basis, kernel, _ = features.run(u, rate, second, features.rest_memory(0.0))
    return np.ascontiguousarray(basis[::EVERY]), np.ascontiguousarray(kernel[::EVERY])


def posterior_mean(basis: FloatArray, target: FloatArray, deviations: FloatArray, floor: float) -> FloatArray:
    """(p,) posterior mean of a linear model under a Gaussian prior with standard ``deviations`` (p,).

    ``basis`` (n, p), ``target`` (n,). The noise is estimated from the residual and is at least ``floor``.
    """
    gram, moment = basis.T @ basis, basis.T @ target
    variance = float(np.var(target)) * 1e-4
    beta: FloatArray = np.zeros(basis.shape[1])
    for _ in range(_ROUNDS):
        information = np.diag(deviations**-2.0) + gram / variance
        beta = np.asarray(np.linalg.solve(information, moment / variance), dtype=np.float64)
        variance = max(float(np.mean((target - basis @ beta) ** 2)), floor * floor)
    return beta


def fit_memory(u_fine_V: FloatArray, y_um: FloatArray, config: IdentifyConfig = MEMORY) -> MemoryLssvm:
    """From the commanded voltage (m,), 1 ms apart, and displacements (ceil(m/20),), 0.02 s apart.

    Raises InputError where the lengths do not fit together.
    """
    if y_um.shape != u_fine_V[::EVERY].shape:
        raise InputError(f"y_um: got {y_um.shape}, expected {u_fine_V[::EVERY].shape}: one for {EVERY} of u_fine_V")
    # Thresholds and scales come from the voltage, which has the role of the displacement in the inverse.
    features = replace(design_features(_motion(u_fine_V), DT_S, config, True), y_rest_um=0.0)
    basis, kernel = _features(features, u_fine_V)
    span = float(np.ptp(y_um))
    beta = posterior_mean(basis, y_um, prior_deviations(features, span), _FLOOR * span)
    rest = y_um - basis @ beta
    scale = max(float(np.std(rest)), 1e-12)
    evidence = infer(evidence_samples(kernel, rest / scale), MEMORY_INFERENCE).best
    fit = lssvm.fit(kernel, rest / scale, evidence.widths, evidence.gamma)
    rescaled = replace(
        fit.model, alpha=fit.model.alpha * scale, beta=fit.model.beta * scale, scale=fit.model.scale * scale**2
    )
    return MemoryLssvm(features, beta, rescaled, evidence)
