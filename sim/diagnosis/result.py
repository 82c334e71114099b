"""The result of a diagnosis: the content of report.json, and the residuals for its pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.catalogue import CATALOGUE, Catalogue
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import ModelFit
from dehyst.sim.pictures import Picture, over_time
from dehyst.sim.readings.noise import Defect
from dehyst.sim.readings.sight import Sight

#: Schemas of report.json. 1 has no verdict "partly", no witnesses, no ceiling and no defects.
SCHEMAS = (1, 2)
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
    index : index of its model in ``extended.model.causes``; -1 if it has none (quantisation).
    witness : what the direct test of its signature says; None if there is no such test.
    instead : share of what it removes that an alternative removes in its place, by name, where both were fitted.
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
    witness: Sight | None = None
    instead: dict[str, float] = field(default_factory=dict)


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
    #: Causes that the search dropped because all their numbers may be zero.
    uncertain: tuple[str, ...] = ()
    #: Source of the held-out errors: `FOLDS` or `TEST`.
    heldout_source: str = FOLDS
    #: Held-out error of a black box, and the share of what is explainable that the named causes explain.
    ceiling_um: float = float("nan")
    #: Error on the test recording of the better of a black box and the causes, fitted to the recording; None without.
    taught_um: float | None = None
    explained: float = float("nan")
    defects: tuple[Defect, ...] = ()
    #: Where the remaining error lies, in sentences.
    left: tuple[str, ...] = ()
    #: Both models on the test recording, if there is one.
    on_test: tuple[ModelFit, ModelFit] | None = field(default=None, repr=False)
    #: The effects that could be named.
    catalogue: Catalogue = field(default=CATALOGUE, repr=False)

    @property
    def shown(self) -> tuple[ModelFit, ModelFit]:
        """Nominal and extended model on the recording that decides: the test recording, if there is one."""
        return self.on_test or (self.nominal, self.extended)

    def as_dict(self, schema: int = SCHEMAS[-1]) -> dict[str, Any]:
        """The content of report.json. Raises InputError for a schema that is not one of `SCHEMAS`."""
        if schema not in SCHEMAS:
            raise InputError(f"schema: got {schema}, expected one of {', '.join(map(str, SCHEMAS))}")
        out: dict[str, Any] = {
            "schema": schema,
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
        if schema == 1:
            if self.verdict == "partly":
                out["verdict"] = "effects" if self.explained > 0.4 else "unexplained"
            return out
        for effect, cause in zip(out["effects"], self.causes, strict=True):
            w = cause.witness
            effect["witness"] = None if w is None else {"seen": w.seen, "words": w.words}
            effect["instead"] = cause.instead
        out["explainable"] = {
            "black_box_rmse_um": self.ceiling_um,
            "explained_share": self.explained,
            "learnt_from_recording_rmse_um": self.taught_um,
        }
        out["defects"] = [{"kind": d.kind, "count": d.count, "by_chance": d.by_chance} for d in self.defects]
        out["left"] = list(self.left)
        out["tried_not_named"] = [*self.partial, *self.uncertain]
        return out


def picture(cause: NamedCause, data: FitData, catalogue: Catalogue = CATALOGUE) -> Picture:
    """The picture that shows this cause best; the residual over time if that cannot be drawn."""
    made = catalogue.causes[cause.name].picture(cause, data) or over_time(cause, data)
    assert made is not None, "a residual over time can always be drawn"
    return made
