"""From a recording to an inverse model in one call, for each model that is served by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from baselines.bouc_wen.identify import identify_bouc_wen
from baselines.bouc_wen.inverse import BoucWenInverse
from baselines.bouc_wen.model import BoucWenParameters
from baselines.linear import LinearInverse, LinearParameters
from baselines.prandtl_ishlinskii.identify import identify_linear, identify_mpi
from baselines.prandtl_ishlinskii.inverse import MpiInverse
from baselines.prandtl_ishlinskii.model import MpiParameters
from baselines.validation import IdentificationReport


def _std_V(u_V: ArrayLike, report: IdentificationReport) -> float:
    """One standard deviation of the voltage: the residual over the mean slope of the recording."""
    return report.rmse_um * float(np.ptp(np.asarray(u_V, dtype=np.float64))) / report.range_um


def fit_linear(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, serve_dt_s: float | None = None
) -> tuple[LinearInverse, IdentificationReport]:
    """Identify a line and invert it. ``serve_dt_s``: sample time of the queries, s; the recording's by default."""
    parameters, report = identify_linear(u_V, y_um, dt_s)
    return LinearInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report


def fit_mpi(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, fit_lag: bool = False, serve_dt_s: float | None = None
) -> tuple[MpiInverse, IdentificationReport]:
    """Identify an MPI model (see ``identify_mpi``) and invert it."""
    parameters, report = identify_mpi(u_V, y_um, dt_s, fit_lag=fit_lag)
    return MpiInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report


def fit_bouc_wen(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, hold: str = "linear", serve_dt_s: float | None = None
) -> tuple[BoucWenInverse, IdentificationReport]:
    """Identify a Bouc-Wen stage (see ``identify_bouc_wen``) and invert it."""
    parameters, report = identify_bouc_wen(u_V, y_um, dt_s, hold=hold)
    return BoucWenInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report


def inverse_of(
    parameters: LinearParameters | MpiParameters | BoucWenParameters,
    report: IdentificationReport,
    u_V: ArrayLike,
    dt_s: float,
) -> LinearInverse | MpiInverse | BoucWenInverse:
    """Inverse model of parameters found by any route, the swarms included, for queries ``dt_s`` apart.

    ``u_V`` is the recording's voltage, whose span turns the residual into a standard deviation in V.
    """
    std = _std_V(u_V, report)
    if isinstance(parameters, LinearParameters):
        return LinearInverse(parameters, dt_s, report.domain, std)
    if isinstance(parameters, MpiParameters):
        return MpiInverse(parameters, dt_s, report.domain, std)
    return BoucWenInverse(parameters, dt_s, report.domain, std)
