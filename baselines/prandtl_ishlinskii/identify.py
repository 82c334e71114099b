"""Identification of the MPI model: a convex problem without starting values.

(2.40) is linear in the play weights and the inverse dead-zone weights together, so all weights zero would minimise
it. A scale constraint excludes that: the inverse saturation maps the recorded stroke onto itself,
S*(y_max - y_ref) = y_max - y_ref. It costs no generality, because (w_h, w_s*) and any multiple of them are the same
model. Written in the slopes of the segments instead of the weights, invertibility is a lower bound on each unknown,
and the whole is a non-negative least-squares problem with one minimum.

(2.40) measures the error in x, not in µm of displacement. Dividing each row by the slope of the inverse saturation
there makes the two equal to first order; two such rounds suffice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dehyst.adaptive.types import FloatArray
from dehyst.baselines.bounded_least_squares import SLOPE_FLOOR, bounded_least_squares
from dehyst.baselines.common import FitReport, checked_recording
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters, from_inverse_saturation
from dehyst.baselines.prandtl_ishlinskii.operators import play_run, play_start, ramps, slopes_to_weights

#: Plays and dead zones besides the zero ones, as in the chapter.
PLAYS, ZONES = 12, 6
#: Rounds that turn the error of (2.40) into one of displacement.
_ROUNDS = 2
#: Weight of the scale constraint relative to the mean row; rescaling makes the constraint exact afterwards.
_SCALE_WEIGHT = 1e3
#: Samples whose residual exceeds this multiple of the RMS are left out of a second fit.
_OUTLIER_RMS = 8.0


@dataclass(frozen=True, slots=True)
class MpiGrid:
    """Thresholds by (2.38), (2.39): plays ``r_V`` (n+1,), inverse dead zones ``d_star_um`` (m+1,) above ``y_ref_um``.

    ``stroke_um`` is the recorded stroke, on which the scale is fixed.
    """

    r_V: FloatArray
    d_star_um: FloatArray
    y_ref_um: float
    stroke_um: float

    @staticmethod
    def of(u_V: FloatArray, y_um: FloatArray) -> MpiGrid:
        """Plays and dead zones at equal intervals over the largest |u| and the stroke."""
        y_ref, stroke = float(y_um.min()), float(np.ptp(y_um))
        r = np.arange(PLAYS + 1) / (PLAYS + 1) * float(np.max(np.abs(u_V)))
        return MpiGrid(r, np.arange(ZONES + 1) / (ZONES + 1) * stroke, y_ref, stroke)

    @property
    def size(self) -> int:
        """Number of unknowns: play weights, offset, slopes."""
        return self.r_V.size + 1 + self.d_star_um.size

    def scale_row(self) -> FloatArray:
        """(size,) row whose product with the unknowns is the inverse saturation's value at the full stroke, µm."""
        row = np.zeros(self.size)
        row[self.r_V.size + 1 :] = ramps(np.array([self.stroke_um]), self.d_star_um)[0]
        return row

    def lower_bounds(self, u_span_V: float) -> FloatArray:
        """(size,) lower bounds that keep the model invertible; -inf for the offset."""
        bounds = np.zeros(self.size)
        bounds[0] = SLOPE_FLOOR * self.stroke_um / u_span_V
        bounds[self.r_V.size] = -np.inf
        bounds[self.r_V.size + 1 :] = SLOPE_FLOOR
        return bounds

    def model(self, unknowns: FloatArray, lag_s: float = 0.0) -> MpiParameters:
        """The MPI model of the unknowns (size,), rescaled so that the scale constraint holds exactly."""
        scaled = unknowns * (self.stroke_um / float(self.scale_row() @ unknowns))
        n = self.r_V.size
        weights = slopes_to_weights(scaled[n + 1 :])
        return from_inverse_saturation(
            self.r_V, scaled[:n], self.d_star_um, weights, float(scaled[n]), self.y_ref_um, lag_s
        )


def _solve(
    plays: FloatArray, lead_um: FloatArray, grid: MpiGrid, lower: FloatArray, rounds: int
) -> tuple[FloatArray, float]:
    """Unknowns and RMS residual, µm of displacement to first order, for ``lead_um`` = y - y_ref + lag v."""
    curve = ramps(lead_um, grid.d_star_um)
    rows = np.hstack([plays, np.ones((plays.shape[0], 1)), -curve])
    scale_row = grid.scale_row()
    segment = np.clip(np.searchsorted(grid.d_star_um, lead_um, side="right") - 1, 0, grid.d_star_um.size - 1)
    weight = np.ones(lead_um.size)
    unknowns, residual = np.zeros(grid.size), np.inf
    for _ in range(1 + rounds):
        heavy = _SCALE_WEIGHT * np.sqrt(float(np.mean(weight**2)) * lead_um.size)
        stacked = np.vstack([rows * weight[:, None], heavy / grid.stroke_um * scale_row])
        target = np.zeros(stacked.shape[0])
        target[-1] = heavy
        # The triangular factor of QR has the same minimum as thousands of rows, and NNLS on it takes microseconds.
        triangle = np.asarray(np.linalg.qr(np.column_stack([stacked, target]), mode="r"))
        unknowns = bounded_least_squares(triangle[:, :-1], triangle[:, -1], lower)
        slopes = np.maximum(unknowns[plays.shape[1] + 1 :], SLOPE_FLOOR)
        residual = float(np.sqrt(np.mean((rows @ unknowns / slopes[segment]) ** 2)))
        weight = 1.0 / slopes[segment]
    return unknowns, residual


def _best_lag(
    plays: FloatArray, y_um: FloatArray, velocity: FloatArray, dt_s: float, grid: MpiGrid, lower: FloatArray
) -> tuple[float, int]:
    """The first-order lag with the smallest residual, s, 0 where no lag helps; and the number of lags tried."""
    thin = slice(None, None, max(1, y_um.size // 4000))

    def cost(lag_s: float) -> float:
        return _solve(plays[thin], (y_um + lag_s * velocity)[thin] - grid.y_ref_um, grid, lower, 0)[1]

    from scipy.optimize import minimize_scalar

    found = minimize_scalar(cost, bounds=(0.0, max(0.05, 2.0 * dt_s)), method="bounded", options={"xatol": 1e-5})
    return (float(found.x) if found.fun < cost(0.0) else 0.0), int(found.nfev) + 1


def identify_mpi(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, fit_lag: bool = False
) -> tuple[MpiParameters, FitReport]:
    """MPI model of a recording by non-negative least squares on (2.40).

    Parameters
    ----------
    u_V, y_um : (samples,) voltage V and displacement µm, ``dt_s`` s apart, in the order of the recording. The stage
        was at rest before; the initial states are those of (2.5) with y0 = 0.
    fit_lag : also find the first-order lag, s, with the smallest residual; the chapter's model has none.

    Samples with a residual above eight times the RMS, such as an initial transient, are left out of a second fit. A
    rate-independent model cannot hold them. The report counts them and includes them in its errors.

    Returns the parameters and a report. Raises InputError on an unusable recording.
    """
    u, y, dt = checked_recording(u_V, y_um, dt_s, PLAYS + ZONES + 4)
    lower_span = float(np.ptp(u))
    velocity = np.gradient(y, dt)
    keep = np.ones(u.size, dtype=np.bool_)
    evaluations, left_out = 0, 0
    parameters = MpiParameters((0.0,), (1.0,))
    for _ in range(2):
        grid = MpiGrid.of(u, y[keep])
        plays = play_run(u, grid.r_V, play_start(float(u[0]), grid.r_V))
        lower = grid.lower_bounds(lower_span)
        lag = 0.0
        if fit_lag:
            lag, tried = _best_lag(plays[keep], y[keep], velocity[keep], dt, grid, lower)
            evaluations += tried
        lead_um = (y + lag * velocity)[keep] - grid.y_ref_um
        unknowns, rms = _solve(plays[keep], lead_um, grid, lower, _ROUNDS)
        evaluations += 1 + _ROUNDS
        parameters = grid.model(unknowns, lag)
        beyond = np.abs(parameters.simulate(u, dt) - y) > _OUTLIER_RMS * rms
        if not beyond.any() or beyond.sum() > 0.02 * u.size:
            break
        keep, left_out = ~beyond, int(beyond.sum())
    notes = (
        "scale: the inverse saturation maps the recorded stroke onto itself",
        f"{left_out} samples beyond {_OUTLIER_RMS:g} times the RMS left out of the fit",
    )
    method = f"non-negative least squares on (2.40), n={PLAYS}, m={ZONES}"
    report = FitReport.of("mpi", method, y, parameters.simulate(u, dt), dt, evaluations, True, notes)
    return parameters, report


def fit_mpi(
    u_V: ArrayLike, y_um: ArrayLike, dt_s: float, *, fit_lag: bool = False, serve_dt_s: float | None = None
) -> tuple[MpiInverse, FitReport]:
    """Identify an MPI model with ``identify_mpi`` and invert it; other arguments as in ``fit_linear``."""
    parameters, report = identify_mpi(u_V, y_um, dt_s, fit_lag=fit_lag)
    return MpiInverse.of(parameters, report, u_V, serve_dt_s)
