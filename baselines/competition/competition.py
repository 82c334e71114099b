"""Several online models learn from the same samples, and the one that predicts best is served.

Every contestant is scored on fresh samples (`Judge`). The champion is replaced only by a
contestant that has been clearly better for a while (`ChampionChoice`), and callers pass to the
new champion without a jump (`baselines.competition.champion`).

The first contestant is the favourite. Its verdicts on samples are those of the competition, it is the first champion,
and it becomes champion again as soon as it is no worse. A contestant that raises leaves the competition and the others
go on; the favourite can start anew from its last snapshot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.inverse_model import LssvmInverse
from adaptive.online import gates
from adaptive.online.learner import Learner
from adaptive.smoothing import FixedLagSmoother, SmootherConfig, SmootherState
from adaptive.state import Entry, Refused, load, part_of, restore, save
from adaptive.types import (
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
from baselines.bouc_wen.model import BoucWenInverse
from baselines.bouc_wen.online import BoucWenOnline
from baselines.competition.champion import ChampionInverse
from baselines.competition.config import CompetitionConfig
from baselines.linear import LinearInverse, LinearOnline
from baselines.online_baseline import OnlineBaseline
from baselines.prandtl_ishlinskii.model import MpiInverse
from baselines.prandtl_ishlinskii.online import MpiOnline

# --- Which online models can compete, how a stored state names them, and how an identified baseline starts one.

#: Makes a new online model from the last snapshot of one that has failed.
Restart = Callable[[InverseModel], OnlineModel]
#: Class of a contestant by the name that stored states use.
_ONLINE_KINDS: Final[dict[str, type[Learner] | type[OnlineBaseline]]] = {
    "learner": Learner,
    "linear": LinearOnline,
    "mpi": MpiOnline,
    "bouc_wen": BoucWenOnline,
}
#: Inverse models whose stated deviation is that of a fit, not of served answers.
_BASELINES = (LinearInverse, MpiInverse, BoucWenInverse)


def online_form(model: InverseModel) -> OnlineModel | None:
    """A new online model that starts from an identified baseline; None where the model has no online form."""
    if isinstance(model, LinearInverse):
        return LinearOnline(model)
    if isinstance(model, MpiInverse):
        return MpiOnline(model)
    if isinstance(model, BoucWenInverse):
        return BoucWenOnline(model)
    return None


def with_deviation_of_at_least(model: InverseModel, rms_V: float) -> InverseModel:
    """``model`` with a stated standard deviation of at least ``rms_V``, V, the error measured on served answers.

    A baseline states the residual of its own fit, which is too small for answers as old as those of callers. An LSSVM
    calibrates its deviation on its own predictions and is returned unchanged. An ``rms_V`` of 0 means that nothing
    has been scored yet; the model is then returned unchanged too.
    """
    if not isinstance(model, _BASELINES) or not 0.0 < rms_V < math.inf:
        return model
    return model if model.voltage_std_V >= rms_V else replace(model, voltage_std_V=rms_V)


# --- Scores of a competition: the voltage each contestant would have answered, against the voltage that was applied.
#
# A contestant is scored by the snapshot that callers had when the motion happened (``serving_age_s`` old), so the
# scored samples have not taught it. Displacement, velocity and acceleration come from the fixed-lag smoother. Only
# motion is scored, because every model predicts a stage at rest.

#: Verdicts on a sample that exclude it from scoring.
_NOT_SCORED: Final = frozenset(
    {gates.GLITCH, gates.RINGING, gates.UNTRUSTED, gates.SATURATED, gates.OUT_OF_RANGE, gates.SETTLING, gates.GAP}
)
#: Sample time up to which ``glitch_share`` is used as given, s; it grows in proportion to longer ones.
_GLITCH_DT_S = 1e-3
#: Most missing samples that the smoother bridges; after more it restarts.
_MAX_GAP = 5
#: Readings in a row that may differ from the prediction as glitches; after more the stage is taken to have moved.
_MAX_GLITCHES = 3


class _SmoothedMotion:
    """Collects the smoothed motion with the voltage of the same instant, and marks the samples that are scored."""

    _state: Annotated[SmootherState | None, Entry("state of the smoother", name="smoother")]
    _u: Annotated[deque[float], Entry("voltages over the lag", "V", most=20_000)]
    _rows: Annotated[
        list[tuple[float, float, float, float, float]],
        Entry("motion, voltage, and whether it is scored", "µm, µm/s, µm/s², V", "*,5"),
    ]
    _glitches: Annotated[int, Entry("readings in a row far from the prediction", low=0)]
    _since_start: Annotated[int, Entry("samples since the smoother started", low=0)]
    _since_left: Annotated[int, Entry("samples since the stage left a place", low=0)]
    _anchor_um: Annotated[float, Entry("that place", "µm")]

    def __init__(self, config: CompetitionConfig, dt_s: float, range_um: float) -> None:
        self._config = config
        self._dt_s = dt_s
        self._rest_um = config.rest_share * range_um
        self._rest_samples = config.rest_s / dt_s
        self._glitch_um = config.glitch_share * range_um * max(1.0, dt_s / _GLITCH_DT_S)
        self._smoother = FixedLagSmoother(SmootherConfig.for_rate(dt_s, config.cutoff_hz))
        self.lag = self._smoother.config.lag
        self._state = None
        self._u = deque(maxlen=self.lag + 1)
        self._rows = []
        self._glitches = 0
        self._since_start = 0
        self._since_left = 0
        self._anchor_um = 0.0

    def take(self, sample: Sample, missing: int, counts: bool) -> None:
        """Take a good sample that follows ``missing`` lost ones; ``counts``: its verdict allows scoring."""
        state = self._state
        if state is None or missing > _MAX_GAP:
            self._restart(sample.y_um)
            state = self._state
        else:
            for _ in range(missing):
                self._step(state, None, self._u[-1], False)
        assert state is not None
        if abs(sample.y_um - float(state.x[0])) > self._glitch_um and self._since_start > self.lag:
            self._glitches += 1
            if self._glitches <= _MAX_GLITCHES:
                self._step(state, None, sample.u_V, False)
                return
            self._restart(sample.y_um)
            state = self._state
            assert state is not None
        self._glitches = 0
        self._step(state, sample.y_um, sample.u_V, counts)

    def _restart(self, y_um: float) -> None:
        self._state = self._smoother.initial_state(y_um)
        self._u.clear()
        self._since_start = self._since_left = 0
        self._glitches = 0
        self._anchor_um = y_um

    def _step(self, state: SmootherState, y_um: float | None, u_V: float, counts: bool) -> None:
        self._u.append(u_V)
        self._since_start += 1
        motion = self._smoother.skip(state) if y_um is None else self._smoother.step(state, y_um)
        if motion is None:
            return
        y, v, a = motion
        if abs(y - self._anchor_um) > self._rest_um:
            self._anchor_um, self._since_left = y, 0
        else:
            self._since_left += 1
        scored = counts and self._since_start > self._config.settle and self._since_left <= self._rest_samples
        self._rows.append((y, v, a, self._u[0], float(scored)))

    def block(self) -> FloatArray:
        """(5, n) rows y µm, v µm/s, a µm/s², u V, scored (0 or 1) of the motion since the last call."""
        rows = np.ascontiguousarray(np.array(self._rows, dtype=np.float64).reshape(-1, 5).T)
        self._rows.clear()
        return rows

    @property
    def sizes(self) -> dict[str, int]:
        """Names of the dimensions of the state."""
        return self._smoother.sizes

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where there is a smoother without a voltage."""
        if values["_state"] is not None and not values["_u"]:
            raise ValueError("u: got no voltage, expected those over the lag")


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

        An error counts at most ``worst_V``, so that a single absurd answer is forgotten as soon as any other.
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
        self._start = start
        self.scores = [_RunningError(np.empty(0)) for _ in start]
        # (sequence number, snapshots) at the last blocks, back to the age of an answer.
        depth = math.ceil((config.serving_age_s / self._dt_s + lag) / config.block) + 2
        self._past: deque[tuple[int, Snapshots]] = deque(maxlen=depth)

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

    def remember(self, seq: int, snapshots: Snapshots) -> None:
        """Keep the snapshots that callers have from sample ``seq`` on."""
        self._past.append((seq, snapshots))

    def begin_anew(self, i: int) -> None:
        """Reset the score of contestant ``i`` to the worst value, which new samples soon replace."""
        self.scores[i] = _RunningError(np.empty(0), self._span_V**2, 1.0)

    def _served_then(self, seq: int, count: int) -> Snapshots:
        """The snapshots that were ``serving_age_s`` old at the first instant of a block of ``count`` samples."""
        oldest = seq - self._lag - count + 1 - round(self._config.serving_age_s / self._dt_s)
        served = self._past[0][1] if self._past else self._start
        for at, snapshots in self._past:
            if at <= oldest:
                served = snapshots
        return served

    def state_dict(self, names: tuple[str, ...]) -> StateDict:
        """The whole state of the contestants ``names`` as flat entries; copies."""
        state: StateDict = {"past_seq": np.array([seq for seq, _ in self._past], dtype=np.int64)}
        kept = {"start": self._start} | {f"past{k}": snapshots for k, (_, snapshots) in enumerate(self._past)}
        for where, snapshots in kept.items():
            # A stored champion model holds the snapshots; its champion has no meaning here.
            state |= prefixed(f"{where}.", ChampionInverse(names, snapshots, 0).state_dict())
        for name, score in zip(names, self.scores, strict=True):
            state |= prefixed(f"score.{name}.", save(score))
        return state

    def restore(self, names: tuple[str, ...], state: StateDict) -> None:
        """Continue from a ``state_dict``. Raises ModelFileError where it does not fit; entries are taken out."""
        seqs = state.pop("past_seq", None)
        if not isinstance(seqs, np.ndarray) or seqs.dtype != np.int64 or seqs.shape > (self._past.maxlen or 0,):
            raise Refused("past_seq", repr(seqs)[:80], f"up to {self._past.maxlen} integers")
        like = self._start
        self._start = snapshots_of(state, "start", names, like)
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

    _range_um: Annotated[float, Entry("displacement range of the identification", "µm")]
    _span_V: Annotated[float, Entry("its voltage range", "V")]
    _seq: Annotated[int, Entry("number of the last sample, -1 before any", low=-1)]
    _frozen: Annotated[bool, Entry("whether learning is stopped")]
    _failed_seq: Annotated[int, Entry("sample at which the favourite failed or was restarted, -1 for none", low=-1)]
    _choice: Annotated[ChampionChoice, Entry("the choice of a champion", name="")]
    _out: Annotated[list[bool], Entry("which contestants have failed", "", "contestants")]
    _motion: Annotated[_SmoothedMotion, Entry("smoothed motion on which the contestants are scored")]

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
        self._motion = _SmoothedMotion(self.config, self._dt_s, range_um)
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
        self._motion.take(sample, max(0, seq - before - 1) if before >= 0 else 0, verdict not in _NOT_SCORED)
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
        return None if self._out[0] else self.favourite.moving()

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
        """The whole state as flat entries, all copies; ``from_state`` continues to the same last bit.

        Raises InputError where a contestant is of a class that cannot be stored.
        """
        state: StateDict = {"names": ",".join(self.names), "kinds": self._kinds, **save(self)}
        state |= prefixed("config.", self.config.state_dict())
        state |= prefixed("newest.", ChampionInverse(self.names, self._newest, 0).state_dict())
        state |= self.judge.state_dict(self.names)
        for name, model in zip(self.names, self._models, strict=True):
            state |= prefixed(f"model.{name}.", model.state_dict())
        return state

    @property
    def _kinds(self) -> str:
        kinds: dict[type, str] = {known: kind for kind, known in _ONLINE_KINDS.items()}
        if any(type(model) not in kinds for model in self._models):
            raise InputError(f"contestants: expected models of the kinds {', '.join(_ONLINE_KINDS)} to be stored")
        return ",".join(kinds[type(model)] for model in self._models)

    def restored(self, state: StateDict) -> Competition:
        """A competition with ``state`` that restarts its favourite as this one does. Raises ModelFileError."""
        for name, own in (("names", ",".join(self.names)), ("kinds", self._kinds)):
            if state.get(name) != own:
                raise Refused(name, repr(state.get(name))[:80], repr(own))
        return self.from_state(state, self._restart)

    @classmethod
    def from_state(cls, state: StateDict, restart: Restart | None = None) -> Competition:
        """Inverse of ``state_dict``; ``restart`` as in the constructor.

        Raises ModelFileError where an entry is missing or damaged.
        """
        rest = dict(state)
        names, kinds = str(rest.pop("names", "")).split(","), str(rest.pop("kinds", "")).split(",")
        if len(set(names)) != len(kinds) or set(kinds) - set(_ONLINE_KINDS):
            raise Refused("kinds", repr(kinds)[:80], f"one of {', '.join(_ONLINE_KINDS)} for each of {names}"[:200])
        contestants: dict[str, OnlineModel] = {}
        for name, kind in zip(names, kinds, strict=True):
            with part_of(rest, f"model.{name}.") as kept:
                contestants[name] = _ONLINE_KINDS[kind].from_state(kept)
        try:
            with part_of(rest, "config.") as settings:
                config = CompetitionConfig(**settings)
            made = cls(contestants, float(rest["range_um"]), float(rest["span_V"]), config, restart)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelFileError(f"competition state: entry missing or damaged: {error}; start from models") from error
        made._restore(rest)
        return made

    def check_state(self, values: dict[str, Any]) -> None:
        """Raise ValueError where the champion is none of the contestants."""
        if values["_choice"].champion >= len(self.names):
            champion = values["_choice"].champion
            raise ValueError(f"champion: got {champion}, expected a number from 0 to {len(self.names) - 1}")

    def _restore(self, state: StateDict) -> None:
        """Continue from ``state``, which holds the same contestants. Raises ModelFileError."""
        self.judge.restore(self.names, state)
        newest = snapshots_of(state, "newest", self.names, self._newest)
        given = {"_choice": {"config": self.config, "span_V": self._span_V}}
        restore(self, state, {"contestants": len(self.names), **self._motion.sizes}, given)
        self._newest = newest
        self._serving = self._served()
