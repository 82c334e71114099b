"""The competition in the service: what an axis learns by, and the champion beside it.

The axis serves the favourite's own model under its name, as it would without a competition, and the champion as
``auto``: the model that answers where a query names none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from adaptive.inverse_model import LssvmInverse
from adaptive.types import InverseModel, OnlineModel, Sample, StateDict
from baselines.competition.champion import ChampionInverse
from baselines.competition.competition import Competition, of_models
from baselines.competition.config import CompetitionConfig
from service.protocol.keys import AUTO


class Competing:
    """A competition whose snapshot is the favourite's. Implements ``adaptive.types.OnlineModel``.

    What is not here (freezing, adopting, looking in) is the competition's, and what that has not, the favourite's.
    """

    def __init__(self, competition: Competition, make: Callable[[InverseModel], OnlineModel] | None = None) -> None:
        self.competition = competition
        self._make = make

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "competition":
            raise AttributeError(name)
        return getattr(self.competition, name)

    @property
    def trouble(self) -> str:
        """What the learner says is wrong with the samples, "" while nothing is."""
        return self.competition.trouble

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words."""
        return self.competition.why

    @property
    def distrusts(self) -> bool:
        """Whether the learner has the readings on trial."""
        return self.competition.distrusts

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        return self.competition.seq

    def handle(self, sample: Sample) -> str:
        """Give a sample to all contestants; the favourite's verdict."""
        return self.competition.handle(sample)

    def snapshot(self) -> InverseModel:
        """The favourite's model."""
        return self.competition.snapshot().models[0]

    def champion_model(self) -> ChampionInverse:
        """What answers as ``auto``."""
        return self.competition.snapshot()

    def take_place_of(self, other: Competing) -> None:
        """Go on where ``other`` is, with what this one has learnt."""
        self.competition.take_place_of(other.competition)

    def counters(self) -> dict[str, int]:
        return self.competition.counters()

    def state_dict(self) -> StateDict:
        return self.competition.state_dict()

    def restored(self, state: StateDict) -> Competing:
        """One like this, going on from a state. Raises ModelFileError where it does not fit."""
        return Competing(Competition.from_state(state, self._make), self._make)


def champion_of(learner: OnlineModel | None) -> dict[str, InverseModel]:
    """The champion under its name; nothing where what learns is alone."""
    made = getattr(learner, "champion_model", None)
    return {} if made is None else {AUTO: made()}


def compete(
    name: str,
    model: InverseModel,
    make: Callable[[InverseModel], OnlineModel],
    others: Mapping[str, InverseModel],
    config: CompetitionConfig,
) -> OnlineModel:
    """What learns from ``model``, made by ``make``, against the online forms of ``others``; alone where none has one.

    Raises what ``make`` raises.
    """
    learner = make(model)
    if not others or not isinstance(model, LssvmInverse):
        return learner
    made = of_models(name, learner, model, dict(others), config, make)
    return Competing(made, make) if len(made.names) > 1 else learner
