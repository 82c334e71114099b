"""A competition around a learner, from the models that were identified."""

from __future__ import annotations

from adaptive.errors import InputError
from adaptive.snapshot import LssvmInverse
from adaptive.types import InverseModel, OnlineModel
from baselines.competition import Competition, CompetitionConfig
from baselines.contestants import Revive, challenger


def of_models(
    favourite: str,
    learner: OnlineModel,
    model: InverseModel,
    others: dict[str, InverseModel],
    config: CompetitionConfig | None = None,
    revive: Revive | None = None,
) -> Competition:
    """A learner, started from ``model``, against the online forms of ``others``, of which those without are left out.

    Raises InputError where ``model`` is no LSSVM: its ranges are what errors are measured by.
    """
    if not isinstance(model, LssvmInverse):
        raise InputError(f"{favourite}: got a {type(model).__name__}, expected an LSSVM model")
    contestants: dict[str, OnlineModel] = {favourite: learner}
    for name, other in others.items():
        online = challenger(other)
        if online is not None and name != favourite:
            contestants[name] = online
    range_um = model.features.y_max_um - model.features.y_min_um
    return Competition(contestants, range_um, model.span_V, config, revive)
