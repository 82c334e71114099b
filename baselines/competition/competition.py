"""Champion and challengers: several online models on the same samples, and what is served is the best of them.

Each is scored on fresh samples (``baselines.competition.scoring``); the champion gives way only to one that has been
better by a
margin for a while (``baselines.competition.succession``), and callers go over without a jump
(``baselines.competition.champion``). The first
contestant is the favourite: its verdicts on samples are the competition's, it is champion at the start, and it comes
back as soon as it is no worse. A contestant that raises is out of the competition, and the others go on; the favourite
may begin anew.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, Hyperparameters, InverseModel, OnlineModel, Sample, StateDict, WindowData
from baselines.competition.champion import ChampionInverse
from baselines.competition.config import CompetitionConfig
from baselines.competition.contestants import ONLINE_KINDS, Revive, challenger, fingerprint, stating
from baselines.competition.scoring import NOT_SCORED, Judging, Motion
from baselines.competition.succession import Succession

# --- What a competition tells of itself: the standing, counters and diagnostics.


def standing(c: Competition) -> dict[str, Any]:
    """Champion, changes, and the rms error of each contestant in V and in percent of the span."""
    table = {
        name: {
            "rms_V": c._judging.rms_V(i),
            "rms_pct": c._judging.rms_V(i) * 100.0 / c._span_V,
            "scored": round(c._judging.scores[i].weight, 4),
            "failed": c._out[i],
        }
        for i, name in enumerate(c.names)
    }
    return {"champion": c.champion, "changes": c._succession.changes, "contestants": table}


def change(c: Competition, errors_V: Sequence[float], before: int, why: str) -> str:
    """That the champion is another than ``before``, with the rms errors (k,), V, by which it was chosen, and why."""
    after, old = (f"{c.names[i]} ({errors_V[i] / c._span_V:.3%} rms)" for i in (c._succession.champion, before))
    return f"{after} is served in place of {old}: {why}"


def counters(c: Competition) -> dict[str, int]:
    """The favourite's, and the competition's own."""
    own = {"champion_changes": c._succession.changes, "contestants_failed": sum(c._out)}
    return {**c.favourite.counters(), **own}


def diagnostics(c: Competition) -> dict[str, Any]:
    """The favourite's, with ``competition_NAME_rms_pct`` of each contestant and the champion's index."""
    told = c.favourite.diagnostics()
    percent = 100.0 / c._span_V
    own = {f"competition_{name}_rms_pct": c._judging.rms_V(i) * percent for i, name in enumerate(c.names)}
    return {**told, **own, "competition_champion": float(c._succession.champion)}


# --- The whole state of a competition as flat entries, and back: it goes on from them to the same last bit.


def to_state(c: Competition) -> StateDict:
    """All of ``c``; copies. Raises InputError where a contestant is of no kind that can be read back."""
    kinds: dict[type, str] = {known: kind for kind, known in ONLINE_KINDS.items()}
    if any(type(model) not in kinds for model in c._models):
        raise InputError(f"contestants: expected models of the kinds {', '.join(ONLINE_KINDS)} to be stored")
    state: StateDict = {
        "names": ",".join(c.names),
        "kinds": ",".join(kinds[type(model)] for model in c._models),
        "range_um": c._range_um,
        "span_V": c._span_V,
        "seq": c._seq,
        "frozen": c._frozen,
        "failed_seq": c._failed_seq,
        "ahead_s": c._succession.ahead_s,
        "changes": c._succession.changes,
        "out": np.array(c._out, dtype=np.bool_),
        "past_seq": np.array([seq for seq, _ in c._judging.past], dtype=np.int64),
    }
    state |= prefixed("config.", c.config.state_dict())
    state |= prefixed("motion.", c._motion.state_dict())
    # Without names and champion of their own: only the models are wanted.
    snapshots = {"start": c._judging.start, "newest": c._newest} | {
        f"past{k}": kept for k, (_, kept) in enumerate(c._judging.past)
    }
    for where, models in snapshots.items():
        state |= prefixed(f"{where}.", ChampionInverse(c.names, models, 0).state_dict())
    state["champion"] = c._succession.champion
    for name, model, score in zip(c.names, c._models, c._judging.scores, strict=True):
        # What it began from, so that the state of another identification can be told.
        state[f"base.{name}"] = fingerprint(model.base)
        state |= {f"score.{name}.memory": score.memory.copy(), f"score.{name}.square_V2": score.square_V2}
        state[f"score.{name}.weight"] = score.weight
        state |= prefixed(f"model.{name}.", model.state_dict())
    return state


def contestants_of(state: StateDict) -> dict[str, OnlineModel]:
    """The contestants of a state, by name. Raises KeyError, ValueError or TypeError where it is none."""
    names, kinds = str(state["names"]).split(","), str(state["kinds"]).split(",")
    return {
        name: ONLINE_KINDS[kind].from_state(under(f"model.{name}.", state))
        for name, kind in zip(names, kinds, strict=True)
    }


def made_of(kind: type[Competition], state: StateDict, revive: Revive | None) -> Competition:
    """A competition that goes on from a state. Raises ModelFileError where entries are missing or do not fit."""
    try:
        config = CompetitionConfig(**under("config.", state))
        made = kind(contestants_of(state), float(state["range_um"]), float(state["span_V"]), config, revive)
        restore(made, state)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"competition state: entry missing or damaged: {error}; start from models") from error
    return made


def restore(c: Competition, state: StateDict) -> None:
    """Let ``c``, made of the state's contestants, go on from it. Raises KeyError, ValueError or TypeError."""
    c._motion.restore(under("motion.", state))
    c._judging.start = ChampionInverse.from_state(under("start.", state)).models
    c._newest = ChampionInverse.from_state(under("newest.", state)).models
    c._succession.champion, c._succession.changes = int(state["champion"]), int(state["changes"])
    c._succession.ahead_s = float(state["ahead_s"])
    c._judging.past.clear()
    for k, seq in enumerate(np.asarray(state["past_seq"]).tolist()):
        c._judging.remember(int(seq), ChampionInverse.from_state(under(f"past{k}.", state)).models)
    for name, score in zip(c.names, c._judging.scores, strict=True):
        kept = under(f"score.{name}.", state)
        score.memory = np.array(kept["memory"], dtype=np.float64)
        score.square_V2, score.weight = float(kept["square_V2"]), float(kept["weight"])
    c._serving = c._served()
    c._out = [bool(out) for out in np.asarray(state["out"]).tolist()]
    c._frozen, c._failed_seq = bool(state["frozen"]), int(state["failed_seq"])
    c._seq = int(state["seq"])


class Competition:
    """Several online models of one axis. Implements ``adaptive.types.OnlineModel``; deterministic.

    Parameters
    ----------
    contestants : by name, all of one sample time; the first is the favourite. What this class does not know (freezing,
        going back, looking in) is asked of it.
    range_um, span_V : displacement and voltage range of the identification.
    revive : makes the favourite anew from its last snapshot, a while after it has raised; None: it stays out.
    """

    def __init__(
        self,
        contestants: dict[str, OnlineModel],
        range_um: float,
        span_V: float,
        config: CompetitionConfig | None = None,
        revive: Revive | None = None,
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
        self._motion = Motion(self.config, self._dt_s, range_um)
        self._judging = Judging(self.config, first, self._motion.lag, span_V)
        self._succession = Succession(self.config, span_V)
        self._newest = first
        self._serving = ChampionInverse(self.names, first, 0, self.config.blend_s)
        self._out = [False] * len(first)
        self._seq = -1
        self._frozen = False
        # Whether a contestant may have changed since its snapshot was taken.
        self._changed = True
        self._revive, self._failed_seq = revive, -1
        self._events: deque[tuple[str, str]] = deque(maxlen=64)

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
        """What the favourite says is wrong with the samples, "" while nothing is."""
        return self.favourite.trouble

    @property
    def why(self) -> str:
        """The reason for ``trouble`` in words."""
        return self.favourite.why

    @property
    def distrusts(self) -> bool:
        """Whether the favourite has the readings on trial."""
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
        """Give a sample to every contestant. Returns the favourite's verdict, or that of the first still in.

        Raises what the last contestant raised where none is left.
        """
        verdict, seq, self._changed = "", self._seq, True
        for i, model in enumerate(self._models):
            # Frozen, the favourite still judges and tracks; the others would only learn.
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
            self._judge()
        return verdict

    def window_data(self) -> WindowData | None:
        """The favourite's samples, to tune its hyper-parameters on."""
        return self.favourite.window_data()

    def adopt(self, hyper: Hyperparameters) -> str:
        """Let the favourite go on with other hyper-parameters: "" if it does, else why not."""
        self._changed = True
        return self.favourite.adopt(hyper)

    def freeze(self) -> None:
        """Stop learning and keep the champion; samples go on being judged."""
        self._frozen = self._changed = True
        self.favourite.freeze()

    def thaw(self) -> None:
        """Learn again, and let the better one be champion."""
        self._frozen, self._changed = False, True
        self.favourite.thaw()

    @property
    def frozen(self) -> bool:
        """Whether learning is stopped."""
        return self._frozen

    def resync(self) -> None:
        """Forget the sequence: the stage's count has begun anew."""
        for model in self._models:
            model.resync()

    def take_place_of(self, other: OnlineModel) -> None:
        """Go on where ``other`` is, with what this one knows; see
        :meth:`adaptive.online.learner.Learner.take_place_of`."""
        if not isinstance(other, Competition):
            self.resync()
            return
        for mine, its, out in zip(self._models, other._models, other._out, strict=True):
            mine.resync() if out else mine.take_place_of(its)

    def _exclude(self, i: int, error: Exception) -> None:
        self._out[i] = True
        if i == 0:
            self._failed_seq = self._seq
        name = "contestant_failed" if i else "learner_failed"
        self._events.append((name, f"{self.names[i]}: {type(error).__name__}: {error}; the others go on"))
        if all(self._out):
            raise error

    def _judge(self) -> None:
        """Score the block that has passed, then see whether another is to be served."""
        rows = self._motion.block()
        self._begin_anew()
        self._newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        bad = self._judging.judge(self._seq, rows, self._out)
        self._judging.correct(self._models, self._newest)
        self._judging.remember(self._seq, self._newest)
        if not self._frozen:
            self._choose(bad, float(rows[4].sum()) * self._dt_s)
        self._serving = self._served()
        self._changed = False

    def _choose(self, bad: list[bool], scored_s: float) -> None:
        errors_V = [math.inf if no else self._judging.rms_V(i) for i, no in enumerate(bad)]
        before = self._succession.champion
        why = self._succession.choose(errors_V, scored_s)
        if why:
            self._events.append(("champion_changed", change(self, errors_V, before, why)))

    def _snapshot(self, i: int) -> InverseModel:
        if not self._out[i]:
            try:
                return self._models[i].snapshot()
            except Exception as error:
                self._exclude(i, error)
        return self._newest[i]

    def _begin_anew(self) -> None:
        """Let a favourite that has failed learn again from its last snapshot, after a while and without its score."""
        waited_s = (self._seq - self._failed_seq) * self._dt_s
        if self._revive is None or not self._out[0] or waited_s < self.config.revive_s:
            return
        self._failed_seq = self._seq
        try:
            self._models[0] = self._revive(self._newest[0])
        except Exception as error:
            self._events.append(("learner_failed", f"{self.names[0]}: beginning anew: {error}"))
            return
        self._out[0] = False
        self._judging.begin_anew(0)
        (self.freeze if self._frozen else self.thaw)()
        self._events.append(("learner_begun_anew", f"{self.names[0]}: from its last snapshot"))

    # ---- out

    def snapshot(self) -> ChampionInverse:
        """What is served: the champion of the last judgement as it stands now. Immutable."""
        if not self._changed:
            return self._serving
        self._changed = False
        newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        if any(new is not old for new, old in zip(newest, self._newest, strict=True)):
            self._newest = newest
            self._serving = self._served()
        return self._serving

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """(m,) the favourite's own memory for ``model``, a snapshot of the favourite."""
        return self.favourite.memory_for(model, smoothed)

    def warm(self) -> None:
        """Load every compiled step of the favourite; the others load theirs with their first samples."""
        self.favourite.warm()

    def _served(self) -> ChampionInverse:
        """The newest snapshots as they are served; the champion states what it has been wrong by."""
        champion, models = self._succession.champion, list(self._newest)
        models[champion] = stating(models[champion], self._judging.rms_V(champion))
        return ChampionInverse(self.names, tuple(models), champion, self.config.blend_s)

    def take_events(self) -> list[tuple[str, str]]:
        """(event, detail for people) since the last call, oldest first."""
        events = list(self._events)
        self._events.clear()
        return events

    def standing(self) -> dict[str, Any]:
        """Champion, changes, and the rms error of each contestant in V and in percent of the span."""
        return standing(self)

    def counters(self) -> dict[str, int]:
        """The favourite's, and the competition's own."""
        return counters(self)

    def diagnostics(self) -> dict[str, Any]:
        """The favourite's, with ``competition_NAME_rms_pct`` of each contestant and the champion's index."""
        return diagnostics(self)

    # ---- keeping

    def state_dict(self) -> StateDict:
        """Everything; ``from_state`` continues to the same last bit. Raises InputError on foreign contestants."""
        return to_state(self)

    def restored(self, state: StateDict) -> Competition:
        """A competition with ``state`` that begins a failed favourite anew as this one does. Raises ModelFileError."""
        return self.from_state(state, self._revive)

    @classmethod
    def from_state(cls, state: StateDict, revive: Revive | None = None) -> Competition:
        """Inverse of ``state_dict``; ``revive`` as at construction. Raises ModelFileError where it does not fit."""
        return made_of(cls, state, revive)


# --- A competition around a learner, from the models that were identified.


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
