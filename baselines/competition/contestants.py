"""Contestants of a competition, and their scores."""

from __future__ import annotations

import hashlib
import json
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from adaptive.online import gates
from adaptive.online.learner import Learner
from adaptive.smoothing import FixedLagSmoother, SmootherConfig, SmootherState
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict, prefixed, under
from baselines.bouc_wen.inverse import BoucWenInverse
from baselines.bouc_wen.online import BoucWenOnline
from baselines.competition.champion import ChampionInverse
from baselines.competition.config import CompetitionConfig
from baselines.linear import LinearInverse, LinearOnline
from baselines.online_baseline import OnlineBaseline
from baselines.prandtl_ishlinskii.inverse import MpiInverse
from baselines.prandtl_ishlinskii.online import MpiOnline

# --- Which online models can compete, how a stored state names them, and how an identified baseline starts one.

#: Makes a new online model from the last snapshot of one that has failed.
Restart = Callable[[InverseModel], OnlineModel]
#: Class of a contestant by the name that stored states use.
ONLINE_KINDS: Final[dict[str, type[Learner] | type[OnlineBaseline]]] = {
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


def fingerprint(model: InverseModel) -> str:
    """Digest of a model's parameters, 16 hexadecimal digits."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        array = isinstance(value, np.ndarray)
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(value).tobytes() if array else json.dumps(value).encode())
    return sha.hexdigest()


# --- Scores of a competition: the voltage each contestant would have answered, against the voltage that was applied.
#
# A contestant is scored by the snapshot that callers had when the motion happened (``serving_age_s`` old), so the
# scored samples have not taught it. Displacement, velocity and acceleration come from the fixed-lag smoother. Only
# motion is scored, because every model predicts a stage at rest.

#: Verdicts on a sample that exclude it from scoring.
NOT_SCORED: Final = frozenset(
    {gates.GLITCH, gates.RINGING, gates.UNTRUSTED, gates.SATURATED, gates.OUT_OF_RANGE, gates.SETTLING, gates.GAP}
)
#: Sample time up to which ``glitch_share`` is used as given, s; it grows in proportion to longer ones.
_GLITCH_DT_S = 1e-3
#: Most missing samples that the smoother bridges; after more it restarts.
_MAX_GAP = 5
#: Readings in a row that may differ from the prediction as glitches; after more the stage is taken to have moved.
_MAX_GLITCHES = 3


class SmoothedMotion:
    """Collects the smoothed motion with the voltage of the same instant, and marks the samples that are scored."""

    def __init__(self, config: CompetitionConfig, dt_s: float, range_um: float) -> None:
        self._config = config
        self._dt_s = dt_s
        self._rest_um = config.rest_share * range_um
        self._rest_samples = config.rest_s / dt_s
        self._glitch_um = config.glitch_share * range_um * max(1.0, dt_s / _GLITCH_DT_S)
        self._smoother = FixedLagSmoother(SmootherConfig.for_rate(dt_s, config.cutoff_hz))
        self.lag = self._smoother.config.lag
        self._state: SmootherState | None = None
        self._u: deque[float] = deque(maxlen=self.lag + 1)
        self._rows: list[tuple[float, float, float, float, float]] = []
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

    def state_dict(self) -> StateDict:
        """The whole state; copies."""
        state: StateDict = {
            "u": np.array(self._u, dtype=np.float64),
            "rows": np.array(self._rows, dtype=np.float64).reshape(-1, 5),
            "glitches": self._glitches,
            "since_start": self._since_start,
            "since_left": self._since_left,
            "anchor_um": self._anchor_um,
        }
        if self._state is not None:
            state |= prefixed("smoother.", self._smoother.state_dict(self._state))
        return state

    def restore(self, state: StateDict) -> None:
        """Continue from a ``state_dict``."""
        self._u.extend(float(u) for u in state["u"])
        self._rows = [tuple(float(x) for x in row) for row in np.asarray(state["rows"]).reshape(-1, 5)]  # type: ignore[misc]
        self._glitches, self._since_start = int(state["glitches"]), int(state["since_start"])
        self._since_left, self._anchor_um = int(state["since_left"]), float(state["anchor_um"])
        smoother = under("smoother.", state)
        self._state = self._smoother.from_state(smoother) if smoother else None


@dataclass(slots=True)
class RunningError:
    """Exponentially weighted mean square error of one contestant, V², and the memory that its answers carry.

    ``weight`` rises from 0 to 1 as scored motion fills the horizon.
    """

    memory: FloatArray
    square_V2: float = 0.0
    weight: float = 0.0

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
        self.scores = [RunningError(np.empty(0)) for _ in start]
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
        self.scores[i] = RunningError(np.empty(0), self._span_V**2, 1.0)

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
            state |= {
                f"score.{name}.memory": score.memory.copy(),
                f"score.{name}.square_V2": score.square_V2,
                f"score.{name}.weight": score.weight,
            }
        return state

    def restore(self, names: tuple[str, ...], state: StateDict) -> None:
        """Continue from a ``state_dict``. Raises KeyError, ValueError or TypeError where it does not fit."""
        self._start = ChampionInverse.from_state(under("start.", state)).models
        self._past.clear()
        for k, seq in enumerate(np.asarray(state["past_seq"]).tolist()):
            self.remember(int(seq), ChampionInverse.from_state(under(f"past{k}.", state)).models)
        for name, score in zip(names, self.scores, strict=True):
            kept = under(f"score.{name}.", state)
            score.memory = np.array(kept["memory"], dtype=np.float64)
            score.square_V2, score.weight = float(kept["square_V2"]), float(kept["weight"])
