"""Several online models learn from the same samples, and the one that predicts best is served.

Every contestant is scored on fresh samples (`Judge`). The champion is replaced only by a
contestant that has been clearly better for a while (`ChampionChoice`), and callers pass to the
new champion without a jump (`baselines.competition.champion`).

The first contestant is the favourite, a learner. Its verdicts on samples are those of the competition: all are scored
on the motion that it smooths, where it accepts that. It is the first champion, and becomes champion again as soon as it
is no worse. Another contestant that raises leaves the competition; ``handle`` raises what the favourite raises.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, Protocol, runtime_checkable

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates
from dehyst.adaptive.online.learner import Learner, Parts
from dehyst.adaptive.state import Entry, Refused, load, part_of, restore, save
from dehyst.adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    MovingPart,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    prefixed,
)
from dehyst.baselines.bouc_wen.model import BoucWenInverse
from dehyst.baselines.bouc_wen.online import BoucWenOnline
from dehyst.baselines.common import BaselineInverse
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.baselines.competition.config import CompetitionConfig
from dehyst.baselines.linear import LinearInverse, LinearOnline
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline

# --- Which online models can compete, and how an identified baseline starts one.


@runtime_checkable
class Smooths(Protocol):
    """A learner that smooths the motion and judges the samples: the favourite."""

    @property
    def parts(self) -> Parts:
        """Its changing state."""
        ...


#: How each kind of baseline learns.
_ONLINE_FORMS: Final[dict[type, Callable[[Any], OnlineModel]]] = {
    LinearInverse: LinearOnline,
    MpiInverse: MpiOnline,
    BoucWenInverse: BoucWenOnline,
}


def online_form(model: InverseModel) -> OnlineModel | None:
    """A new online model that starts from an identified baseline; None where the model has no online form."""
    form = _ONLINE_FORMS.get(type(model))
    return None if form is None else form(model)


def with_deviation_of_at_least(model: InverseModel, rms_V: float) -> InverseModel:
    """``model`` with a stated standard deviation of at least ``rms_V``, V, the error measured on served answers.

    A baseline states the residual of its own fit, which is too small for answers as old as those of callers. An LSSVM
    calibrates its deviation on its own predictions and is returned unchanged. An ``rms_V`` of 0 means that nothing
    has been scored yet; the model is then returned unchanged too.
    """
    if not isinstance(model, BaselineInverse) or not 0.0 < rms_V < math.inf:
        return model
    return model if model.voltage_std_V >= rms_V else replace(model, voltage_std_V=rms_V)


# --- Scores of a competition: the voltage each contestant would have answered, against the voltage that was applied.
#
# A contestant is scored by the snapshot that callers had when the motion happened (``serving_age_s`` old), so the
# scored samples have not taught it. Displacement, velocity, acceleration and voltage are those that the favourite has
# smoothed. Only motion that it accepts is scored: refused samples say nothing of a model, and every model predicts a
# stage at rest.

#: Verdicts of the favourite on samples that are scored.
_SCORED: Final = frozenset({gates.LEARNT, gates.PASSED, gates.REDUNDANT, gates.OUTLIER, gates.FROZEN})


@dataclass(slots=True)
class _RunningError:
    """Exponentially weighted mean square error of one contestant, V², and the memory that its answers carry.

    ``weight`` rises from 0 to 1 as scored motion fills the horizon.
    """

    memory: Annotated[FloatArray, Entry("hysteresis memory of the scored model, empty before a score", "", "memory|0")]
    square_V2: Annotated[float, Entry("weighted mean square error", "V²", low=0.0)] = 0.0
    weight: Annotated[float, Entry("weight of all scores", low=0.0)] = 0.0

    @property
    def mean_V2(self) -> float:
        """Mean square error, V²; 0 before the first scored sample."""
        return self.square_V2 / self.weight if self.weight > 0.0 else 0.0

    def add_block(self, model: InverseModel, rows: FloatArray, share: float, worst_V: float) -> bool:
        """Score ``model`` on a block (5, n) whose mean gets the weight ``share``; False where an answer is not finite.

        An error counts as at most ``worst_V``: one absurd answer is forgotten as fast as any other.
        """
        forward = model.feedforward(rows[0], rows[1], rows[2], self.memory)
        if np.isfinite(forward.memory).all():
            self.memory = forward.memory
        scored = rows[4] > 0.0
        error = forward.u_V[scored] - rows[3][scored]
        finite = bool(np.isfinite(error).all())
        if error.size:
            size = np.minimum(np.where(np.isfinite(error), np.abs(error), worst_V), worst_V)
            self.square_V2 += share * (float(size @ size) / error.size - self.square_V2)
            self.weight += share * (1.0 - self.weight)
        return finite


#: One snapshot per contestant.
Snapshots = tuple[InverseModel, ...]


class Judge:
    """The running errors of all contestants, and the past snapshots that are still needed for scoring.

    Parameters
    ----------
    start : snapshots that callers had from the beginning, all of one sample time.
    lag : delay of the smoothed motion, samples.
    span_V : voltage range of the identification, V.
    """

    def __init__(self, config: CompetitionConfig, start: Snapshots, lag: int, span_V: float) -> None:
        self._config, self._dt_s, self._lag, self._span_V = config, start[0].dt_s, lag, span_V
        self.scores = [_RunningError(np.empty(0)) for _ in start]
        # (sequence number, snapshots) at the last blocks, back to the age of an answer.
        depth = math.ceil((config.serving_age_s / self._dt_s + lag) / config.block) + 2
        self._past: deque[tuple[int, Snapshots]] = deque([(-1, start)], depth)

    def rms_V(self, i: int) -> float:
        """rms error of contestant ``i``, V; 0 before the first scored sample."""
        return math.sqrt(self.scores[i].mean_V2)

    def score(self, seq: int, rows: FloatArray, out: list[bool]) -> list[bool]:
        """Score a block (5, n) of motion that ends at sample ``seq``; contestants marked in ``out`` do not take part.

        Returns for each contestant whether it cannot be served.
        """
        unusable, c = list(out), self._config
        if not rows.shape[1]:
            return unusable
        share = 1.0 - math.exp(-float(rows[4].sum()) * self._dt_s / c.horizon_s)
        for i, (score, model) in enumerate(zip(self.scores, self._served_then(seq, rows.shape[1]), strict=True)):
            if out[i]:
                continue
            if not score.memory.size and model.memory_size:
                score.memory = model.rest_memory(float(rows[0, 0]))
            unusable[i] = not score.add_block(model, rows, share, self._span_V)
        return unusable

    def adopt_tracked_memories(self, models: Sequence[OnlineModel], newest: Snapshots) -> None:
        """Take over the hysteresis memory of contestants that track one; it is better over lost readings."""
        for model, snapshot, score in zip(models, newest, self.scores, strict=True):
            tracked = model.memory_for(snapshot, True)
            if tracked is not None:
                score.memory = tracked

    @property
    def newest(self) -> Snapshots:
        """The snapshots at the last block."""
        return self._past[-1][1]

    def remember(self, seq: int, snapshots: Snapshots) -> None:
        """Keep the snapshots that callers have from sample ``seq`` on."""
        self._past.append((seq, snapshots))

    def _served_then(self, seq: int, count: int) -> Snapshots:
        """The snapshots that were ``serving_age_s`` old at the first instant of a block of ``count`` samples."""
        oldest = seq - self._lag - count + 1 - round(self._config.serving_age_s / self._dt_s)
        served = self._past[0][1]
        for at, snapshots in self._past:
            if at <= oldest:
                served = snapshots
        return served

    def state_dict(self, names: tuple[str, ...]) -> StateDict:
        """The whole state of the contestants ``names`` as flat entries; copies."""
        state: StateDict = {"past_seq": np.array([seq for seq, _ in self._past], dtype=np.int64)}
        for k, (_, snapshots) in enumerate(self._past):
            # A stored champion model holds the snapshots; its champion has no meaning here.
            state |= prefixed(f"past{k}.", ChampionInverse(names, snapshots, 0).state_dict())
        for name, score in zip(names, self.scores, strict=True):
            state |= prefixed(f"score.{name}.", save(score))
        return state

    def restore(self, names: tuple[str, ...], state: StateDict) -> None:
        """Continue from a ``state_dict``. Raises ModelFileError where it does not fit; entries are taken out."""
        seqs = state.pop("past_seq", None)
        if not isinstance(seqs, np.ndarray) or seqs.dtype != np.int64 or not (1,) <= seqs.shape <= (self._past.maxlen,):
            raise Refused("past_seq", repr(seqs)[:80], f"1 to {self._past.maxlen} integers")
        like = self.newest
        past = [(seq, snapshots_of(state, f"past{k}", names, like)) for k, seq in enumerate(seqs.tolist())]
        self._past.clear()
        self._past.extend(past)
        for i, (name, model) in enumerate(zip(names, like, strict=True)):
            with part_of(state, f"score.{name}.") as kept:
                self.scores[i] = load(_RunningError, kept, {"memory": model.memory_size})


def check_like(model: InverseModel, other: InverseModel, name: str) -> None:
    """Raise ModelFileError where the stored model ``name`` cannot stand in the place of ``other``."""
    same = type(model) is type(other) and model.memory_size == other.memory_size and model.dt_s == other.dt_s
    if isinstance(model, LssvmInverse) and isinstance(other, LssvmInverse):
        same = same and model.features.sizes == other.features.sizes
    if not same:
        raise Refused(name, f"a {type(model).__name__} of other sizes", "a model like the present one")


def snapshots_of(state: StateDict, where: str, names: tuple[str, ...], like: Snapshots) -> Snapshots:
    """Take snapshots of the contestants ``names`` out of ``state``; of the same kinds and sizes as ``like``."""
    with part_of(state, f"{where}.") as kept:
        made = ChampionInverse.from_state(kept)
        for name, model, other in zip(made.names, made.models, like, strict=False):
            check_like(model, other, name)
        if made.names != names:
            raise Refused("names", repr(made.names)[:80], repr(names))
    return made.models


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
    """

    config: CompetitionConfig
    span_V: float
    champion: Annotated[int, Entry("index of the contestant that is served", low=0)] = 0
    ahead_s: Annotated[float, Entry("motion during which another has been ahead without a break", "s", low=0.0)] = 0.0
    changes: Annotated[int, Entry("changes of champion", low=0)] = 0

    def choose(self, errors_V: Sequence[float], scored_s: float) -> str:
        """Choose by the rms errors (k,), V, after ``scored_s`` more seconds of scored motion.

        An infinite error marks a contestant that cannot be served. Returns the reason for a change of champion, or ""
        where there is none.
        """
        c, now, best = self.config, self.champion, int(np.argmin(errors_V))
        if math.isinf(errors_V[now]) and math.isfinite(errors_V[best]):
            return self._replace_by(best, FAILED)
        # The favourite returns as soon as it is no worse; others must win by the margin and the floor for a while.
        if now != 0 and errors_V[0] < errors_V[now]:
            return self._replace_by(0, BETTER)
        ahead = best not in (0, now) and errors_V[now] > c.margin * errors_V[best] + c.floor * self.span_V
        self.ahead_s = self.ahead_s + scored_s if ahead else 0.0
        return self._replace_by(best, BETTER) if ahead and self.ahead_s >= c.patience_s else ""

    def _replace_by(self, champion: int, why: str) -> str:
        self.champion, self.ahead_s = champion, 0.0
        self.changes += 1
        return why


# --- The competition.


class Competition:
    """Several online models of one axis. Implements ``adaptive.types.OnlineModel``; deterministic.

    Parameters
    ----------
    contestants : online models by name, all of one sample time; the first is the favourite, which smooths the motion.
    span_V : voltage range of the identification.

    Raises InputError where the first contestant is no learner or the range is not positive.
    """

    _seq: Annotated[int, Entry("the last sample", low=-1)]
    _frozen: Annotated[bool, Entry("whether learning is stopped")]
    _choice: Annotated[ChampionChoice, Entry("the choice of a champion", name="")]
    _out: Annotated[list[bool], Entry("which contestants have failed", "", "contestants")]
    _rows: Annotated[
        list[tuple[float, float, float, float, float]],
        Entry("motion since the last block, its voltage, and whether it is scored", "µm, µm/s, µm/s², V", "*,5"),
    ]
    _last: Annotated[int, Entry("the last smoothed instant", low=-1)]

    def __init__(
        self, contestants: dict[str, OnlineModel], span_V: float, config: CompetitionConfig | None = None
    ) -> None:
        favourite: object = next(iter(contestants.values()), None)
        if not isinstance(favourite, Smooths) or not span_V > 0.0:
            raise InputError(
                f"contestants, span_V: got {type(favourite).__name__} first, {span_V}, expected a learner and a range"
            )
        self.config = config or CompetitionConfig()
        self.names = tuple(contestants)
        self._models = list(contestants.values())
        self._smooths: Smooths = favourite
        first = tuple(model.snapshot() for model in self._models)
        self._dt_s, self._span_V = first[0].dt_s, span_V
        self.judge = Judge(self.config, first, favourite.parts.intake.smoother.config.lag, span_V)
        self._choice = ChampionChoice(self.config, span_V)
        self._newest = first
        self._serving = ChampionInverse(self.names, first, 0, self.config.blend_s)
        self._out = [False] * len(first)
        self._seq = self._last = -1
        self._rows = []
        self._frozen = False
        # Whether a contestant may have changed since its snapshot was taken.
        self._changed = True
        self._events: deque[tuple[str, str]] = deque(maxlen=64)

    @classmethod
    def from_models(
        cls,
        favourite: str,
        learner: OnlineModel,
        model: InverseModel,
        others: dict[str, InverseModel],
        config: CompetitionConfig | None = None,
    ) -> Competition:
        """``learner``, started from ``model``, against the online forms of ``others``; those without one are left out.

        Raises InputError unless ``model`` is an LSSVM: its range is the unit of the errors.
        """
        if not isinstance(model, LssvmInverse):
            raise InputError(f"{favourite}: got a {type(model).__name__}, expected an LSSVM model")
        contestants: dict[str, OnlineModel] = {favourite: learner}
        for name, other in others.items():
            online = online_form(other)
            if online is not None and name != favourite:
                contestants[name] = online
        return cls(contestants, model.span_V, config)

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
        """Give a sample to every contestant; returns the favourite's verdict. Raises what the favourite raises."""
        self._changed = True
        verdict = self.favourite.handle(sample)
        before, self._seq = self._seq, self.favourite.seq
        # While frozen, the favourite still judges and tracks; the others would only learn.
        for i, model in enumerate(self._models):
            if i and not (self._out[i] or self._frozen):
                try:
                    model.handle(sample)
                except Exception as error:
                    self._exclude(i, error)
        if self._seq == before:
            return verdict
        self._take_motion(verdict)
        if self._seq // self.config.block > before // self.config.block:
            self._judge_block()
        return verdict

    def _take_motion(self, verdict: str) -> None:
        """Take the instant that the favourite has just smoothed, if there is one; none while it holds readings."""
        parts = self._smooths.parts
        gates, track = parts.intake.gates, parts.intake.track
        pair = track.pair()
        if pair is None or pair.now == self._last:
            return
        self._last = pair.now
        moves = (track.count - gates.moved) * self._dt_s <= parts.config.admission.rest_s
        scored = verdict in _SCORED and moves
        self._rows.append((pair.y_um, pair.v_um_per_s, pair.a_um_per_s2, pair.u_V, float(scored)))

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
        self._rows, self._last = [], -1

    def _exclude(self, i: int, error: Exception) -> None:
        self._out[i] = True
        detail = f"{self.names[i]}: {type(error).__name__}: {error}; the others go on"
        self._events.append(("contestant_failed", detail))

    def _judge_block(self) -> None:
        """Score the block of motion that has passed, then choose the champion."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 5).T.copy()
        self._rows = []
        self._newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        unusable = self.judge.score(self._seq, rows, self._out)
        self.judge.adopt_tracked_memories(self._models, self._newest)
        self.judge.remember(self._seq, self._newest)
        if not self._frozen:
            self._choose([math.inf if bad else self.judge.rms_V(i) for i, bad in enumerate(unusable)], rows[4].sum())
        self._serving = self._served()
        self._changed = False

    def _choose(self, errors_V: Sequence[float], scored: float) -> None:
        """Choose the champion by the rms errors (k,), V, after ``scored`` more samples."""
        before = self._choice.champion
        why = self._choice.choose(errors_V, float(scored) * self._dt_s)
        if why:
            ends = (self._choice.champion, before)
            new, old = (f"{self.names[i]} ({errors_V[i] / self._span_V:.3%} rms)" for i in ends)
            self._events.append(("champion_changed", f"{new} is served in place of {old}: {why}"))

    def _snapshot(self, i: int) -> InverseModel:
        if i == 0:
            return self.favourite.snapshot()
        if not self._out[i]:
            try:
                return self._models[i].snapshot()
            except Exception as error:
                self._exclude(i, error)
        return self._newest[i]

    # ---- out

    def snapshot(self) -> InverseModel:
        """The favourite's model; the snapshot of all contestants is `champion_model`."""
        return self.champion_model().models[0]

    def champion_model(self) -> ChampionInverse:
        """The champion of the last judgement, with its present parameters, and the others beside it. Immutable."""
        if not self._changed:
            return self._serving
        self._changed = False
        newest = tuple(self._snapshot(i) for i in range(len(self._models)))
        if any(new is not old for new, old in zip(newest, self._newest, strict=True)):
            self._newest = newest
            self._serving = self._served()
        return self._serving

    def moving(self) -> MovingPart | None:
        """What has moved in the favourite since its last snapshot."""
        return self.favourite.moving()

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

    def reach(self, stand_in: str) -> float:
        """How far outside its learnt domain the favourite is still as good as the contestant ``stand_in``, in spans.

        There the deviation that the favourite states for its extrapolation equals the rms error of ``stand_in`` on
        this stage. 0 where either is not known.
        """
        favourite = self.favourite
        if stand_in not in self.names or not isinstance(favourite, Learner):
            return 0.0
        return self.judge.rms_V(self.names.index(stand_in)) / max(favourite.extrapolation_V, 1e-300)

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
        """The whole state as flat entries, all copies; ``restored`` continues to the same last bit."""
        state: StateDict = {"names": ",".join(self.names), **save(self)}
        state |= prefixed("config.", self.config.state_dict())
        state |= self.judge.state_dict(self.names)
        for name, model in zip(self.names, self._models, strict=True):
            state |= prefixed(f"model.{name}.", model.state_dict())
        return state

    def restored(self, state: StateDict) -> Competition:
        """A competition of the same contestants and settings with ``state``. Raises ModelFileError."""
        rest, models = dict(state), dict[str, OnlineModel]()
        if rest.pop("names", None) != ",".join(self.names):
            raise Refused("names", repr(state.get("names"))[:80], repr(",".join(self.names)))
        for name, model in zip(self.names, self._models, strict=True):
            with part_of(rest, f"model.{name}.") as kept:
                models[name] = model.restored(kept)
        with part_of(rest, "config."):  # the caller compares them
            made = Competition(models, self._span_V, self.config)
        made.judge.restore(self.names, rest)
        given = {"_choice": {"config": self.config, "span_V": self._span_V}}
        restore(made, rest, {"contestants": len(self.names)}, given)
        made._newest = made.judge.newest
        made._serving = made._served()
        return made

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where the champion is none of the contestants."""
        if values["_choice"].champion >= len(self.names):
            champion = values["_choice"].champion
            raise ValueError(f"champion: got {champion}, expected a number from 0 to {len(self.names) - 1}")
