"""Identification of the Bouc-Wen stage (2.3) by bounded least squares from several starts.

For given hysteresis (alpha, beta, gamma) and modes (b/k, m/k) the displacement is linear in d, in the offset and in
the size of the initial transient. These three are solved for exactly inside the cost (variable projection). Five
unknowns remain, in a space where every point is a stage that can be inverted:

    alpha = 0.98 share/max(1, 2 rho),   beta = rho lambda,   gamma = (1 - rho) lambda,   log lambda, log b/k, log m/k

A recording shows m/k and b/k only, never m, b, k alone; the stiffness is that of Table 2.1. For an overdamped stage
sampled more slowly than its fast mode, it does not show m/k either. m/k is therefore kept only where the fit is
significantly worse without it. Otherwise it is set to the negligible value of Table 2.1, because the inverse
multiplies it by accelerations far above those of the recording.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult, least_squares

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse, BoucWenParameters
from dehyst.baselines.bouc_wen.step import hysteresis_step, poles, run_stage, settled
from dehyst.baselines.common import FitReport, checked_recording

#: Bounds of share, rho, log lambda (1/V), log b/k (s), log m/k (s²), initial hysteresis as a share of its limit.
_LOWER = np.array([0.0, 0.02, math.log(1e-3), math.log(1e-6), math.log(1e-13), -1.0])
_UPPER = np.array([1.0, 3.0, math.log(50.0), math.log(0.5), math.log(1e-2), 1.0])
#: Starts: the chapter's result, and values for loops of other shapes.
_STARTS = (
    (0.49, 0.47, math.log(1.86), math.log(2.5e-3), math.log(8e-10)),
    (0.30, 0.50, math.log(0.5), math.log(5e-4), math.log(1e-8)),
    (0.25, 0.90, math.log(5.0), math.log(1e-3), math.log(3e-7)),
    (0.60, 0.30, math.log(0.15), math.log(1e-2), math.log(1e-9)),
)
#: Logarithm of a negligible m/k (s²), that of Table 2.1.
_NEGLIGIBLE_INERTIA = math.log(TABLE_2_1.inertia_s2)
#: Least rise of the squared error, in units of the residual's variance, for which m/k is kept.
_SIGNIFICANT = 12.0
_SEARCH_SAMPLES = 1500
_SEARCH_DT_S = 0.004


def _unpack(theta: FloatArray) -> tuple[FloatArray, float, float]:
    """(alpha, beta, gamma), lag s, inertia s² of the unknowns (5,) or (6,)."""
    rho, rate = float(theta[1]), math.exp(theta[2])
    alpha = 0.98 * float(theta[0]) / max(1.0, 2.0 * rho)
    return np.array([alpha, rho * rate, (1.0 - rho) * rate]), math.exp(theta[3]), math.exp(theta[4])


class _Fit:
    """The residual of a recording as a function of the unknowns."""

    def __init__(self, u_V: FloatArray, y_um: FloatArray, dt_s: float, free_start: bool) -> None:
        self.u, self.y, self.dt, self.free_start = u_V, y_um, dt_s, free_start
        self.evaluations = 0
        self._out = np.empty((u_V.size, 3))
        self._t = np.arange(u_V.size) * dt_s

    def columns(self, theta: FloatArray) -> FloatArray:
        """(n, 3) columns: displacement for d = 1, constant, decay of the slow mode."""
        self.evaluations += 1
        shape, lag, inertia = _unpack(theta)
        u0 = float(self.u[0])
        if self.free_start:
            g = float(theta[5]) * shape[0] / (shape[1] + shape[2])
        else:
            g = hysteresis_step(0.0, u0, shape[0], shape[1], shape[2])
        p1, p2 = poles(lag, inertia)
        run_stage(self.u, self.dt, p1, p2, shape, True, settled(u0, g), self._out)
        decay = np.exp(np.maximum(p1.real * self._t, -700.0))
        return np.column_stack([self._out[:, 0], np.ones(self.u.size), decay])

    def project(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residual (n,) µm and the best coefficients d, offset, transient."""
        columns = self.columns(theta)
        coefficients = np.asarray(np.linalg.lstsq(columns, self.y, rcond=None)[0], dtype=np.float64)
        return columns @ coefficients - self.y, coefficients

    def residual(self, theta: FloatArray) -> FloatArray:
        """Residual (n,) µm."""
        return self.project(theta)[0]

    def solve(self, start: FloatArray, limit: int, inertia: bool = True) -> OptimizeResult:
        """Trust-region least squares within the bounds; without ``inertia`` m/k stays negligible."""
        theta = np.clip(start, _LOWER[: start.size] + 1e-9, _UPPER[: start.size] - 1e-9)
        free = np.ones(theta.size, dtype=np.bool_)
        if not inertia:
            free[4], theta[4] = False, _NEGLIGIBLE_INERTIA

        def residual(part: FloatArray) -> FloatArray:
            theta[free] = part
            return self.residual(theta)

        found = least_squares(
            residual,
            theta[free],
            bounds=(_LOWER[: theta.size][free], _UPPER[: theta.size][free]),
            x_scale=np.array([0.1, 0.1, 0.5, 0.5, 1.0, 0.5])[: theta.size][free],
            diff_step=1e-6,
            max_nfev=limit,
            xtol=1e-10,
            ftol=1e-10,
        )
        theta[free] = found.x
        return OptimizeResult(found, x=theta.copy())


def independent_samples(residual: FloatArray) -> float:
    """Number of independent samples in a residual, from its first autocorrelation.

    Model errors are not white: 10,000 samples of them may be worth ten.
    """
    centred = residual - residual.mean()
    power = float(centred @ centred)
    correlation = float(centred[1:] @ centred[:-1]) / power if power > 0.0 else 0.0
    return residual.size * (1.0 - correlation) / (1.0 + max(correlation, -0.9))


def identify_bouc_wen(u_V: ArrayLike, y_um: ArrayLike, dt_s: float) -> tuple[BoucWenParameters, FitReport]:
    """Bouc-Wen stage of a recording with the linear hold, by least squares.

    Parameters
    ----------
    u_V, y_um : (n,) voltage V and displacement µm, ``dt_s`` s apart, n >= 20.

    The initial hysteresis is an unknown where the first voltage is above 5 % of the largest; else the stage came
    monotonically from 0 V. m and b are expressed with the stiffness of Table 2.1: a recording does not show it.
    Returns the parameters and a report. Its errors are those with the initial transient and hysteresis that were
    found. Raises InputError on an unusable recording, and where displacement falls with voltage.
    """
    u, y, dt = checked_recording(u_V, y_um, dt_s, 20)
    free = abs(u[0]) > 0.05 * float(np.max(np.abs(u)))
    stride = max(1, min(u.size // _SEARCH_SAMPLES, int(_SEARCH_DT_S / dt)))
    thin = _Fit(u[::stride], y[::stride], dt * stride, free)
    extra = ((0.5 * math.copysign(1.0, u[0]),),) if free else ((),)
    found = [thin.solve(np.array([*start, *more]), 60) for start in _STARTS for more in extra]
    best = min(found, key=lambda result: float(result.cost))
    full = thin
    if stride > 1:
        full = _Fit(u, y, dt, free)
        best = full.solve(best.x, 25)
    without = full.solve(best.x, 25, inertia=False)
    if (without.cost - best.cost) * independent_samples(full.residual(best.x)) < _SIGNIFICANT * best.cost:
        best = without
    residual, (d, offset, transient) = full.project(best.x)
    if not d > 0.0:
        raise InputError(
            f"y_um: falls with the voltage (gain {d:.3g} µm/V), expected a rising one; check the sign and the columns"
        )
    shape, lag, inertia = _unpack(best.x)
    k_N_per_m = TABLE_2_1.k_N_per_m
    parameters = BoucWenParameters(
        m_kg=inertia * k_N_per_m,
        b_N_s_per_m=lag * k_N_per_m,
        k_N_per_m=k_N_per_m,
        d_um_per_V=float(d),
        alpha=float(shape[0]),
        beta_per_V=float(shape[1]),
        gamma_per_V=float(shape[2]),
        offset_um=float(offset),
    )
    starts = sorted(float(math.sqrt(2.0 * result.cost / thin.u.size)) for result in found)
    notes = (
        f"initial transient {transient:.4g} µm",
        "RMSE reached from each start: " + ", ".join(f"{value:.4g}" for value in starts) + " µm",
        "the recording does not show m/k; it is set to a negligible value"
        if best is without
        else f"m/k identified: {inertia:.4g} s²",
        f"k_N_per_m is given, not identified: {k_N_per_m:.6g}",
    )
    evaluations = thin.evaluations + (full.evaluations if full is not thin else 0)
    method = f"least squares from {len(found)} starts, linear hold, initial hysteresis {'free' if free else 'rest'}"
    report = FitReport.of("bouc_wen", method, y, y + residual, dt, evaluations, bool(best.status > 0), notes)
    return parameters, report


def fit_bouc_wen(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, serve_dt_s: float | None = None
) -> tuple[BoucWenInverse, FitReport]:
    """Identify a Bouc-Wen stage with ``identify_bouc_wen`` and invert it; other arguments as in ``fit_linear``."""
    parameters, report = identify_bouc_wen(u_V, y_um, dt_s)
    return BoucWenInverse.of(parameters, report, u_V, serve_dt_s)
