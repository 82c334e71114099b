"""The competition in the service: what an axis learns by, and the champion beside it.

The axis serves the favourite's own model under its name, as it would without a competition, and the champion as
``auto``: the model that answers where a query names none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from adaptive.inverse_model import LssvmInverse
from adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
)
from baselines.competition.champion import ChampionInverse
from baselines.competition.competition import Competition
from baselines.competition.config import CompetitionConfig
from service.protocol.keys import AUTO


class Competing:
    """A competition that serves the favourite's model as its snapshot. Implements ``adaptive.types.OnlineModel``."""

    def __init__(self, competition: Competition) -> None:
        self.competition = competition

    def snapshot(self) -> InverseModel:
        """The favourite's model."""
        return self.competition.snapshot().models[0]

    def champion_model(self) -> ChampionInverse:
        """The model that answers as ``auto``."""
        return self.competition.snapshot()

    def standing(self) -> dict[str, Any]:
        """Champion, changes, and the rms error of each contestant."""
        return self.competition.standing()

    def take_place_of(self, other: OnlineModel) -> None:
        """Continue at the position of ``other`` with what the contestants here have learnt."""
        self.competition.take_place_of(other.competition if isinstance(other, Competing) else other)

    def restored(self, state: StateDict) -> Competing:
        """A competition like this one with ``state``. Raises ModelFileError where it does not fit."""
        return Competing(self.competition.restored(state))

    # ---- the same as the competition's

    @property
    def seq(self) -> int:
        return self.competition.seq

    @property
    def base(self) -> InverseModel:
        return self.competition.base

    @property
    def trouble(self) -> str:
        return self.competition.trouble

    @property
    def why(self) -> str:
        return self.competition.why

    @property
    def distrusts(self) -> bool:
        return self.competition.distrusts

    def handle(self, sample: Sample) -> str:
        return self.competition.handle(sample)

    def resync(self) -> None:
        self.competition.resync()

    def freeze(self) -> None:
        self.competition.freeze()

    def thaw(self) -> None:
        self.competition.thaw()

    def moving(self) -> MovingPart | None:
        return self.competition.moving()

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        return self.competition.memory_for(model, smoothed)

    def window_data(self) -> WindowData | None:
        return self.competition.window_data()

    def adopt(self, hyper: Hyperparameters) -> str:
        return self.competition.adopt(hyper)

    def counters(self) -> dict[str, int]:
        return self.competition.counters()

    def diagnostics(self) -> dict[str, Any]:
        return self.competition.diagnostics()

    def take_events(self) -> list[tuple[str, str]]:
        return self.competition.take_events()

    def warm(self) -> None:
        self.competition.warm()

    def state_dict(self) -> StateDict:
        return self.competition.state_dict()


def champion_of(learner: OnlineModel | None) -> dict[str, InverseModel]:
    """The champion under its name; empty without a competition."""
    return {AUTO: learner.champion_model()} if isinstance(learner, Competing) else {}


def standing_of(learner: OnlineModel | None) -> dict[str, Any] | None:
    """Champion, changes, and the rms error of each contestant; None without a competition."""
    return learner.standing() if isinstance(learner, Competing) else None


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
    made = Competition.from_models(name, learner, model, dict(others), config, make)
    return Competing(made) if len(made.names) > 1 else learner
