"""Teaches the learner of an axis, and replaces it where it fails or has learnt bad samples.

Which of its models is served is decided in `service.answers.which_model`. All of it runs in the thread that handles
samples and depends on the samples alone, so that a standby and a replay decide alike.
"""

from __future__ import annotations

import json
import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Final, Protocol

import numpy as np

from dehyst.adaptive.errors import DehystError, ModelFileError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.gates import (
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
from dehyst.adaptive.online.sensor_trust import OUT_OF_ENVELOPE, SENSOR_FAULTS
from dehyst.adaptive.state import Entry, Kinded, load, part_of, restore, save
from dehyst.adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict, prefixed
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.baselines.competition.competition import Competition, check_like
from dehyst.service.answers.answering import Served
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.which_model import (
    LEARNER_FAILED,
    MODELS,
    NOTHING_LEARNT,
    ROLES,
    SAMPLES_POISONED,
    SENSOR_FROZEN,
    VOLTAGE_DIFFERS,
    Kept,
    ModelChoice,
    rule_of,
)
from dehyst.service.background.adoptions import Adoptions, Retuned
from dehyst.service.protocol.keys import AUTO
from dehyst.service.protocol.model import build_model, stored_kind

# --- The watch over the samples. What is wrong with them has a name, with hysteresis, and ends by itself:
#
# - sensor_frozen: the reading has not changed for a while in which the voltage has.
# - samples_poisoned: most samples of the last while were refused for their values.
# - nothing_learnt: the voltage has moved for a while in which every sample was refused; the detail names the gate.
#
# The learner itself reports faults of the sensor.

#: Verdicts on samples whose values cannot be used: they move no memory.
UNUSABLE: Final = frozenset({NOT_FINITE, OUT_OF_RANGE, TIMING})
#: Verdict on samples where no model learns.
NOT_LEARNING: Final = "not_learning"
#: Verdict on samples of which neither voltage nor reading is believed.
NOT_COMMANDED: Final = "not_commanded"
#: Verdicts that are no refusal of a sample in motion.
NOT_REFUSED: Final = frozenset({LEARNT, PASSED, UNEXCITED, REDUNDANT, FROZEN, NOT_LEARNING})
#: What lets the learner follow such a change.
_WIDEN: Final = {
    OUT_OF_ENVELOPE: "if it is real, identify again, or widen learner.envelope.gain or learner.envelope.offset",
}
#: Refusals for the values of a sample. A stage at rest, or a sample out of sequence, is no trouble.
_BAD_VALUES: Final = frozenset({"not_finite", "timing", "glitch", "out_of_range", "numerics"})


#: The sensor is frozen if the reading does not change for this time, s, while the voltage moves by this share of its
#: range. No less motion counts as such.
FROZEN_S, MOVES_SHARE = 0.1, 0.02
#: Time constant, s, and share of bad values from which samples are poisoned; and the share at which that ends.
POISONED_S, POISONED_SHARE, CLEAN_SHARE = 0.25, 0.5, 0.1
#: Time of refused motion after which that is a trouble, s, and readings of that time by which models are compared.
SILENT_S, COMPARED = 0.5, 50


@dataclass(slots=True)
class Run:
    """Samples in a row that have something in common, and the range of their voltages."""

    count: Annotated[int, Entry("samples in a row", low=0)] = 0
    low_V: Annotated[float, Entry("their smallest voltage", "V", finite=False)] = math.inf
    high_V: Annotated[float, Entry("their largest voltage", "V", finite=False)] = -math.inf

    def take(self, goes_on: bool, u_V: float) -> None:
        """Take a sample with the voltage ``u_V``; where it has not the same in common, another run begins with it."""
        if goes_on:
            self.count += 1
        else:
            self.count, self.low_V, self.high_V = 0, math.inf, -math.inf
        self.low_V, self.high_V = min(self.low_V, u_V), max(self.high_V, u_V)


class SampleWatch:
    """The watch over the samples of one axis. One thread calls it."""

    count: Annotated[int, Entry("samples so far", low=0)]
    _y_um: Annotated[float, Entry("the last reading", "µm", finite=False)]
    _still: Annotated[Run, Entry("samples since that repeat it")]
    _silent: Annotated[Run, Entry("samples since one was accepted; missing ones have a trouble of their own")]
    _bad: Annotated[float, Entry("share of bad readings of late")]
    _gate: Annotated[str, Entry("gate that refused the last sample in motion", most=1000)]
    _recent: Annotated[
        deque[tuple[float, float]], Entry("the last readings, and their voltages", "µm, V", "*,2", most=COMPARED)
    ]

    def __init__(self, dt_s: float, span_V: float) -> None:
        self._dt_s, self._span_V = dt_s, span_V
        self._every = max(1, round(SILENT_S / (COMPARED * dt_s)))
        self._recent = deque(maxlen=COMPARED)
        self.count, self._y_um, self._bad, self._gate = 0, math.nan, 0.0, ""
        self._still, self._silent = Run(), Run()

    def take(self, u_V: float, y_um: float, verdict: str) -> None:
        """Take one sample in order, with the verdict on it."""
        self.count += 1
        if self.count % self._every == 0 and math.isfinite(y_um) and verdict not in UNUSABLE:
            self._recent.append((y_um, u_V))
        self._still.take(y_um == self._y_um, u_V)
        self._y_um = y_um
        if verdict != GAP:
            self._silent.take(verdict not in NOT_REFUSED, u_V)
            self._gate = verdict
        # A repeated reading belongs to the trouble sensor_frozen.
        bad = 1.0 if verdict in _BAD_VALUES and not self._still.count else 0.0
        self._bad += (bad - self._bad) * self._dt_s / POISONED_S

    def trouble(self, now: str) -> str:
        """Name of what is wrong with the samples, "" for nothing; ``now`` : the present trouble."""
        if self._bad > (CLEAN_SHARE if now == SAMPLES_POISONED else POISONED_SHARE):
            return SAMPLES_POISONED
        if self._lasts(self._still, FROZEN_S):
            return SENSOR_FROZEN
        # What another trouble refuses is no news.
        return NOTHING_LEARNT if now in ("", NOTHING_LEARNT) and self._lasts(self._silent, SILENT_S) else ""

    def _lasts(self, run: Run, least_s: float) -> bool:
        moved_V = run.high_V - run.low_V
        return run.count * self._dt_s >= least_s and moved_V >= MOVES_SHARE * self._span_V

    def recent(self) -> FloatArray:
        """(4, n) y, µm, v, µm/s, a, µm/s², and u, V, of the last `SILENT_S`; unusable readings are passed over."""
        y_um, u_V = np.array(self._recent).reshape(-1, 2).T
        if y_um.size < 2:
            return np.empty((4, 0))
        v_um_per_s = np.gradient(y_um, self._every * self._dt_s)
        return np.stack((y_um, v_um_per_s, np.gradient(v_um_per_s, self._every * self._dt_s), u_V))

    @property
    def why_nothing(self) -> str:
        """The reason for ``nothing_learnt`` in words."""
        return f"no sample for {SILENT_S:g} s, the last one refused as {self._gate}; the next that passes ends it"


# --- Stored states of a learner.

#: Version of the state of an axis (`service.server.axis.Axis.state_dict`); others are refused.
STATE_SCHEMA: Final = 10
#: Settings in a learner's state.
_SETTINGS: Final = re.compile(r"(^|\.)config\.")


def restored_learner(state: StateDict, like: OnlineModel) -> OnlineModel:
    """A learner of the kind and with the settings of ``like``, with ``state``.

    Raises ModelFileError with the reason if it does not fit.
    """
    if not state:
        raise ModelFileError("it holds no learner, but this axis learns")
    for name, value in like.state_dict().items():
        got, wanted = _plain(state.get(name)), _plain(value)
        if _SETTINGS.search(name) and got != wanted:
            raise ModelFileError(f"it belongs to another setting: {name} is {got[:60]}, now {wanted[:60]}")
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
    dead_at: Annotated[int, Entry("samples when that was found", low=0)]
    adoptions: Annotated[str, Entry("hyper-parameters that wait for their sample, as JSON")]


def _plain(value: Any) -> str:
    """A setting as text; a file stores a number that is not finite as an array, and a tuple as a list."""
    return repr(np.asarray(value).tolist())


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
#: Time after which a failed learner is replaced, s of samples.
REVIVE_S: Final = 5.0

#: Starts a learner from a model, after the one before has failed.
Revive = Callable[[InverseModel], OnlineModel]


class Note(Protocol):
    """Tells an event of the axis."""

    def __call__(self, event: str, detail: str, **more: Any) -> None: ...


class LearnerSupervisor:
    """The learner of one axis, the watch over its samples, and the choice of the model that is served.

    Parameters
    ----------
    name : of the model that learns; "" for none.
    learner : None for an axis that does not learn.
    limits : of the axis. last_good_s : time for which a model from before a trouble is trusted, s.
    dt_s : sample time, s. note : tells events.
    revive : starts another learner `REVIVE_S` after this one has failed; None: it stays failed.

    Attributes
    ----------
    watch : finds what is wrong with the samples.
    choice : decides which model is served, and whether samples are learnt.
    """

    def __init__(
        self,
        name: str,
        learner: OnlineModel | None,
        limits: Limits,
        last_good_s: float,
        dt_s: float,
        note: Note,
        revive: Revive | None,
    ) -> None:
        self.name = name
        self.learner = learner
        self.watch = SampleWatch(dt_s, limits.u_max_V - limits.u_min_V)
        self.choice = ModelChoice(dt_s, limits, last_good_s)
        self.adoptions = Adoptions()
        self._limits, self._last_good_s, self._dt_s = limits, last_good_s, dt_s
        self._note = note
        self._revive = revive
        self._failed = False
        self._failed_at = 0
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
        choice, now = self.choice, self.watch.count
        if self._failed and self._revive is not None and (now - self._failed_at) * self._dt_s >= REVIVE_S:
            self._start_again(self._revive, last.models[self.name])
        candidate = self._snapshot(self.learner)
        reported = "" if self._failed else self.learner.trouble
        distrusts = not self._failed and self.learner.distrusts
        before = choice.trouble
        found, why = reported, self.learner.why if reported else ""
        if differs:
            found, why, distrusts = VOLTAGE_DIFFERS, differs, False
        elif not reported or (reported in SENSOR_FAULTS and before in (SENSOR_FROZEN, SAMPLES_POISONED)):
            found = before if reported else self.watch.trouble(before)  # a fault that is named already keeps its name
        good = choice.choose(now, candidate, self.learner.base, found, distrusts, self.watch.recent)
        if not choice.trouble and not before:
            self._mark(self.learner, received)
        if choice.trouble != before:
            if rule_of(before).returns and not choice.trouble:
                self._go_back(self.learner)
            self._set_teaching()
            self._note_trouble(before, why, last.stand_in)
        for event in self.learner.take_events():
            self._note(*event)
        if good is None:
            return {}
        return {self.name: good, **self._champion(last, good)}

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

    def state_dict(self) -> StateDict:
        """All that samples and operators have changed; copies. With the state to go back to where it is needed."""
        adoptions = json.dumps([retuned.to_json() for retuned in self.adoptions.pending])
        state = save(SupervisorEntries(self._frozen_by, self._failed, self._failed_at, adoptions))
        state |= prefixed("watch.", save(self.watch)) | prefixed("choice.", save(self.choice))
        for role, model in self.choice.models().items():
            state |= {f"model.{role}.kind": stored_kind(model), **prefixed(f"model.{role}.", model.state_dict())}
        if not self.choice.rule.teaches:
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
        made = LearnerSupervisor(
            self.name, learner, self._limits, self._last_good_s, self._dt_s, self._note, self._revive
        )
        for name, part in (("watch.", made.watch), ("choice.", made.choice)):
            with part_of(rest, name) as kept:
                restore(part, kept)
        made.choice.keep(models)
        with part_of(rest, "mark.") as mark:
            if mark and self.learner is not None:
                restored_learner(mark, self.learner)
        own = load(SupervisorEntries, rest)
        made._frozen_by, made._failed, made._failed_at = own.frozen_by, own.dead, own.dead_at
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
        self._failed, self._failed_at = True, self.watch.count
        self._note("learner_failed", f"{why}; the last good model stays in service")

    def _start_again(self, revive: Revive, model: InverseModel) -> None:
        try:
            self.learner, self._failed = revive(model), False
        except Exception as error:
            self._failed_at = self.watch.count
            self._note("learner_failed", f"beginning anew: {type(error).__name__}: {error}")
        else:
            self._set_teaching()
            self._note("learner_begun_anew", "from the last good model")

    def _note_trouble(self, before: str, why: str, stand_in: str) -> None:
        now, rule = self.choice.trouble, self.choice.rule
        if now == LEARNER_FAILED:  # already noted
            return
        if not now:
            self._note("recovered", before)
            return
        why = why or (self.watch.why_nothing if now == NOTHING_LEARNT else "")
        why = f" ({why})" if why else ""
        widen = f"; {_WIDEN[now]}" if now in _WIDEN else ""
        served = f"{MODELS[rule.answers]} is served, then {stand_in or 'nothing else'}"
        self._note("trouble", f"{now}{why}: {served}{widen}")

    def _champion(self, last: Served, good: InverseModel) -> dict[str, InverseModel]:
        """The champion under its name. Samples that teach nothing change no champion, only its model of the learner."""
        if self._failed:
            return {}
        rule = self.choice.rule
        found = (champion_of(self.learner) if rule.teaches else last.models).get(AUTO)
        if not isinstance(found, ChampionInverse) or (not rule.teaches and last.models[self.name] is good):
            return {}
        if rule.kept is Kept.NEWEST or self.name not in found.names:
            return {AUTO: found}
        return {AUTO: found.with_model(self.name, good)}

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
        if self.frozen or not self.choice.rule.teaches:
            self.learner.freeze()
        else:
            self.learner.thaw()
