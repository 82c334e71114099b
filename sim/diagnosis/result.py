"""The result of a diagnosis: the content of report.json, and the residuals for its pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.catalogue import CATALOGUE, Catalogue
from dehyst.sim.fitting.fit_data import FitData
from dehyst.sim.fitting.stage_model import ModelFit
from dehyst.sim.pictures import Picture, over_time
from dehyst.sim.readings.noise import Defect
from dehyst.sim.readings.sight import Sight

#: Version of report.json.
SCHEMA = 2
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

    def as_dict(self) -> dict[str, Any]:
        """The content of report.json."""
        effects = [
            {
                "name": c.name,
                "alternatives": list(c.alternatives),
                "parameters": c.parameters,
                "intervals": {k: list(v) for k, v in c.intervals.items()},
                "heldout_gain": c.heldout_gain,
                "p_value": c.p_value,
                "witness": None if c.witness is None else {"seen": c.witness.seen, "words": c.witness.words},
                "instead": c.instead,
            }
            for c in self.causes
        ]
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "nominal": {"rmse_um": self.nominal_rmse_um, "heldout_rmse_um": self.nominal_heldout_um},
            "extended": {"rmse_um": self.extended_rmse_um, "heldout_rmse_um": self.extended_heldout_um},
            "noise_floor_um": self.noise_floor_um,
            "effects": effects,
            "not_excited": list(self.not_excited),
            "next_experiment": self.next_experiment,
            "explainable": {
                "black_box_rmse_um": self.ceiling_um,
                "explained_share": self.explained,
                "learnt_from_recording_rmse_um": self.taught_um,
            },
            "defects": [{"kind": d.kind, "count": d.count, "by_chance": d.by_chance} for d in self.defects],
            "left": list(self.left),
            "tried_not_named": [*self.partial, *self.uncertain],
        }


def picture(cause: NamedCause, data: FitData, catalogue: Catalogue = CATALOGUE) -> Picture:
    """The picture that shows this cause best; the residual over time if that cannot be drawn."""
    made = catalogue.causes[cause.name].picture(cause, data) or over_time(cause, data)
    assert made is not None, "a residual over time can always be drawn"
    return made
