"""What is to be said of an identified model."""

from __future__ import annotations

from dataclasses import dataclass

from adaptive.types import FloatArray


@dataclass(frozen=True, slots=True)
class IdentificationReport:
    """What was found. Errors are of the inverse model, voltages in V, percent of the voltage range.

    train : on the recording's first part. heldout : free run over its last part, from which nothing was learnt;
    ``heldout_um`` is that voltage error seen as displacement through the mean gain.
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
