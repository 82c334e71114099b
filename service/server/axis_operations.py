"""What an operator does to an axis, and an axis' state as it is kept and handed over.

All of it is for the thread that handles samples, between two batches, so that it happens at a definite sample.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, cast

from adaptive.types import OnlineModel, StateDict
from service.answers.answering import Served
from service.background.retuning.adoption import Adoptions, Retuned
from service.background.retuning.retuner import Retuner
from service.protocol.errors import FieldError
from service.server.competing import champion_of

if TYPE_CHECKING:
    from service.config.config import AxisConfig
    from service.server.axis import Axis
    from service.server.model_watch import Watch


class Archive(Protocol):
    """Where checkpoints are kept."""

    def entries(self) -> list[dict[str, Any]]:
        """The checkpoints there are, newest first."""
        ...

    def learner_of(self, number: int, like: OnlineModel) -> OnlineModel:
        """The learner of a checkpoint. Raises FieldError where there is none such, or it does not match ``like``."""
        ...


class AxisOperations:
    """The operator's verbs; see :class:`service.server.axis.Axis`, which is the only one to be of this class."""

    config: AxisConfig
    learner: OnlineModel | None
    watch: Watch
    handled_seq: int
    _ring: tuple[Served, ...]
    _frozen_by: str
    _learner_dead: bool
    adoptions: Adoptions
    #: What tunes the learner anew in the background, while this axis is the one that serves; or None.
    retuner: Retuner | None = None
    #: Where checkpoints are, or None.
    archive: Archive | None = None

    if TYPE_CHECKING:

        def note(self, event: str, detail: str, **more: Any) -> None: ...

    @property
    def frozen(self) -> bool:
        """Whether an operator has stopped the learning."""
        return bool(self._frozen_by)

    def freeze(self, by: str = "") -> int:
        """Stop learning: samples are still tracked, judged and recorded. Returns the sample after which it holds."""
        self._frozen_by = by or "operator"
        self.set_teaching()
        self.note("frozen", "learning is stopped", by=by)
        return self.handled_seq

    def thaw(self, by: str = "") -> int:
        """Learn again."""
        self._frozen_by = ""
        self.set_teaching()
        self.note("thawed", "learning goes on", by=by)
        return self.handled_seq

    def select(self, model: str, by: str = "") -> int:
        """Let ``model`` answer where a query names none. Raises FieldError on one that is not served."""
        newest = self._ring[-1]
        if model not in newest.models:
            raise FieldError("model", repr(model), f"one of {', '.join(newest.models)}")
        before = newest.default
        self._ring = (*self._ring[:-1], replace(newest, default=model))
        self.note("selected", f"{model} answers instead of {before}", by=by, model=model)
        return self.handled_seq

    def rollback(self, checkpoint: int, by: str = "") -> int:
        """Let the learner go back to what it was at a checkpoint; numbers, memory and recording go on.

        Raises FieldError where there is no such checkpoint or it does not match.
        """
        if self.archive is None or self.learner is None:
            raise FieldError("checkpoint", checkpoint, "an axis that learns and keeps checkpoints", "see 'checkpoints'")
        learner = self.archive.learner_of(checkpoint, self.learner)
        # Its count and its time are of then.
        learner.resync()
        self.learner, self._learner_dead = learner, False
        self.set_teaching()
        model = learner.snapshot()
        newest = self._ring[-1]
        name = self.config.learn
        changed = {name: model, **champion_of(learner)}
        memories = {
            other: newest.memories[other] if newest.memories[other].size == new.memory_size else new.rest_memory(0.0)
            for other, new in changed.items()
        }
        self._ring = (
            *self._ring[:-1],
            replace(newest, models=newest.models | changed, memories=newest.memories | memories),
        )
        self.note("rolled_back", f"to checkpoint {checkpoint}", by=by, checkpoint=checkpoint)
        return self.handled_seq

    def adopt_at(self, retuned: Retuned) -> None:
        """Let the learner adopt hyper-parameters right after a sample to come. From any thread."""
        self.adoptions.add(retuned)

    def adopt_due(self, number: int) -> None:
        """Adopt what is due after the sample ``number``."""
        if self.learner is None or self._learner_dead:
            return
        for retuned, refused in self.adoptions.apply(number, self.learner):
            told = f"refused: {refused}" if refused else f"gamma {retuned.gamma:.4g}, widths {retuned.widths}"
            self.note("retuning_refused" if refused else "retuned", told, retuned=retuned.to_json())

    def checkpoints(self) -> list[dict[str, Any]]:
        """The checkpoints there are, newest first: checkpoint, seq, samples, time_unix_s, bytes. From any thread."""
        return [] if self.archive is None else self.archive.entries()

    def differs(self, seq: int, theirs: str) -> bool:
        """Whether the learning model of the snapshot at ``seq`` is another than that of the fingerprint."""
        from service.server.axis_state import fingerprint

        mine = next((served for served in reversed(self._ring) if served.seq == seq), None)
        return bool(self.config.learn) and mine is not None and fingerprint(mine.models[self.config.learn]) != theirs

    def set_teaching(self) -> None:
        """Freeze or thaw the learner as operator and watch want it."""
        stop = self.frozen or not self.watch.teachable
        if self.learner is not None:
            self.learner.freeze() if stop else self.learner.thaw()

    def state_dict(self) -> StateDict:
        """All that changes with the samples, as :mod:`service.server.axis_state` puts it together. Copies."""
        from service.server.axis_state import axis_state

        return axis_state(cast("Axis", self))
