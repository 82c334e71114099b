"""From a recording to an inverse model in one call, for each baseline that is served by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from baselines.bouc_wen.identify import identify_bouc_wen
from baselines.bouc_wen.model import BoucWenInverse
from baselines.common import FitReport
from baselines.linear import LinearInverse, identify_linear
from baselines.prandtl_ishlinskii.identify import identify_mpi
from baselines.prandtl_ishlinskii.model import MpiInverse


def _std_V(u_V: ArrayLike, report: FitReport) -> float:
    """Standard deviation of the voltage, V: the RMSE divided by the mean slope of the recording."""
    return report.rmse_um * float(np.ptp(np.asarray(u_V, dtype=np.float64))) / report.range_um


def fit_linear(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, serve_dt_s: float | None = None
) -> tuple[LinearInverse, FitReport]:
    """Identify a line and invert it. ``serve_dt_s``: sample time of the queries, s; by default that of the recording.

    The three functions take (n,) voltages V and displacements µm, ``dt_s`` s apart, and raise InputError on an unusable
    recording.
    """
    parameters, report = identify_linear(u_V, y_um, dt_s)
    return LinearInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report


def fit_mpi(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, fit_lag: bool = False, serve_dt_s: float | None = None
) -> tuple[MpiInverse, FitReport]:
    """Identify an MPI model with ``identify_mpi`` and invert it; other arguments as in ``fit_linear``."""
    parameters, report = identify_mpi(u_V, y_um, dt_s, fit_lag=fit_lag)
    return MpiInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report


def fit_bouc_wen(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, hold: str = "linear", serve_dt_s: float | None = None
) -> tuple[BoucWenInverse, FitReport]:
    """Identify a Bouc-Wen stage with ``identify_bouc_wen`` and invert it; other arguments as in ``fit_linear``."""
    parameters, report = identify_bouc_wen(u_V, y_um, dt_s, hold=hold)
    return BoucWenInverse(parameters, serve_dt_s or report.dt_s, report.domain, _std_V(u_V, report)), report
