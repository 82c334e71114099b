"""Teaches the learner of an axis, judges what it gives, and replaces it where it fails or has learnt bad samples.

All of it runs in the thread that handles samples and depends on the samples alone, so that a standby and a replay
decide alike.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np

from adaptive.errors import DehystError, ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict, prefixed, under
from baselines.competition.champion import ChampionInverse
from baselines.competition.competition import Competition
from service.answers.answering import Served
from service.background.retuner import Adoptions, Retuned
from service.protocol.keys import AUTO
from service.protocol.model import build_model, stored_kind
from service.server.model_watch import BEGUN_AGAIN, LEARNER_FAILED, POISON, ROLES, ModelWatch

# --- Stored states of a learner: whether one fits the learner of an axis, and the fingerprint of a model.

#: Version of the state of an axis (`service.server.axis.Axis.state_dict`); others are refused.
STATE_SCHEMA: Final = 3
#: Entries of a learner's state that learning does not change: its settings, and of the identified model what tuning
#: does not change. They must equal those of the present learner.
_FIXED: Final = re.compile(r"(^|\.)(config\.|base\.(beta$|span_V$|features\.))")
#: Settings that older states lack; learners of that time had no such bounds.
_ADDED: Final = re.compile(r"(^|\.)config\.envelope\.")


def restored_learner(state: StateDict, like: OnlineModel) -> OnlineModel:
    """A learner of the kind of ``like`` with ``state``. Raises ModelFileError with the reason if it does not fit."""
    check_same_learner(state, like)
    return like.restored(state)


def check_same_learner(state: StateDict, like: OnlineModel) -> None:
    """Raise ModelFileError if ``state`` is of a learner with other settings or another identified model."""
    if not state:
        raise ModelFileError("it holds no learner, but this axis learns")
    for name, value in like.state_dict().items():
        if not _FIXED.search(name) or (name not in state and _ADDED.search(name)):
            continue
        if name not in state or not _equal(value, state[name]):
            what = "setting" if "config." in name else "identified model"
            raise ModelFileError(
                f"it belongs to another {what}: {name} is {_short(state.get(name))}, now {_short(value)}"
            )


def fingerprint(model: InverseModel) -> str:
    """16 hexadecimal digits; equal for models that give the same answers to the last bit."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        # These may change without any change of the answers.
        if name in ("seq", "valid", "noise_variance"):
            continue
        sha.update(name.encode())
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else json.dumps(value).encode())
    return sha.hexdigest()


def _equal(a: Any, b: Any) -> bool:
    # A file stores a number that is not finite as an array, and a tuple as a list.
    if isinstance(a, np.ndarray | float) or isinstance(b, np.ndarray | float):
        if np.asarray(a).dtype.kind not in "fiub" or np.asarray(b).dtype.kind not in "fiub":
            return False
        return np.shape(a) == np.shape(b) and bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))
    return bool(a == b or (isinstance(a, tuple) and list(a) == b))


def _short(value: Any) -> str:
    text = f"an array {value.shape}" if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _same_frame(model: InverseModel, learner: OnlineModel) -> bool:
    """Whether ``model`` reads displacements as the present model of ``learner`` does."""
    try:
        now = learner.snapshot()
    except (DehystError, ValueError, ArithmeticError):
        return False
    return isinstance(now, LssvmInverse) and isinstance(model, LssvmInverse) and now.features == model.features


# --- The competition of an axis. The favourite's own model is served under its name, as without a competition, and the
# champion as ``auto``: the model that answers where a query names none.


def champion_of(learner: OnlineModel | None) -> dict[str, InverseModel]:
    """The champion under its name; empty without a competition."""
    return {AUTO: learner.champion_model()} if isinstance(learner, Competition) else {}


def standing_of(learner: OnlineModel | None) -> dict[str, Any] | None:
    """Champion, changes, and the rms error of each contestant; None without a competition."""
    return learner.standing() if isinstance(learner, Competition) else None


# --- Supervision.

#: Interval at which the learner's state is kept to go back to while there is no trouble, s of samples.
MARK_S: Final = 1.0
#: Verdict on samples that nobody learns from.
NOT_LEARNING: Final = "not_learning"

#: Starts a learner from a model, after the one before has failed.
Revive = Callable[[InverseModel], OnlineModel]


class Note(Protocol):
    """Tells an event of the axis."""

    def __call__(self, event: str, detail: str, **more: Any) -> None: ...


class LearnerSupervisor:
    """The learner of one axis, and the watch over it.

    Parameters
    ----------
    name : of the model that learns; "" for none.
    learner : None for an axis that does not learn.
    watch : decides whether the newest model may be served, and whether samples may be learnt.
    dt_s : sample time, s. note : tells events.
    revive : starts another learner some time after this one has failed; None: it stays failed.
    """

    def __init__(
        self, name: str, learner: OnlineModel | None, watch: ModelWatch, dt_s: float, note: Note, revive: Revive | None
    ) -> None:
        self.name = name
        self.learner = learner
        self.watch = watch
        self.adoptions = Adoptions()
        self._dt_s = dt_s
        self._note = note
        self._revive = revive
        self._failed = False
        self._frozen_by = ""
        # States to go back to, the older one first, and the count of samples at the newer one.
        self._marks: tuple[StateDict, StateDict] = ({}, {})
        self._marked = 0

    @property
    def learning(self) -> bool:
        """Whether there is a learner that has not failed."""
        return self.learner is not None and not self._failed

    @property
    def frozen(self) -> bool:
        """Whether an operator has stopped learning."""
        return bool(self._frozen_by)

    # ---- for each sample

    def handle(self, sample: Sample) -> str:
        """Teach one sample; the learner's verdict."""
        if self.learner is None or self._failed:
            return NOT_LEARNING
        try:
            return self.learner.handle(sample)
        except Exception as error:
            # A learner never raises on data. If it does, its state is in doubt: its last good model stays served.
            self._fail(f"{type(error).__name__}: {error}")
            return NOT_LEARNING

    def adopt_due(self, number: int) -> None:
        """Adopt the hyper-parameters that are due after the sample ``number``."""
        if self.learner is None or self._failed:
            return
        for retuned, refused in self.adoptions.apply(number, self.learner):
            detail = f"refused: {refused}" if refused else f"gamma {retuned.gamma:.4g}, widths {retuned.widths}"
            self._note("retuning_refused" if refused else "retuned", detail, retuned=retuned.to_json())

    # ---- for each snapshot

    def models(self, last: Served, received: int) -> dict[str, InverseModel]:
        """The learner's models to serve after ``last``: the newest or the last good one, and the champion.

        ``received`` : count of all samples that came.
        """
        if self.learner is None:
            return {}
        if self._failed and self._revive is not None and self.watch.failed_long():
            self._start_again(self._revive, last.models[self.name])
        candidate = self._snapshot(self.learner)
        alive = not self._failed
        reported, distrusts = (self.learner.trouble, self.learner.distrusts) if alive else ("", False)
        before = self.watch.trouble
        good = self.watch.judge(candidate, last.models.get(last.stand_in), reported, distrusts)
        now = self.watch.trouble
        if not now and not before:
            self._mark(self.learner, received)
        if now != before:
            if before in POISON and not now:
                self._go_back(self.learner)
            self._set_teaching()
            self._note_trouble(before, now, reported, last.stand_in)
        for event in self.learner.take_events():
            self._note(*event)
        if good is None:
            return {}
        return {self.name: good, **self._champion(last, good, now in POISON)}

    def memories(
        self, models: dict[str, InverseModel], tracked: dict[str, FloatArray], frozen: bool = False
    ) -> dict[str, FloatArray]:
        """``tracked`` memories by model, with the learner's own for its model, alone and as a contestant.

        ``frozen`` : the models are those of an earlier moment. The learner's memory does not fit them once it has found
        that the readings have jumped.
        """
        if self.learner is None or self._failed or (frozen and not _same_frame(models[self.name], self.learner)):
            return tracked
        own = self.learner.memory_for(models[self.name])
        if own is None or own.shape != tracked[self.name].shape or not np.isfinite(own).all():
            return tracked
        champion = models.get(AUTO)
        if not isinstance(champion, ChampionInverse) or self.name not in champion.names:
            return tracked | {self.name: own}
        return tracked | {self.name: own, AUTO: champion.with_memory(tracked[AUTO], self.name, own)}

    # ---- operator's commands

    def freeze(self, by: str) -> None:
        """Stop learning: samples are still tracked, judged and recorded."""
        self._frozen_by = by
        self._set_teaching()

    def thaw(self) -> None:
        """Resume learning."""
        self._frozen_by = ""
        self._set_teaching()

    def replace(self, learner: OnlineModel) -> None:
        """Continue with ``learner``, whose sample numbers and times are of another period."""
        learner.resync()
        self.learner, self._failed = learner, False
        self._set_teaching()

    # ---- state

    def state_dict(self, poisoned: bool) -> StateDict:
        """All that samples and operators have changed; copies. ``poisoned`` : the state to go back to is needed."""
        state: StateDict = {
            "frozen_by": self._frozen_by,
            "dead": self._failed,
            "adoptions": json.dumps([retuned.to_json() for retuned in self.adoptions.pending]),
        }
        state |= prefixed("watch.", self.watch.state_dict())
        for role, model in self.watch.models().items():
            state |= {f"model.{role}.kind": stored_kind(model), **prefixed(f"model.{role}.", model.state_dict())}
        if poisoned:
            state |= prefixed("mark.", self._marks[0])
        if self.learner is not None:
            state |= prefixed("learner.", self.learner.state_dict())
        return state

    def restored(self, state: StateDict, received: int) -> LearnerSupervisor:
        """A supervisor like this one with ``state``; this one does not change.

        Raises KeyError, TypeError, ValueError or InputError where entries are missing or damaged, ModelFileError where
        the learner's state does not fit.
        """
        learner = None if self.learner is None else restored_learner(under("learner.", state), self.learner)
        models = {
            role: build_model(str(state[f"model.{role}.kind"]), under(f"model.{role}.", state), f"the {role} model")
            for role in ROLES
            if f"model.{role}.kind" in state
        }
        watch = self.watch.restored(under("watch.", state), models)
        made = LearnerSupervisor(self.name, learner, watch, self._dt_s, self._note, self._revive)
        made._frozen_by, made._failed = str(state["frozen_by"]), bool(state["dead"])
        made.adoptions.add(*(Retuned.from_json(entry, "adoptions") for entry in json.loads(str(state["adoptions"]))))
        made._marks, made._marked = (under("mark.", state), {}), received
        made._set_teaching()
        return made

    # ---- inside

    def _snapshot(self, learner: OnlineModel) -> InverseModel | None:
        if self._failed:
            return None
        try:
            return learner.snapshot()
        except (DehystError, ValueError, ArithmeticError) as error:
            self._fail(f"snapshot: {error}")
            return None

    def _fail(self, why: str) -> None:
        self._failed = True
        self._note("learner_failed", f"{why}; the last good model stays in service")

    def _start_again(self, revive: Revive, model: InverseModel) -> None:
        try:
            self.learner, self._failed = revive(model), False
        except Exception as error:
            self._note("learner_failed", f"beginning anew: {type(error).__name__}: {error}")
        else:
            self._set_teaching()
            self._note("learner_begun_anew", "from the last good model")

    def _note_trouble(self, before: str, now: str, reported: str, stand_in: str) -> None:
        if now == LEARNER_FAILED:  # already noted
            return
        if not now:
            self._note("recovered", before)
            return
        why = f" ({self.learner.why})" if reported and self.learner is not None else ""
        served = "the identified model" if now in BEGUN_AGAIN else "the last good model"
        self._note("trouble", f"{now}{why}: {served} is served, then {stand_in or 'nothing else'}")

    def _champion(self, last: Served, good: InverseModel, poisoned: bool) -> dict[str, InverseModel]:
        """The champion under its name. Poisoned samples change no champion, only its model of the learner."""
        if self._failed:
            return {}
        if not poisoned:
            return champion_of(self.learner)
        champion = last.models.get(AUTO)
        if (
            not isinstance(champion, ChampionInverse)
            or self.name not in champion.names
            or last.models[self.name] is good
        ):
            return {}
        return {AUTO: champion.with_model(self.name, good)}

    def _mark(self, learner: OnlineModel, received: int) -> None:
        """Keep the state at fixed counts of samples; the older of two is from before any trouble that has no name yet.

        The count decides and not the time since the last mark, so that a standby that has just taken over a state soon
        has the same marks as the instance that it is from, and goes back to the same.
        """
        every = max(1, round(MARK_S / self._dt_s))
        if not self._failed and received // every != self._marked // every:
            self._marks, self._marked = (self._marks[-1], learner.state_dict()), received

    def _go_back(self, learner: OnlineModel) -> None:
        """The samples are good again: continue from a state before they were bad.

        The learner has followed the position of the stage by the voltages meanwhile. Without a state to go back to,
        the position is taken anew: the first reading of a sensor that was frozen is no jump of the stage.
        """
        if self._marks[0]:
            try:
                self.learner = restored_learner(self._marks[0], learner)
            except DehystError as error:
                self._note("internal_error", f"going back: {error}")
        if self.learner is None or self.learner is learner:
            learner.resync()
            return
        self._note("learner_went_back", "to before the samples went wrong")
        self.learner.take_place_of(learner)

    def _set_teaching(self) -> None:
        if self.learner is None:
            return
        if self.frozen or not self.watch.teachable:
            self.learner.freeze()
        else:
            self.learner.thaw()
