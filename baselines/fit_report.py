"""How well an identified baseline fits its recording, and the motion that the recording covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class Domain:
    """Range of the motion in an identification: displacement µm, largest speed µm/s."""

    y_min_um: float
    y_max_um: float
    v_max_um_per_s: float

    @staticmethod
    def of(y_um: FloatArray, dt_s: float) -> Domain:
        """Range of a recording (n,) µm; the speed is the largest central difference."""
        speed = np.abs(y_um[2:] - y_um[:-2]) / (2.0 * dt_s)
        return Domain(float(y_um.min()), float(y_um.max()), float(speed.max()))


@dataclass(frozen=True, slots=True)
class FitReport:
    """Errors of an identified forward model, run freely over the whole recording it was identified on.

    Attributes
    ----------
    model, method : names for people; the method says how the state at the first sample was chosen.
    samples, dt_s, range_um : of the recording.
    rmse_um, mae_um, max_um : errors, µm.
    evaluations : runs of the model, or solutions of the least-squares problem.
    converged : False where the optimiser stopped at its limit.
    domain : range of motion of the recording.
    """

    model: str
    method: str
    samples: int
    dt_s: float
    range_um: float
    rmse_um: float
    mae_um: float
    max_um: float
    evaluations: int
    converged: bool
    domain: Domain
    notes: tuple[str, ...] = ()

    @property
    def rmse_pct(self) -> float:
        """RMSE in percent of the motion range."""
        return 100.0 * self.rmse_um / self.range_um

    @property
    def mae_pct(self) -> float:
        """MAE in percent of the motion range."""
        return 100.0 * self.mae_um / self.range_um

    @staticmethod
    def of(
        model: str,
        method: str,
        y_um: FloatArray,
        model_um: FloatArray,
        dt_s: float,
        evaluations: int,
        converged: bool,
        notes: tuple[str, ...] = (),
    ) -> FitReport:
        """Errors (2.43), (2.44) of ``model_um`` against ``y_um``, both (n,) µm."""
        error = y_um - model_um
        return FitReport(
            model=model,
            method=method,
            samples=int(y_um.size),
            dt_s=dt_s,
            range_um=float(np.ptp(y_um)),
            rmse_um=float(np.sqrt(np.mean(error**2))),
            mae_um=float(np.mean(np.abs(error))),
            max_um=float(np.max(np.abs(error))),
            evaluations=evaluations,
            converged=converged,
            domain=Domain.of(y_um, dt_s),
            notes=notes,
        )
