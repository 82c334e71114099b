"""Identification of an inverse LSSVM from a recording, with a report of its errors.

``inputs="two"`` is the chapter's model: displacement and its backward difference after a zero-phase 50 Hz low-pass, a
bias, and a radial kernel. ``inputs="memory"`` is the default of the service: a linear part of motion, play operators
and slow states, plus a kernel for its residual. A Gaussian prior makes sure that a short recording determines the
coefficients of the linear part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive import lssvm
from dehyst.adaptive.errors import InputError
from dehyst.adaptive.features import FeatureMap, gram
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.smoothing import SmootherConfig, backward_difference, smooth_recording, zero_phase_lowpass
from dehyst.adaptive.tuning import evidence
from dehyst.adaptive.tuning.search import InferenceConfig, infer
from dehyst.adaptive.types import FloatArray

# --- Settings.


@dataclass(frozen=True, slots=True)
class IdentifyConfig:
    """Settings of `identify_lssvm`.

    n : number of support vectors. plays : number of play operators, with log-spaced thresholds.
    slow, slow_max_s : number of slow states, and the largest of their log-spaced time constants, s (smallest: 0.1 s).
    arcs : path lengths of the arc states, as shares of the displacement range.
    asymmetric : add the products of plays and displacement.
    kernel_plays : number of plays among the kernel inputs.
    heldout : share of the recording, at its end, that is used for the scores only.
    rows : most samples that enter the fits. Of a longer recording every k-th one is used; the hysteresis memory still
    sees every sample.
    cutoff_hz : of the smoother. tune : choose gamma and widths by the evidence; otherwise use ``gamma`` and ``width``.
    """

    n: int = 500
    plays: int = 24
    slow: int = 6
    slow_max_s: float = 100.0
    arcs: tuple[float, ...] = (0.05, 0.15, 0.45)
    asymmetric: bool = True
    kernel_plays: int = 3
    heldout: float = 0.25
    rows: int = 100_000
    cutoff_hz: float = 80.0
    tune: bool = True
    gamma: float = 1e2
    width: float = 4.0

    def __post_init__(self) -> None:
        if self.n < 10:
            raise InputError(f"n: got {self.n}, expected at least 10 support vectors")
        if self.rows < 100:
            raise InputError(f"rows: got {self.rows}, expected at least 100 samples")
        if not 0.0 < self.heldout < 0.9:
            raise InputError(f"heldout: got {self.heldout}, expected a share between 0 and 0.9")
        if not 0 <= self.kernel_plays <= self.plays:
            raise InputError(f"kernel_plays: got {self.kernel_plays}, expected 0 to {self.plays}")


# --- Fit: first the linear part with its Gaussian prior, then the kernel on the residual of a subset of the samples.
# Gamma and the widths maximise the evidence; beside a linear part gamma is limited.


#: Prior standard deviations of the linear part, as shares of the voltage range.
PRIOR_FREE, PRIOR_POWER, PRIOR_PLAY, PRIOR_PRODUCT, PRIOR_ARC, PRIOR_SLOW = 10.0, 0.1, 0.05, 0.01, 0.03, 0.03
#: Prior standard deviations of a stage's lag and of 1/omega of its first mode, s; 0.8 ms is a mode of 200 Hz.
PRIOR_LAG_S, PRIOR_INERTIA_S = 5e-3, 8e-4
#: Correlation time of the model error, s: samples within this time count as one measurement.
CORRELATION_S = 0.03
#: Largest gamma for the residual of a linear part. The evidence takes the rows for independent, but the residual of one
#: pass is smooth in time even where the next pass has another one. Left alone it fits each pass with narrow kernels and
#: a large gamma, and the kernel part is then wrong on other motion. At 6 and below, stated deviations
#: outside the learnt range become too small.
GAMMA_MAX = 8.0
#: Smallest model error assumed for the linear part, as a share of the voltage range.
ERROR_FLOOR = 5e-4
#: Number of rows for the evidence, and the search ranges. A gamma above 1e5 only loses precision; with a width below
#: 0.3 the kernel does not interpolate between the samples.
EVIDENCE_ROWS = 240
SEARCH = InferenceConfig(
    starts=((100.0, 1.0), (100.0, 4.0)), gamma_range=(1.0, 1e5), width_range=(0.3, 12.0), iterations=20
)


def prior_deviations(features: FeatureMap, u_range_V: float) -> FloatArray:
    """(p,) prior standard deviations of the linear part, V per normalised input."""
    plays = len(features.thresholds_um)
    # A lag and a mode of a stage have times of their own: what they add grows with the motion, not with its recording.
    range_um = features.y_max_um - features.y_min_um
    lag = PRIOR_LAG_S * features.v_scale_um_per_s / range_um
    inertia = PRIOR_INERTIA_S**2 * features.a_scale_um_per_s2 / range_um
    shares = [PRIOR_FREE, PRIOR_FREE, lag, inertia, PRIOR_POWER, PRIOR_POWER]
    shares += [PRIOR_PLAY] * plays + [PRIOR_PRODUCT] * (plays * features.asymmetric)
    shares += [PRIOR_ARC] * len(features.arc_lengths_um) + [PRIOR_SLOW] * len(features.time_constants_s)
    return u_range_V * np.array(shares)


@dataclass(frozen=True, slots=True)
class Fit:
    """Fitted coefficients.

    beta (p,), covariance (p, p) : linear part, V per normalised input, and its covariance, V².
    support (n, d), alpha (n,) : support vectors and their weights.
    noise_variance : mean square leave-one-out error, V². kernel_variance : scale of the kernel, V².
    """

    beta: FloatArray
    covariance: FloatArray
    support: FloatArray
    alpha: FloatArray
    noise_variance: float
    kernel_variance: float


def linear_posterior(
    basis: FloatArray, target: FloatArray, deviations: FloatArray, variance: float, floor: float, repeats: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean (p,) and covariance (p, p) of a linear model of ``basis`` (n, p) and ``target`` (n,).

    The prior has the standard ``deviations`` (p,). The noise is that of the residual, at least ``floor``; ``variance``
    is its first guess. So many ``repeats`` of samples count as one measurement.
    """
    precision, gram, moment = np.diag(deviations**-2.0), basis.T @ basis, basis.T @ target
    beta: FloatArray = np.zeros(basis.shape[1])
    information = precision
    for _ in range(4):
        information = precision + gram / (variance * repeats)
        beta = np.asarray(np.linalg.solve(information, moment / (variance * repeats)), dtype=np.float64)
        variance = max(float(np.mean((target - basis @ beta) ** 2)), floor**2)
    covariance = np.linalg.inv(information)
    return beta, np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)


def _linear(features: FeatureMap, basis: FloatArray, u_V: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Coefficients (p,) and covariance (p, p) of the linear part of an inverse model."""
    u_range_V = float(np.ptp(u_V))
    deviations, floor = prior_deviations(features, u_range_V), ERROR_FLOOR * u_range_V
    return linear_posterior(basis, u_V, deviations, (0.01 * u_range_V) ** 2, floor, max(1.0, CORRELATION_S / dt_s))


def select(kernel: FloatArray, widths: FloatArray, n: int) -> NDArray[np.int64]:
    """Indices of at most n rows of the kernel inputs (m, d), evenly in time and by farthest-point sampling.

    Deterministic. ``widths`` (d,) scale the distances.
    """
    m = kernel.shape[0]
    if n >= m:
        return np.arange(m)
    scaled = kernel / widths
    chosen = np.empty(n, dtype=np.int64)
    # The first half evenly in time, so that their density follows the recording; the others by largest distance.
    chosen[: n // 2] = np.linspace(0, m - 1, n // 2).astype(np.int64)
    distance = np.full(m, np.inf)
    for k in range(n):
        if k >= n // 2:
            chosen[k] = int(np.argmax(distance))
        difference = scaled - scaled[chosen[k]]
        np.minimum(distance, np.einsum("ij,ij->i", difference, difference), out=distance)
    return np.unique(chosen)


def tune(
    features: FeatureMap,
    basis: FloatArray,
    kernel: FloatArray,
    u_V: FloatArray,
    dt_s: float,
    config: IdentifyConfig,
) -> tuple[float, FloatArray]:
    """(gamma, widths (d,)) by the evidence of the kernel part: basis (n, p), inputs (n, d), u_V (n,).

    Beside a linear part gamma is at most ``GAMMA_MAX``.
    """
    target = u_V
    if features.linear:
        beta, _ = _linear(features, basis, u_V, dt_s)
        target = u_V - basis @ beta
    rows = select(kernel, np.ones(kernel.shape[1]), config.n)
    gamma, widths = evidence_search(kernel[rows], target[rows])
    return min(gamma, GAMMA_MAX) if features.linear else gamma, widths


def fit_model(
    features: FeatureMap,
    basis: FloatArray,
    kernel: FloatArray,
    u: FloatArray,
    dt_s: float,
    config: IdentifyConfig,
    gamma: float,
    widths: FloatArray,
) -> Fit:
    """Fit the model to basis (n, p), kernel inputs (n, d) and voltages (n,), V, with given gamma and widths (d,)."""
    rows = select(kernel, widths, config.n)
    beta, covariance, target = np.zeros(1), np.empty((0, 0)), u[rows]
    if features.linear:
        beta, covariance = _linear(features, basis, u, dt_s)
        target = target - basis[rows] @ beta
    fit = lssvm.fit(kernel[rows], target, widths, gamma)
    beta[0] += fit.model.bias
    left_out = fit.leave_one_out()
    return Fit(beta, covariance, fit.model.X, fit.model.alpha, float(np.mean(left_out**2)), fit.model.scale)


def evidence_search(kernel: FloatArray, target: FloatArray) -> tuple[float, FloatArray]:
    """(gamma, widths (d,)) with the largest evidence for kernel inputs (n, d) and targets (n,).

    At most ``EVIDENCE_ROWS`` evenly spaced rows are used. The targets are normalised, so that the search ranges do not
    depend on the voltage range.
    """
    step = max(1, -(-target.size // EVIDENCE_ROWS))
    spread = float(np.std(target)) or 1.0
    data = evidence.evidence_samples(kernel[::step], (target[::step] - float(np.mean(target))) / spread)
    best = infer(data, SEARCH).best
    return float(best.gamma), np.array(best.widths, dtype=np.float64)


# --- Report and result.


@dataclass(frozen=True, slots=True)
class IdentificationReport:
    """Result of an identification. Errors are voltage errors of the inverse model; ``_pct`` : of the voltage range.

    train : errors on the first part of the recording. heldout : errors of a free run over the last part, with a model
    that was fitted to the first part only. heldout_rmse_um : the rms voltage error times the mean gain.
    heldout_u_V, heldout_model_V : (m,) applied and modelled voltage of the last part.
    """

    samples: int
    support: int
    y_range_um: float
    u_range_V: float
    gamma: float
    widths: tuple[float, ...]
    train_mae_pct: float
    heldout_mae_pct: float
    heldout_rmse_pct: float
    heldout_rmse_um: float
    heldout_u_V: FloatArray
    heldout_model_V: FloatArray


Inputs = Literal["two", "memory"]

#: Dead band of the arc states, in standard deviations of the noise that the smoother removes.
DEAD_SIGMA = 4.0
#: Smallest and largest play threshold, as shares of the displacement range.
THRESHOLD_MIN, THRESHOLD_MAX = 0.006, 0.45


def identify_lssvm(
    u_V: FloatArray,
    y_um: FloatArray,
    dt_s: float,
    inputs: Inputs = "memory",
    config: IdentifyConfig | None = None,
    name: str | None = None,
) -> tuple[LssvmInverse, IdentificationReport]:
    """Identify the inverse model of a stage from (n,) voltages and displacements, ``dt_s`` apart.

    Raises InputError on wrong shapes, non-finite values, fewer than 100 samples, or a stage that did not move.
    """
    config = config or IdentifyConfig()
    u, y = np.ascontiguousarray(u_V, dtype=np.float64), np.ascontiguousarray(y_um, dtype=np.float64)
    if u.ndim != 1 or u.shape != y.shape or not (np.all(np.isfinite(u)) and np.all(np.isfinite(y))):
        raise InputError(f"u_V, y_um: got shapes {u.shape}, {y.shape}, expected equal (n,) of finite values")
    if u.size < 100:
        raise InputError(f"u_V: got {u.size} samples, expected at least 100; record longer")
    if np.ptp(u) <= 0.0 or np.ptp(y) <= 0.0:
        raise InputError("u_V, y_um: constant, expected a moving stage; excite it over its range")
    if inputs not in ("two", "memory"):
        raise InputError(f"inputs: got {inputs!r}, expected 'two' or 'memory'")
    memory, taught = inputs == "memory", u
    if memory:
        # The voltage is smoothed in the same way: it must not keep what the smoother takes from the motion.
        smoother = SmootherConfig.for_rate(dt_s, config.cutoff_hz)
        motion, taught = smooth_recording(y, smoother), np.ascontiguousarray(smooth_recording(u, smoother)[:, 0])
    else:
        smooth = zero_phase_lowpass(y, dt_s)
        motion = np.column_stack([smooth, backward_difference(smooth, dt_s), np.zeros_like(smooth)])
    features = design_features(motion, dt_s, config, memory)
    if memory:
        features = replace(features, dead_um=DEAD_SIGMA * float(np.std(y - motion[:, 0])))
    columns = [np.ascontiguousarray(motion[:, i]) for i in range(3)]
    every = -(-u.size // config.rows)
    basis, kernel = _rows(features, columns, every)
    samples, u, taught, dt_s = u.size, u[::every], taught[::every], dt_s * every
    split = round(u.size * (1.0 - config.heldout))
    hyper = tune(features, basis, kernel, taught, dt_s, config) if config.tune else None
    gamma = hyper[0] if hyper else config.gamma
    widths = hyper[1] if hyper else np.full(features.kernel_size, config.width)
    trial = fit_model(features, basis[:split], kernel[:split], taught[:split], dt_s, config, gamma, widths)
    predicted = basis @ trial.beta + gram(kernel, trial.support, widths) @ trial.alpha
    u_range, y_range = float(np.ptp(u)), float(np.ptp(y))
    errors = predicted - u
    rmse_V = float(np.sqrt(np.mean(errors[split:] ** 2)))
    full = fit_model(features, basis, kernel, taught, dt_s, config, gamma, widths)
    report = IdentificationReport(
        samples=samples,
        support=full.support.shape[0],
        y_range_um=y_range,
        u_range_V=u_range,
        gamma=gamma,
        widths=tuple(float(w) for w in widths),
        train_mae_pct=100.0 * float(np.mean(np.abs(errors[:split]))) / u_range,
        heldout_mae_pct=100.0 * float(np.mean(np.abs(errors[split:]))) / u_range,
        heldout_rmse_pct=100.0 * rmse_V / u_range,
        heldout_rmse_um=rmse_V * y_range / u_range,
        heldout_u_V=u[split:].copy(),
        heldout_model_V=np.asarray(predicted[split:], dtype=np.float64),
    )
    domain = np.array([bound for x in columns for bound in (x.min(), x.max())])
    model = LssvmInverse(
        name=name or ("lssvm_adaptive" if memory else "lssvm_frozen"),
        features=features,
        beta=full.beta,
        support=full.support,
        alpha=full.alpha,
        widths=widths,
        gamma=gamma,
        domain=domain,
        # Answers are voltages as they are applied: what the smoother has taken from them is an error too.
        noise_variance=full.noise_variance + float(np.mean((u - taught) ** 2)),
        kernel_variance=full.kernel_variance,
        beta_covariance=full.covariance,
        span_V=u_range,
    )
    return model, report


def _rows(features: FeatureMap, columns: list[FloatArray], every: int) -> tuple[FloatArray, FloatArray]:
    """Basis and kernel inputs of every ``every``-th sample of the motion; the memory runs through all of them."""
    y, v, a = columns
    memory = features.rest_memory(float(y[0]))
    if every == 1:
        basis, kernel, _ = features.run(y, v, a, memory)
        return basis, kernel
    # In pieces: the inputs of all samples may take more memory than there is.
    size = every * max(1, 20_000 // every)
    parts = []
    for start in range(0, y.size, size):
        part = slice(start, start + size)
        basis, kernel, memory = features.run(y[part], v[part], a[part], memory)
        parts.append((basis[::every], kernel[::every]))
    return np.concatenate([basis for basis, _ in parts]), np.concatenate([kernel for _, kernel in parts])


def design_features(motion: FloatArray, dt_s: float, config: IdentifyConfig, memory: bool) -> FeatureMap:
    """Feature map for a recording: ranges from its (n, 3) motion, thresholds as shares of the displacement range."""
    y = motion[:, 0]
    span = float(np.ptp(y))
    plain = FeatureMap(
        dt_s=dt_s,
        y_min_um=float(y.min()),
        y_max_um=float(y.max()),
        v_scale_um_per_s=max(float(np.abs(motion[:, 1]).max()), 1e-9 * span),
        # The measured peak depends on the noise. Therefore: the acceleration of a 10 Hz sine over the whole range.
        a_scale_um_per_s2=0.5 * span * (2.0 * np.pi * min(10.0, 0.05 / dt_s)) ** 2,
        linear=False,
        y_rest_um=float(y[0]),
    )
    if not memory:
        return plain
    thresholds = span * np.geomspace(THRESHOLD_MIN, THRESHOLD_MAX, config.plays)
    seen = np.unique(np.round(np.linspace(0, config.plays - 1, config.kernel_plays + 2)[1:-1]).astype(int))
    shortest = max(0.1, 10.0 * dt_s)
    return replace(
        plain,
        linear=True,
        asymmetric=config.asymmetric,
        thresholds_um=tuple(float(r) for r in thresholds),
        arc_lengths_um=tuple(span * share for share in config.arcs),
        time_constants_s=tuple(float(t) for t in np.geomspace(shortest, config.slow_max_s, config.slow)),
        kernel_plays=tuple(int(k) for k in seen),
    )
