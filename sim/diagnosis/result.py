"""The result of a diagnosis: the content of report.json, and the residuals for its pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from adaptive.types import FloatArray
from sim.diagnosis.model.calibration import ModelFit

SCHEMA = 1
FOLDS, TEST = "folds of the recording", "test recording"


@dataclass(frozen=True)
class NamedCause:
    """One cause that the diagnosis names.

    Attributes
    ----------
    name, alternatives : its name, and those of causes that this record cannot tell from it.
    parameters, intervals : reported numbers and their 95 % intervals (units are part of the names).
    heldout_gain : share of the held-out squared error that it removes on top of those named before it.
    p_value : how often chance gains as much, corrected for the number of candidates.
    before_um, after_um : residual without it (all else refitted) and with it, (n,), for its picture.
    index : index of its model in ``extended.model.causes``; -1 if it has none (quantisation, repeated readings).
    """

    name: str
    alternatives: tuple[str, ...]
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    heldout_gain: float
    p_value: float
    before_um: FloatArray = field(repr=False)
    after_um: FloatArray = field(repr=False)
    index: int = -1


@dataclass(frozen=True)
class Diagnosis:
    """The verdict on one recording. Lengths in µm, times in s."""

    verdict: str
    nominal_rmse_um: float
    nominal_heldout_um: float
    extended_rmse_um: float
    extended_heldout_um: float
    noise_floor_um: float
    floor_source: str
    causes: tuple[NamedCause, ...]
    not_excited: tuple[str, ...]
    next_experiment: str | None
    nominal: ModelFit = field(repr=False)
    extended: ModelFit = field(repr=False)
    notes: tuple[str, ...] = ()
    #: Causes that the search accepted although together they do not explain the recording (verdict "unexplained").
    partial: tuple[str, ...] = ()
    #: Source of the held-out errors: `FOLDS` or `TEST`.
    heldout_source: str = FOLDS

    def as_dict(self) -> dict[str, Any]:
        """The content of report.json, schema 1."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "nominal": {"rmse_um": self.nominal_rmse_um, "heldout_rmse_um": self.nominal_heldout_um},
            "extended": {"rmse_um": self.extended_rmse_um, "heldout_rmse_um": self.extended_heldout_um},
            "noise_floor_um": self.noise_floor_um,
            "effects": [
                {
                    "name": c.name,
                    "alternatives": list(c.alternatives),
                    "parameters": c.parameters,
                    "intervals": {k: list(v) for k, v in c.intervals.items()},
                    "heldout_gain": c.heldout_gain,
                    "p_value": c.p_value,
                }
                for c in self.causes
            ],
            "not_excited": list(self.not_excited),
            "next_experiment": self.next_experiment,
        }
