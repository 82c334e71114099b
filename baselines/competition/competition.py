"""Several online models learn from the same samples, and the one that predicts best is served.

Every contestant is scored on fresh samples (`baselines.competition.contestants`). The champion is replaced only by a
contestant that has been clearly better for a while (`baselines.competition.competition`), and callers pass to the
new champion without a jump (`baselines.competition.champion`).

The first contestant is the favourite. Its verdicts on samples are those of the competition, it is the first champion,
and it becomes champion again as soon as it is no worse. A contestant that raises leaves the competition and the others
go on; the favourite can start anew from its last snapshot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    prefixed,
    under,
)
from baselines.competition.champion import ChampionInverse
from baselines.competition.config import CompetitionConfig
from baselines.competition.contestants import (
    NOT_SCORED,
    ONLINE_KINDS,
    Judge,
    Restart,
    SmoothedMotion,
    fingerprint,
    online_form,
    with_deviation_of_at_least,
)

# --- The rules by which a competition replaces its champion.

BETTER = "it predicts better"
FAILED = "its answers are not finite, or it failed"


@dataclass(slots=True)
class ChampionChoice:
    """The present champion, and for how long another contestant has been clearly better.

    Attributes
    ----------
    config : margin, floor and patience.
    span_V : voltage span that the floor refers to, V.
    champion : index of the contestant that is served.
    ahead_s : motion during which another contestant has been ahead without a break, s.
    changes : number of changes of champion.
    """

    config: CompetitionConfig
    span_V: float
    champion: int = 0
    ahead_s: float = 0.0
    changes: int = 0

    def choose(self, errors_V: Sequence[float], scored_s: float) -> str:
        """Choose by the rms errors (k,), V, after ``scored_s`` more seconds of scored motion.

        An infinite error marks a contestant that cannot be served. Returns the reason for a change of champion, or ""
        where there is none.
        """
        c, now, best = self.config, self.champion, int(np.argmin(errors_V))
        if math.isinf(errors_V[now]) and math.isfinite(errors_V[best]):
            return self._replace_by(best, FAILED)
        # The favourite returns as soon as it is no worse; a challenger must win by the margin and the floor.
        other = 0 if now != 0 and errors_V[0] < errors_V[now] else best
        margin, floor_V = (1.0, 0.0) if other == 0 else (c.margin, c.floor * self.span_V)
        ahead = other != now and errors_V[now] > margin * errors_V[other] + floor_V
        self.ahead_s = self.ahead_s + scored_s if ahead else 0.0
        if ahead and self.ahead_s >= c.patience_s:
            return self._replace_by(other, BETTER)
        return ""

    def _replace_by(self, champion: int, why: str) -> str:
        self.champion, self.ahead_s = champion, 0.0
        self.changes += 1
        return why


# --- The competition.


class Competition:
    """Several online models of one axis. Implements ``adaptive.types.OnlineModel``; deterministic.

    Parameters
    ----------
    contestants : online models by name, all of one sample time; the first is the favourite.
    range_um, span_V : displacement range and voltage range of the identification.
    restart : makes the favourite anew from its last snapshot, ``revive_s`` after it has raised. None: it stays out.

    Raises InputError where there is no contestant or a range is not positive.
    """

    def __init__(
        self,
        contestants: dict[str, OnlineModel],
        range_um: float,
        span_V: float,
        config: CompetitionConfig | None = None,
        restart: Restart | None = None,
    ) -> None:
        if not contestants or not (range_um > 0.0 and span_V > 0.0):
            raise InputError(
                f"contestants, range_um, span_V: got {len(contestants)}, {range_um}, {span_V}, expected all positive"
            )
        self.config = config or CompetitionConfig()
        self.names = tuple(contestants)
        self._models = list(contestants.values())
        first = tuple(model.snapshot() for model in self._models)
        self._dt_s, self._range_um, self._span_V = first[0].dt_s, range_um, span_V
        self._motion = SmoothedMotion(self.config, self._dt_s, range_um)
        self.judge = Judge(self.config, first, self._motion.lag, span_V)
        self._choice = ChampionChoice(self.config, span_V)
        self._newest = first
        self._serving = ChampionInverse(self.names, first, 0, self.config.blend_s)
        self._out = [False] * len(first)
        self._seq = -1
        self._frozen = False
        # Whether a contestant may have changed since its snapshot was taken.
        self._changed = True
        self._restart, self._failed_seq = restart, -1
        self._events: deque[tuple[str, str]] = deque(maxlen=64)

    @classmethod
    def from_models(
        cls,
        favourite: str,
        learner: OnlineModel,
        model: InverseModel,
        others: dict[str, InverseModel],
        config: CompetitionConfig | None = None,
        restart: Restart | None = None,
    ) -> Competition:
        """``learner``, started from ``model``, against the online forms of ``others``; those without one are left out.

        Raises InputError unless ``model`` is an LSSVM, whose ranges errors are measured by.
        """
        if not isinstance(model, LssvmInverse):
            raise InputError(f"{favourite}: got a {type(model).__name__}, expected an LSSVM model")
        contestants: dict[str, OnlineModel] = {favourite: learner}
        for name, other in others.items():
            online = online_form(other)
            if online is not None and name != favourite:
                contestants[name] = online
        range_um = model.features.y_max_um - model.features.y_min_um
        return cls(contestants, range_um, model.span_V, config, restart)

    @property
    def favourite(self) -> OnlineModel:
        """The first contestant."""
        return self._models[0]

    @property
    def champion(self) -> str:
        """Name of the contestant that is served."""
        return self.names[self._serving.champion]

    @property
    def trouble(self) -> str:
        """Name of what the favourite finds wrong with the samples, "" while nothing is."""
        return self.favourite.trouble

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words."""
        return self.favourite.why

    @property
    def distrusts(self) -> bool:
        """Whether the favourite does not trust the readings at present."""
        return self.favourite.distrusts

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        return self._seq

    @property
    def base(self) -> InverseModel:
        """The identified model that the favourite started from."""
        return self.favourite.base

    # ---- samples in

    def handle(self, sample: Sample) -> str:
        """Give a sample to every contestant. Returns the verdict of the first contestant that is still in.

        Raises the error of the last contestant where none is left.
        """
        verdict, seq, self._changed = "", self._seq, True
        for i, model in enumerate(self._models):
            # While frozen, one contestant still judges and tracks; the others would only learn.
            if self._out[i] or (self._frozen and i and verdict):
                continue
            try:
                said, now = model.handle(sample), model.seq
            except Exception as error:
                self._exclude(i, error)
                continue
            if not verdict:
                verdict, seq = said, now
        before, self._seq = self._seq, seq
        if seq == before:
            return verdict
        self._motion.take(sample, max(0, seq - before - 1) if before >= 0 else 0, verdict not in NOT_SCORED)
        if seq // self.config.block > before // self.config.block:
            self._judge_block()
        return verdict

    def window_data(self) -> WindowData | None:
        """The samples of the favourite, to tune its hyper-parameters on."""
        return self.favourite.window_data()

    def adopt(self, hyper: Hyperparameters) -> str:
        """Let the favourite continue with other hyper-parameters. Returns "", or the reason for a refusal."""
        self._changed = True
        return self.favourite.adopt(hyper)

    def freeze(self) -> None:
        """Stop learning and keep the champion; samples are still judged."""
        self._frozen = self._changed = True
        self.favourite.freeze()

    def thaw(self) -> None:
        """Learn again, and choose the champion again."""
        self._frozen, self._changed = False, True
        self.favourite.thaw()

    @property
    def frozen(self) -> bool:
        """Whether learning is stopped."""
        return self._frozen

    def resync(self) -> None:
        """Accept the next sample whatever its sequence number, because the stage has restarted."""
        for model in self._models:
            model.resync()

    def take_place_of(self, other: OnlineModel) -> None:
        """Continue at the position of ``other`` with the models of this one; ``resync`` where the types differ."""
        if not isinstance(other, Competition):
            self.resync()
            return
        for mine, its, its_out in zip(self._models, other._models, other._out, strict=True):
            if its_out:
                mine.resync()
            else:
                mine.take_place_of(its)

    def _exclude(self, i: int, error: Exception) -> None:
        self._out[i] = True
        if i == 0:
            self._failed_seq = self._seq
        name = "contestant_failed" if i else "learner_failed"
        self._events.append((name, f"{self.names[i]}: {type(error).__name__}: {error}; the others go on"))
        if all(self._out):
            raise error

    def _judge_block(self) -> None:
        """Score the block of motion that has passed, then choose the champion."""
        rows = self._motion.block()
        self._restart_favourite()
        self._newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        unusable = self.judge.score(self._seq, rows, self._out)
        self.judge.adopt_tracked_memories(self._models, self._newest)
        self.judge.remember(self._seq, self._newest)
        if not self._frozen:
            self._choose(unusable, float(rows[4].sum()) * self._dt_s)
        self._serving = self._served()
        self._changed = False

    def _choose(self, unusable: list[bool], scored_s: float) -> None:
        errors_V = [math.inf if bad else self.judge.rms_V(i) for i, bad in enumerate(unusable)]
        before = self._choice.champion
        why = self._choice.choose(errors_V, scored_s)
        if why:
            self._events.append(("champion_changed", self._describe_change(errors_V, before, why)))

    def _describe_change(self, errors_V: Sequence[float], before: int, why: str) -> str:
        after, old = (
            f"{self.names[i]} ({errors_V[i] / self._span_V:.3%} rms)" for i in (self._choice.champion, before)
        )
        return f"{after} is served in place of {old}: {why}"

    def _snapshot(self, i: int) -> InverseModel:
        if not self._out[i]:
            try:
                return self._models[i].snapshot()
            except Exception as error:
                self._exclude(i, error)
        return self._newest[i]

    def _restart_favourite(self) -> None:
        """Restart a failed favourite from its last snapshot, ``revive_s`` after the failure; its score starts anew."""
        waited_s = (self._seq - self._failed_seq) * self._dt_s
        if self._restart is None or not self._out[0] or waited_s < self.config.revive_s:
            return
        self._failed_seq = self._seq
        try:
            self._models[0] = self._restart(self._newest[0])
        except Exception as error:
            self._events.append(("learner_failed", f"{self.names[0]}: restart from its last snapshot: {error}"))
            return
        self._out[0] = False
        self.judge.begin_anew(0)
        (self.freeze if self._frozen else self.thaw)()
        self._events.append(("learner_begun_anew", f"{self.names[0]}: from its last snapshot"))

    # ---- out

    def snapshot(self) -> ChampionInverse:
        """What is served: the champion of the last judgement, with its present parameters. Immutable."""
        if not self._changed:
            return self._serving
        self._changed = False
        newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        if any(new is not old for new, old in zip(newest, self._newest, strict=True)):
            self._newest = newest
            self._serving = self._served()
        return self._serving

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) memory of the favourite for ``model``, a snapshot of the favourite."""
        return self.favourite.memory_for(model, smoothed)

    def warm(self) -> None:
        """Load every compiled step of the favourite; the others load theirs with their first samples."""
        self.favourite.warm()

    def _served(self) -> ChampionInverse:
        """The newest snapshots; the champion states at least the error that was measured on its answers."""
        champion, models = self._choice.champion, list(self._newest)
        models[champion] = with_deviation_of_at_least(models[champion], self.judge.rms_V(champion))
        return ChampionInverse(self.names, tuple(models), champion, self.config.blend_s)

    def take_events(self) -> list[tuple[str, str]]:
        """(event name, detail for people) since the last call, oldest first."""
        events = list(self._events)
        self._events.clear()
        return events

    def standing(self) -> dict[str, Any]:
        """Champion, number of changes, and the rms error of each contestant in V and in percent of the span."""
        table = {
            name: {
                "rms_V": self.judge.rms_V(i),
                "rms_pct": self.judge.rms_V(i) * 100.0 / self._span_V,
                "scored": round(self.judge.scores[i].weight, 4),
                "failed": self._out[i],
            }
            for i, name in enumerate(self.names)
        }
        return {"champion": self.champion, "changes": self._choice.changes, "contestants": table}

    def counters(self) -> dict[str, int]:
        """Those of the favourite and of the competition."""
        own = {"champion_changes": self._choice.changes, "contestants_failed": sum(self._out)}
        return {**self.favourite.counters(), **own}

    def diagnostics(self) -> dict[str, Any]:
        """Those of the favourite, ``competition_NAME_rms_pct`` of each contestant, and the champion's index."""
        values = self.favourite.diagnostics()
        percent = 100.0 / self._span_V
        own = {f"competition_{name}_rms_pct": self.judge.rms_V(i) * percent for i, name in enumerate(self.names)}
        return {**values, **own, "competition_champion": float(self._choice.champion)}

    # ---- saving and loading

    def state_dict(self) -> StateDict:
        """The whole state as flat entries, all copies; ``from_state`` continues to the same last bit.

        Raises InputError where a contestant is of a class that cannot be stored.
        """
        kinds: dict[type, str] = {known: kind for kind, known in ONLINE_KINDS.items()}
        if any(type(model) not in kinds for model in self._models):
            raise InputError(f"contestants: expected models of the kinds {', '.join(ONLINE_KINDS)} to be stored")
        state: StateDict = {
            "names": ",".join(self.names),
            "kinds": ",".join(kinds[type(model)] for model in self._models),
            "range_um": self._range_um,
            "span_V": self._span_V,
            "seq": self._seq,
            "frozen": self._frozen,
            "failed_seq": self._failed_seq,
            "champion": self._choice.champion,
            "ahead_s": self._choice.ahead_s,
            "changes": self._choice.changes,
            "out": np.array(self._out, dtype=np.bool_),
        }
        state |= prefixed("config.", self.config.state_dict())
        state |= prefixed("motion.", self._motion.state_dict())
        state |= prefixed("newest.", ChampionInverse(self.names, self._newest, 0).state_dict())
        state |= self.judge.state_dict(self.names)
        for name, model in zip(self.names, self._models, strict=True):
            # The identified model, so that a state that belongs to another identification can be told apart.
            state[f"base.{name}"] = fingerprint(model.base)
            state |= prefixed(f"model.{name}.", model.state_dict())
        return state

    def restored(self, state: StateDict) -> Competition:
        """A competition with ``state`` that restarts its favourite as this one does. Raises ModelFileError."""
        return self.from_state(state, self._restart)

    @classmethod
    def from_state(cls, state: StateDict, restart: Restart | None = None) -> Competition:
        """Inverse of ``state_dict``; ``restart`` as in the constructor.

        Raises ModelFileError where an entry is missing or damaged.
        """
        try:
            names, kinds = str(state["names"]).split(","), str(state["kinds"]).split(",")
            contestants = {
                name: ONLINE_KINDS[kind].from_state(under(f"model.{name}.", state))
                for name, kind in zip(names, kinds, strict=True)
            }
            config = CompetitionConfig(**under("config.", state))
            made = cls(contestants, float(state["range_um"]), float(state["span_V"]), config, restart)
            made._restore(state)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"competition state: entry missing or damaged: {error}; start from models") from error
        return made

    def _restore(self, state: StateDict) -> None:
        """Continue from ``state``, which holds the same contestants. Raises KeyError, ValueError or TypeError."""
        self._motion.restore(under("motion.", state))
        self.judge.restore(self.names, state)
        self._newest = ChampionInverse.from_state(under("newest.", state)).models
        self._choice.champion, self._choice.changes = int(state["champion"]), int(state["changes"])
        self._choice.ahead_s = float(state["ahead_s"])
        self._serving = self._served()
        self._out = [bool(out) for out in np.asarray(state["out"]).tolist()]
        self._frozen, self._failed_seq = bool(state["frozen"]), int(state["failed_seq"])
        self._seq = int(state["seq"])
