"""Teaches the learner of an axis, judges what it gives, and replaces it where it fails or has learnt bad samples.

All of it runs in the thread that handles samples and depends on the samples alone, so that a standby and a replay
decide alike.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Final, Protocol

import numpy as np

from adaptive.errors import DehystError, ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.online.gates import (
    FROZEN,
    GAP,
    LEARNT,
    NOT_FINITE,
    OUT_OF_RANGE,
    PASSED,
    REDUNDANT,
    TIMING,
    UNEXCITED,
)
from adaptive.online.sensor_trust import OUT_OF_ENVELOPE, SENSOR_FAULTS
from adaptive.state import Entry, Kinded, load, part_of, restore, save
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict, prefixed
from baselines.competition.champion import ChampionInverse
from baselines.competition.competition import Competition, check_like
from service.answers.answering import Served
from service.answers.fallback import log_model_error
from service.answers.guard import Limits
from service.background.retuner import Adoptions, Retuned
from service.protocol.keys import AUTO
from service.protocol.model import build_model, stored_kind

# --- The watch: which model of an axis may be served, the newest, the last good one, or gradually the baseline.
#
# Deterministic: a function of the samples and of the learner's snapshots, so that a standby and a replay decide alike.
# A trouble has a name, begins and ends with hysteresis, and ends by itself:
#
# - sensor_frozen: the reading has not changed for a while in which the voltage has.
# - samples_poisoned: most samples of the last while were refused for their values.
# - voltage_differs: the samples do not show the voltages that were commanded for them. What was commanded stands in for
#   them: the memory follows it.
# - model_bad: the newest model is not finite, or far from every other, at positions all over the range.
# - nothing_learnt: the stage has moved for seconds and no sample of it was learnt; the detail names the gate. The
#   newest model is served all the same.
# - learner_failed: the learner raised; another one is started from the last good model after a while.
# - sensor_stuck, sensor_gain, sensor_sign, sensor_foreign, out_of_envelope: the learner reports that the readings do
#   not follow the voltage as those of this stage can.
#
# During the first three, and while the learner distrusts the sensor, nothing is learnt. Served meanwhile: the last good
# model from before the trouble; the learner's own where it has itself gone back to before the fault. A
# model that was not renewed for ``last_good_s`` gives way to the baseline, over a
# ramp.

SENSOR_FROZEN: Final = "sensor_frozen"
SAMPLES_POISONED: Final = "samples_poisoned"
VOLTAGE_DIFFERS: Final = "voltage_differs"
MODEL_BAD: Final = "model_bad"
LEARNER_FAILED: Final = "learner_failed"
NOTHING_LEARNT: Final = "nothing_learnt"
#: Verdicts on samples whose values cannot be used: they move no memory.
UNUSABLE: Final = frozenset({NOT_FINITE, OUT_OF_RANGE, TIMING})
#: Verdict on samples that nobody learns from.
NOT_LEARNING: Final = "not_learning"
#: Verdict on samples of which neither voltage nor reading is believed.
NOT_COMMANDED: Final = "not_commanded"
#: Verdicts that are no refusal of a sample in motion.
_NOT_REFUSED: Final = frozenset({LEARNT, PASSED, UNEXCITED, REDUNDANT, FROZEN, NOT_LEARNING})
#: What lets the learner follow such a change.
_WIDEN: Final = {
    OUT_OF_ENVELOPE: "if it is real, identify again, or widen learner.envelope.gain or learner.envelope.offset",
}
#: During these nothing is learnt.
POISON: Final = frozenset({SENSOR_FROZEN, SAMPLES_POISONED, VOLTAGE_DIFFERS}) | SENSOR_FAULTS
#: Wrong samples may have been learnt before one of these was named.
_TAUGHT: Final = POISON - {VOLTAGE_DIFFERS}
#: Refusals for the values of a sample. A stage at rest, or a sample out of sequence, is no trouble.
_BAD_VALUES: Final = frozenset({"not_finite", "timing", "glitch", "out_of_range", "numerics"})
#: Places at which a model is looked at, one after the other, as shares of the range.
_SWEEP: Final = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
#: Models that the watch keeps: the last good one, and two from before, the older and the newer.
ROLES: Final = ("good", "mark", "next_mark")


@dataclass(frozen=True, slots=True)
class ModelWatchConfig:
    """Thresholds of the troubles.

    Attributes
    ----------
    frozen_s, frozen_share : the sensor is frozen if the reading does not change for this time, s, while the voltage
    changes by this share of its range.
    poisoned_s, poisoned_share : time constant, s, and share of bad values from which samples are poisoned.
    insane_share : distance from the identified model, as a share of the voltage range, that no drift explains.
    recover_s : time without trouble, s, after which the newest model is served again.
    mark_s : age, s, from which a model counts as one from before the trouble.
    unseen_s : time, s, in which a wrong voltage may still be too near the commanded one to be noticed.
    last_good_s, ramp_s : times, s, for which the last good model is served, and in which the baseline takes over.
    silent_s : time of refused motion without a sample that is learnt, s, after which that is a trouble.
    revive_s : time, s, after which a failed learner is replaced.
    """

    frozen_s: float = 0.1
    frozen_share: float = 0.02
    poisoned_s: float = 0.25
    poisoned_share: float = 0.5
    insane_share: float = 1.0
    recover_s: float = 0.5
    mark_s: float = 0.5
    unseen_s: float = 0.1
    last_good_s: float = 60.0
    ramp_s: float = 1.0
    silent_s: float = 0.5
    revive_s: float = 5.0


class ModelWatch:
    """The watch over one axis. One thread calls it."""

    trouble: Annotated[str, Entry("name of the present trouble, empty for none", most=1000)]
    trust: Annotated[float, Entry("weight of the served model, 1 without trouble", low=0.0, high=1.0)]
    _n: Annotated[
        dict[str, float],
        Entry(
            "counts of samples, the repeated reading and its voltages, and the share of bad readings", finite=False,
            name="",
            among=("count", "still", "y", "u_low", "u_high", "bad", "marked", "since", "clean", "seen", "failed",
                   "silent", "silent_low", "silent_high"),
        ),
    ]  # fmt: skip
    _gate: Annotated[str, Entry("gate that refused the last sample in motion", name="gate", most=1000)]

    def __init__(self, config: ModelWatchConfig, dt_s: float, limits: Limits) -> None:
        self.config = config
        self.trouble = ""
        self.trust = 1.0
        self._dt_s = dt_s
        self._span_V = limits.u_max_V - limits.u_min_V
        self._limits = limits
        # The good models: newest, and two marks of which the older one is at least ``mark_s`` old.
        self._good: InverseModel | None = None
        self._mark: InverseModel | None = None
        self._next_mark: InverseModel | None = None
        self._n = {
            "count": 0, "still": 0, "y": math.nan, "u_low": math.inf, "u_high": -math.inf,
            "bad": 0.0, "marked": 0, "since": 0, "clean": 0, "seen": 0, "failed": 0,
            "silent": 0, "silent_low": math.inf, "silent_high": -math.inf,
        }  # fmt: skip
        self._gate = ""

    def take(self, u_V: float, y_um: float, verdict: str) -> None:
        """Take one sample in order, with the learner's verdict."""
        n, c = self._n, self.config
        n["count"] += 1
        if y_um == n["y"]:
            n["still"] += 1
            n["u_low"], n["u_high"] = min(n["u_low"], u_V), max(n["u_high"], u_V)
        else:
            n["still"], n["y"], n["u_low"], n["u_high"] = 0, y_um, u_V, u_V
        if verdict in _NOT_REFUSED or self.trouble not in ("", NOTHING_LEARNT):
            n["silent"], n["silent_low"], n["silent_high"] = 0, math.inf, -math.inf
        elif verdict != GAP:  # Missing samples have a trouble of their own.
            n["silent"] += 1
            n["silent_low"], n["silent_high"] = min(n["silent_low"], u_V), max(n["silent_high"], u_V)
            self._gate = verdict
        # A repeated reading belongs to the trouble sensor_frozen.
        bad = 1.0 if verdict in _BAD_VALUES and not n["still"] else 0.0
        n["bad"] += (bad - n["bad"]) * self._dt_s / c.poisoned_s

    def _trouble_of_samples(self) -> str:
        n, c = self._n, self.config
        # Hysteresis: a lower share ends the trouble than begins it.
        share = c.poisoned_share * (0.2 if self.trouble == SAMPLES_POISONED else 1.0)
        if n["bad"] > share:
            return SAMPLES_POISONED
        moved = n["u_high"] - n["u_low"] >= c.frozen_share * self._span_V
        if n["still"] * self._dt_s >= c.frozen_s and moved:
            return SENSOR_FROZEN
        drives = n["silent_high"] - n["silent_low"] >= c.frozen_share * self._span_V
        return NOTHING_LEARNT if n["silent"] * self._dt_s > c.silent_s and drives else ""

    @property
    def why(self) -> str:
        """What is wrong, in words, where the watch itself has found it."""
        if self.trouble != NOTHING_LEARNT:
            return ""
        silent_s = self.config.silent_s
        return f"no sample for {silent_s:g} s, the last one refused as {self._gate}; the next that passes ends it"

    def judge(
        self, candidate: InverseModel | None, identified: InverseModel | None, reported: str = "",
        distrusts: bool = False,
    ) -> InverseModel | None:  # fmt: skip
        """The model to serve: ``candidate`` or one from before; None: keep the present one. Once per snapshot.

        ``candidate`` : the newest model, None if the learner has failed. ``identified`` : the one that it began with.
        ``reported`` : the trouble that the learner reports. ``distrusts`` : whether it has the sensor on trial.
        Sets `trouble` and `trust`.
        """
        n, c = self._n, self.config
        now, elapsed = n["count"], n["count"] - n["seen"]
        n["seen"] = now
        found = reported or self._trouble_of_samples()
        if found in SENSOR_FAULTS and self.trouble in (SENSOR_FROZEN, SAMPLES_POISONED):
            found = self.trouble  # the same trouble, already named
        if not found:
            found = self._trouble_of_model(candidate, identified)
        if found:
            n["clean"] = 0
            if found != self.trouble:
                if not self.trouble:
                    n["since"] = now
                if found == VOLTAGE_DIFFERS and self._mark is not None:
                    fresh = (now - n["marked"]) * self._dt_s < c.unseen_s
                    self._good = self._mark if fresh or self._next_mark is None else self._next_mark
                elif found in _TAUGHT and self._mark is not None:
                    self._good = self._next_mark = self._mark
                self.trouble = found
        elif self.trouble:
            n["clean"] += elapsed
            if n["clean"] * self._dt_s >= c.recover_s:
                self.trouble = ""
        if self.trouble and distrusts and candidate is not None and self._sane(candidate, identified):
            # The learner has itself gone back to before the fault, which is better than an old snapshot.
            self._good = candidate
        if self.trouble in ("", NOTHING_LEARNT) and candidate is not None:
            self._good = candidate
            if not self.trouble and ((now - n["marked"]) * self._dt_s >= c.mark_s or self._mark is None):
                self._mark, self._next_mark, n["marked"] = self._next_mark or candidate, candidate, now
        old = bool(self.trouble) and (now - n["since"]) * self._dt_s > c.last_good_s
        step = elapsed * self._dt_s / c.ramp_s
        self.trust = max(0.0, self.trust - step) if old else min(1.0, self.trust + step)
        return self._good

    def _trouble_of_model(self, candidate: InverseModel | None, identified: InverseModel | None) -> str:
        if candidate is None:
            return LEARNER_FAILED
        return "" if candidate is self._good or self._sane(candidate, identified) else MODEL_BAD

    def failed_long(self) -> bool:
        """Whether to replace a failed learner now; call once per snapshot while it has failed."""
        n = self._n
        if not n["failed"]:
            n["failed"] = n["count"]
        if (n["count"] - n["failed"]) * self._dt_s < self.config.revive_s:
            return False
        n["failed"] = 0
        return True

    @property
    def good(self) -> InverseModel | None:
        """The model that was judged fit to be served; None before the first."""
        return self._good

    @property
    def teachable(self) -> bool:
        """Whether the samples may be learnt."""
        return self.trouble not in POISON

    def _sane(self, model: InverseModel, identified: InverseModel | None) -> bool:
        """Whether the model is finite over the range and no further from the identified one than drift explains."""
        low, high = self._limits.y_min_um, self._limits.y_max_um
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = 0.0, 1.0
            identified = None
        # Up and down over the range: on one branch alone a right model may be at its bound in most places.
        y = low + (high - low) * _SWEEP
        u = voltages_along(model, y)
        if not np.isfinite(u).all():
            return False
        if isinstance(model, LssvmInverse):
            still = np.zeros(y.size)
            if np.mean(model.at_bound(y, still, still, model.rest_memory(float(y[0])), u)) > 0.5:
                return False
        if identified is None:
            return True
        other = voltages_along(identified, y)
        inside = np.isfinite(other)
        return bool((np.abs(u - other)[inside] <= self.config.insane_share * self._span_V).all())

    def models(self) -> dict[str, InverseModel]:
        """The models that the watch keeps, by role; `restored` takes them back."""
        known = zip(ROLES, (self._good, self._mark, self._next_mark), strict=True)
        return {role: model for role, model in known if model is not None}

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where a count is no number."""
        for name, value in values["_n"].items():
            if name not in ("y", "u_low", "u_high", "silent_low", "silent_high") and not math.isfinite(value):
                raise ValueError(f"{name}: got {value}, expected a finite number")

    def restored(self, state: StateDict, models: dict[str, InverseModel]) -> ModelWatch:
        """A watch like this one that continues from its saved state and ``models``. Raises ModelFileError."""
        made = ModelWatch(self.config, self._dt_s, self._limits)
        restore(made, state)
        made._good, made._mark, made._next_mark = (models.get(role) for role in ROLES)
        return made


def voltages_along(model: InverseModel, y_um: FloatArray) -> FloatArray:
    """(n,) V at (n,) places, µm, that a slow motion passes in turn; NaN where the model fails."""
    zero = np.zeros(y_um.size)
    try:
        return model.feedforward(y_um, zero, zero, model.rest_memory(float(y_um[0]))).u_V
    except Exception as error:
        log_model_error(model, error)
        return np.full(y_um.size, math.nan)


# --- Stored states of a learner.

#: Version of the state of an axis (`service.server.axis.Axis.state_dict`); others are refused.
STATE_SCHEMA: Final = 6
#: Settings in a learner's state.
_SETTINGS: Final = re.compile(r"(^|\.)config\.")


def restored_learner(state: StateDict, like: OnlineModel) -> OnlineModel:
    """A learner of the kind and with the settings of ``like``, with ``state``.

    Raises ModelFileError with the reason if it does not fit.
    """
    if not state:
        raise ModelFileError("it holds no learner, but this axis learns")
    for name, value in like.state_dict().items():
        if _SETTINGS.search(name) and not (name in state and _equal(value, state[name])):
            got, wanted = _short(state.get(name)), _short(value)
            raise ModelFileError(f"it belongs to another setting: {name} is {got}, now {wanted}")
    return like.restored(state)


def stored_model(state: StateDict, like: InverseModel, what: str) -> InverseModel:
    """The model with ``state`` and its kind. Raises ModelFileError where it cannot stand in the place of ``like``."""
    kind = str(state.get("kind"))
    if not isinstance(like, Kinded):  # else its own entry
        state.pop("kind", None)
    made = build_model(kind, state, what)
    check_like(made, like, "kind")
    return made


@dataclass(slots=True)
class SupervisorEntries:
    """What a `LearnerSupervisor` holds beside the learner, the watch and the models."""

    frozen_by: Annotated[str, Entry("who has stopped learning, empty for nobody", most=1000)]
    dead: Annotated[bool, Entry("whether the learner has failed")]
    adoptions: Annotated[str, Entry("hyper-parameters that wait for their sample, as JSON")]


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


#: Largest distance, in learnt spans, at which the stand-in answers alone.
MOST_BLEND_SHARE: Final = 100.0


def champion_of(learner: OnlineModel | None) -> dict[str, InverseModel]:
    """The champion under its name; empty without a competition."""
    return {AUTO: learner.champion_model()} if isinstance(learner, Competition) else {}


def blend_share_of(learner: OnlineModel | None, stand_in: str, least: float) -> float:
    """Distance outside the learnt domain, in learnt spans, at which ``stand_in`` answers alone; at least ``least``.

    Twice the distance at which the learner is as uncertain as the stand-in has been wrong: the model with the smaller
    error on this stage answers.
    """
    reach = learner.reach(stand_in) if isinstance(learner, Competition) else 0.0
    return max(least, min(2.0 * reach, MOST_BLEND_SHARE))


def standing_of(learner: OnlineModel | None) -> dict[str, Any] | None:
    """Champion, changes, and the rms error of each contestant; None without a competition."""
    return learner.standing() if isinstance(learner, Competition) else None


# --- Supervision.

#: Interval at which the learner's state is kept to go back to while there is no trouble, s of samples.
MARK_S: Final = 1.0

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

    def handle(self, sample: Sample, doubtful: bool = False) -> str:
        """Take one sample, and learn it unless it is ``doubtful``; the learner's verdict."""
        if self.learner is None or self._failed:
            return NOT_LEARNING
        try:
            if not doubtful:
                return self.learner.handle(sample)
            self.learner.freeze()
            verdict = self.learner.handle(sample)
            self._set_teaching()
            return verdict
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

    def models(self, last: Served, received: int, differs: str = "") -> dict[str, InverseModel]:
        """The learner's models to serve after ``last``: the newest or the last good one, and the champion.

        ``received`` : count of all samples that came. ``differs`` : in which way samples do not show the commanded
        voltages; "" while they do.
        """
        if self.learner is None:
            return {}
        if self._failed and self._revive is not None and self.watch.failed_long():
            self._start_again(self._revive, last.models[self.name])
        candidate = self._snapshot(self.learner)
        alive = not self._failed
        reported, distrusts = (self.learner.trouble, self.learner.distrusts) if alive else ("", False)
        why = self.learner.why if reported else ""
        if differs:
            reported, distrusts, why = VOLTAGE_DIFFERS, False, differs
        before = self.watch.trouble
        good = self.watch.judge(candidate, self.learner.base, reported, distrusts)
        now = self.watch.trouble
        if not now and not before:
            self._mark(self.learner, received)
        if now != before:
            if before in _TAUGHT and not now:
                self._go_back(self.learner)
            self._set_teaching()
            self._note_trouble(before, now, why or self.watch.why, last.stand_in)
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
        adoptions = json.dumps([retuned.to_json() for retuned in self.adoptions.pending])
        state = save(SupervisorEntries(self._frozen_by, self._failed, adoptions))
        state |= prefixed("watch.", save(self.watch))
        for role, model in self.watch.models().items():
            state |= {f"model.{role}.kind": stored_kind(model), **prefixed(f"model.{role}.", model.state_dict())}
        if poisoned:
            state |= prefixed("mark.", self._marks[0])
        if self.learner is not None:
            state |= prefixed("learner.", self.learner.state_dict())
        return state

    def restored(self, state: StateDict, received: int) -> LearnerSupervisor:
        """A supervisor like this one with ``state``, of which all entries must be its own; this one does not change.

        Raises ModelFileError, or ValueError of a damaged adoption.
        """
        rest, learner, models = dict(state), self.learner, {}
        with part_of(rest, "learner.") as kept:
            learner = None if self.learner is None else restored_learner(kept, self.learner)
        for role in ROLES:
            with part_of(rest, f"model.{role}.") as kept:
                if kept and learner is not None:
                    models[role] = stored_model(kept, learner.snapshot(), f"the {role} model")
        with part_of(rest, "watch.") as kept:
            watch = self.watch.restored(kept, models)
        with part_of(rest, "mark.") as mark:
            if mark and self.learner is not None:
                restored_learner(mark, self.learner)
        own = load(SupervisorEntries, rest)
        made = LearnerSupervisor(self.name, learner, watch, self._dt_s, self._note, self._revive)
        made._frozen_by, made._failed = own.frozen_by, own.dead
        made.adoptions.add(*(Retuned.from_json(entry, "adoptions") for entry in json.loads(own.adoptions)))
        made._marks, made._marked = (mark, {}), received
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

    def _note_trouble(self, before: str, now: str, why: str, stand_in: str) -> None:
        if now == LEARNER_FAILED:  # already noted
            return
        if not now:
            self._note("recovered", before)
            return
        why = f" ({why})" if why else ""
        widen = f"; {_WIDEN[now]}" if now in _WIDEN else ""
        self._note("trouble", f"{now}{why}: the last good model is served, then {stand_in or 'nothing else'}{widen}")

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
