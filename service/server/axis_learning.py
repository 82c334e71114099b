"""What an axis makes of its learner: samples in, a model that is fit to be served out, and what happens when it is not.

All of it is for the thread that handles samples.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from adaptive.errors import DehystError
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict
from baselines.competition.champion import ChampionInverse
from service.answers.answering import Served
from service.intake.sequence import SequenceTracker
from service.protocol.keys import AUTO
from service.server.axis_operations import AxisOperations
from service.server.axis_state import restored_learner
from service.server.competing import champion_of
from service.server.model_watch import BEGUN_AGAIN, LEARNER_FAILED, POISON

#: How often the learner's state is marked while all is well, s of samples.
MARK_S: Final = 1.0


class AxisLearning(AxisOperations):
    """The learner of an axis; see :class:`service.server.axis.Axis`, which is the only one to be of this class."""

    dt_s: float
    sequence: SequenceTracker
    _revive: Callable[[InverseModel], OnlineModel] | None
    #: States of the learner, the older one first, and the count of samples at the newer one.
    _marks: tuple[StateDict, StateDict]
    _marked: int

    def _learn(self, sample: Sample) -> str:
        if self.learner is None or self._learner_dead:
            return "not_learning"
        try:
            return self.learner.handle(sample)
        except Exception as error:
            # A learner never raises on data. If it does, its state is in doubt: what it last gave stays served.
            self._failed(f"{type(error).__name__}: {error}")
            return "not_learning"

    def _failed(self, why: str) -> None:
        self._learner_dead = True
        self.note("learner_failed", f"{why}; the last good model stays in service")

    def _judged(self, last: Served) -> dict[str, InverseModel]:
        """What of the learner is served now: its newest model, or the last good one."""
        assert self.learner is not None
        candidate: InverseModel | None = None
        if self._learner_dead and self._revive is not None and self.watch.failed_long():
            self._begin_anew(last.models[self.config.learn])
        if not self._learner_dead:
            try:
                candidate = self.learner.snapshot()
            except (DehystError, ValueError, ArithmeticError) as error:
                self._failed(f"snapshot: {error}")
        before = self.watch.trouble
        told, distrusts = "", False
        if not self._learner_dead:
            told, distrusts = self.learner.trouble, self.learner.distrusts
        good = self.watch.judge(candidate, last.models.get(last.stand_in), told, distrusts)
        now = self.watch.trouble
        if not now and not before:
            self._mark()
        if now != before:
            if before in POISON and not now:
                self._go_back()
            self.set_teaching()
            why = f" ({self.learner.why})" if told else ""
            served = "the identified model" if now in BEGUN_AGAIN else "the last good model"
            detail = f"{now}{why}: {served} is served, then {last.stand_in or 'nothing else'}" if now else before
            if now != LEARNER_FAILED:  # which has told of itself
                self.note("trouble" if now else "recovered", detail)
        for event in self.learner.take_events():
            self.note(*event)
        if good is None:
            return {}
        return {self.config.learn: good, **self._champion(last, good, now in POISON)}

    def _champion(self, last: Served, good: InverseModel, poisoned: bool) -> dict[str, InverseModel]:
        """The champion under its name. While samples are poisoned nobody is judged by them: it stays who it was."""
        if self._learner_dead:
            return {}
        if not poisoned:
            return champion_of(self.learner)
        name, champion = self.config.learn, last.models.get(AUTO)
        if not isinstance(champion, ChampionInverse) or name not in champion.names or last.models[name] is good:
            return {}
        return {AUTO: champion.with_model(name, good)}

    def _own_memory(self, models: dict[str, InverseModel], tracked: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """``tracked`` memories, with the learner's own for its model, alone and as the champion's contestant."""
        if self.learner is None or self._learner_dead:
            return tracked
        name = self.config.learn
        own = self.learner.memory_for(models[name])
        if own is None or own.shape != tracked[name].shape or not np.isfinite(own).all():
            return tracked
        champion = models.get(AUTO)
        if not isinstance(champion, ChampionInverse) or name not in champion.names:
            return tracked | {name: own}
        return tracked | {name: own, AUTO: champion.with_memory(tracked[AUTO], name, own)}

    def _mark(self) -> None:
        """Keep what the learner is now and then, to go back to: the older of two is from before any trouble.

        At counts of samples and not by the time since the last: who has just taken over a state has the same marks as
        the one that it is from before long, and goes back to the same.
        """
        assert self.learner is not None
        every = max(1, round(MARK_S / self.dt_s))
        if not self._learner_dead and self.sequence.received // every != self._marked // every:
            self._marks, self._marked = (self._marks[-1], self.learner.state_dict()), self.sequence.received

    def _go_back(self) -> None:
        """The samples are good again: go on from before they were bad, whose first ones the learner may have believed.

        Where the stage is it has followed by the voltages. If it could not, its place is taken anew: what a frozen
        sensor shows when it comes to itself is no jump of the stage.
        """
        assert self.learner is not None
        before = self.learner
        if self._marks[0]:
            try:
                self.learner = restored_learner(self._marks[0], before)
            except DehystError as error:
                self.note("internal_error", f"going back: {error}")
        if self.learner is before:
            self.learner.resync()
            return
        self.note("learner_went_back", "to before the samples went wrong")
        self.learner.take_place_of(before)

    def _begin_anew(self, model: InverseModel) -> None:
        assert self._revive is not None
        try:
            self.learner, self._learner_dead = self._revive(model), False
        except Exception as error:
            self.note("learner_failed", f"beginning anew: {type(error).__name__}: {error}")
        else:
            self.set_teaching()
            self.note("learner_begun_anew", "from the last good model")
