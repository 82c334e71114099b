"""Identification: a recording in, an inverse LSSVM and what is to be said of it out.

``inputs="two"`` is the chapter: displacement and its backward difference after a zero-phase 50 Hz low-pass, a bias,
a radial kernel. ``inputs="memory"`` is what is served by default: a linear part over motion, play operators and slow
states with a Gaussian prior (so that a short recording can't drive twenty coefficients wild), and a kernel for what
is left of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from adaptive import kernels
from adaptive.errors import InputError
from adaptive.features import FeatureMap
from adaptive.identification_config import IdentifyConfig
from adaptive.identification_fit import fit_model, tune
from adaptive.identification_report import IdentificationReport
from adaptive.smoothing import SmootherConfig, backward_difference, smooth_recording, zero_phase_lowpass
from adaptive.snapshot import LssvmInverse
from adaptive.types import FloatArray

Inputs = Literal["two", "memory"]

#: Dead band of the arc states' path, in standard deviations of what the smoother takes out.
DEAD_SIGMA = 4.0
#: Play thresholds as shares of the displacement range: log-spaced between these.
THRESHOLD_MIN, THRESHOLD_MAX = 0.006, 0.45


def identify_lssvm(
    u_V: FloatArray,
    y_um: FloatArray,
    dt_s: float,
    inputs: Inputs = "memory",
    config: IdentifyConfig | None = None,
    name: str | None = None,
) -> tuple[LssvmInverse, IdentificationReport]:
    """Identify the inverse model of a stage from (n,) voltages and displacements ``dt_s`` apart.

    Raises InputError on shapes, non-finite values, too short a recording, or a stage that did not move.
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
    memory = inputs == "memory"
    if memory:
        motion = smooth_recording(y, SmootherConfig.for_rate(dt_s, config.cutoff_hz))
    else:
        smooth = zero_phase_lowpass(y, dt_s)
        motion = np.column_stack([smooth, backward_difference(smooth, dt_s), np.zeros_like(smooth)])
    features = design_features(motion, dt_s, config, memory)
    if memory:
        features = replace(features, dead_um=DEAD_SIGMA * float(np.std(y - motion[:, 0])))
    columns = [np.ascontiguousarray(motion[:, i]) for i in range(3)]
    basis, kernel, _ = features.run(columns[0], columns[1], columns[2], features.rest_memory(float(columns[0][0])))
    split = round(u.size * (1.0 - config.heldout))
    hyper = tune(features, basis, kernel, u, dt_s, config) if config.tune else None
    gamma = hyper[0] if hyper else config.gamma
    widths = hyper[1] if hyper else np.full(features.kernel_size, config.width)
    trial = fit_model(features, basis[:split], kernel[:split], u[:split], dt_s, config, gamma, widths)
    predicted = basis @ trial.beta + kernels.gram(kernel, trial.support, widths) @ trial.alpha
    u_range, y_range = float(np.ptp(u)), float(np.ptp(y))
    errors = predicted - u
    rmse_V = float(np.sqrt(np.mean(errors[split:] ** 2)))
    full = fit_model(features, basis, kernel, u, dt_s, config, gamma, widths)
    report = IdentificationReport(
        samples=u.size,
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
        noise_variance=full.noise_variance,
        kernel_variance=full.kernel_variance,
        beta_covariance=full.covariance,
        span_V=u_range,
    )
    return model, report


def design_features(motion: FloatArray, dt_s: float, config: IdentifyConfig, memory: bool) -> FeatureMap:
    """The map for a recording: ranges from its (n, 3) motion, thresholds as shares of the displacement range."""
    y = motion[:, 0]
    span = float(np.ptp(y))
    plain = FeatureMap(
        dt_s=dt_s,
        y_min_um=float(y.min()),
        y_max_um=float(y.max()),
        v_scale_um_per_s=max(float(np.abs(motion[:, 1]).max()), 1e-9 * span),
        # A share of the recording's peak would follow its noise; 10 Hz over the whole range is a scale, no limit.
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
