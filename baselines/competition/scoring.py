"""The score of a competition: what each contestant would have answered for the motion that was measured.

A contestant is judged by the snapshot that callers had when the motion happened (``serving_age_s`` old), on samples
that had taught it nothing. Displacement, velocity and acceleration are those of the fixed-lag smoother. Only motion
counts: a stage at rest is foretold by anybody.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from adaptive.online import gates as admission
from adaptive.smoothing import FixedLagSmoother, SmootherConfig, SmootherState
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample, StateDict
from baselines.competition.config import CompetitionConfig

#: Verdicts on a sample that speak against scoring the pair.
NOT_SCORED: Final = frozenset(
    {admission.GLITCH, admission.RINGING, admission.UNTRUSTED, admission.SATURATED}
    | {admission.OUT_OF_RANGE, admission.SETTLING, admission.GAP}
)
#: Sample time up to which ``glitch_share`` holds as it is, s; it grows with longer ones.
_GLITCH_DT_S = 1e-3
#: Missing samples that are bridged; beyond, smoothing begins anew.
_MAX_GAP = 5
#: Readings in a row that surprise the smoother before the stage is taken to have really moved.
_GLITCHES = 3


class Motion:
    """Collects smoothed motion with the voltage of the same instant, block by block, and says what of it counts."""

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
        """One good sample after ``missing`` others; ``counts``: nothing speaks against scoring its pair."""
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
            if self._glitches <= _GLITCHES:
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
        """(5, n) rows y, v, a, u, scored of the motion since the last call."""
        rows = np.ascontiguousarray(np.array(self._rows, dtype=np.float64).reshape(-1, 5).T)
        self._rows.clear()
        return rows

    def state_dict(self) -> StateDict:
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
        """Go on from a ``state_dict``."""
        self._u.extend(float(u) for u in state["u"])
        self._rows = [tuple(float(x) for x in row) for row in np.asarray(state["rows"]).reshape(-1, 5)]  # type: ignore[misc]
        self._glitches, self._since_start = int(state["glitches"]), int(state["since_start"])
        self._since_left, self._anchor_um = int(state["since_left"]), float(state["anchor_um"])
        smoother = under("smoother.", state)
        self._state = self._smoother.from_state(smoother) if smoother else None


@dataclass(slots=True)
class Score:
    """Exponentially weighted mean square error of one contestant, V², and the memory that its answers carry."""

    memory: FloatArray
    square_V2: float = 0.0
    weight: float = 0.0

    @property
    def mean_V2(self) -> float:
        """Mean square error, V²; infinite where a prediction was not finite, 0 before any."""
        return self.square_V2 / self.weight if self.weight > 0.0 else 0.0

    def take(self, model: InverseModel, rows: FloatArray, share: float, worst_V: float) -> bool:
        """Judge ``model`` on a block (5, n), whose mean weighs ``share``; False where its answer is not finite."""
        forward = model.feedforward(rows[0], rows[1], rows[2], self.memory)
        if np.isfinite(forward.memory).all():
            self.memory = forward.memory
        scored = rows[4] > 0.0
        error = forward.u_V[scored] - rows[3][scored]
        finite = bool(np.isfinite(error).all())
        if error.size:
            # One absurd answer is as bad as the whole span, and forgotten as soon.
            size = np.minimum(np.where(np.isfinite(error), np.abs(error), worst_V), worst_V)
            self.square_V2 += share * (float(size @ size) / error.size - self.square_V2)
            self.weight += share * (1.0 - self.weight)
        return finite


# --- The judges of a competition: each block of motion is foretold by the snapshots that callers had when it happened.


Models = tuple[InverseModel, ...]


class Judging:
    """Scores of all contestants, and the snapshots of theirs that are still to be judged.

    Parameters
    ----------
    start : snapshots that callers had from the beginning, all of one sample time.
    lag : by how many samples the motion comes late. span_V : voltage range of the identification.
    """

    def __init__(self, config: CompetitionConfig, start: Models, lag: int, span_V: float) -> None:
        self._config, self._dt_s, self._lag, self._span_V = config, start[0].dt_s, lag, span_V
        self.start = start
        self.scores = [Score(np.empty(0)) for _ in start]
        # (sequence number, snapshots) at the last blocks: what callers had, from the age of an answer on.
        depth = math.ceil((config.serving_age_s / self._dt_s + lag) / config.block) + 2
        self.past: deque[tuple[int, Models]] = deque(maxlen=depth)

    def rms_V(self, i: int) -> float:
        """rms error of a contestant, V; 0 before any."""
        return math.sqrt(self.scores[i].mean_V2)

    def judge(self, seq: int, rows: FloatArray, out: list[bool]) -> list[bool]:
        """Score a block (5, n) of motion that ends at the sample ``seq``; True for whoever is not to be served.

        ``out``: who does not take part.
        """
        bad, c = list(out), self._config
        if not rows.shape[1]:
            return bad
        share = 1.0 - math.exp(-float(rows[4].sum()) * self._dt_s / c.horizon_s)
        for i, (score, model) in enumerate(zip(self.scores, self._judged(seq, rows.shape[1]), strict=True)):
            if out[i]:
                continue
            if not score.memory.size and model.memory_size:
                score.memory = model.rest_memory(float(rows[0, 0]))
            bad[i] = not score.take(model, rows, share, self._span_V)
        return bad

    def correct(self, models: Sequence[OnlineModel], newest: Models) -> None:
        """Go on from a contestant's own memory where it knows one: over lost readings ours is a guess."""
        for model, snapshot, score in zip(models, newest, self.scores, strict=True):
            own = model.memory_for(snapshot, True)
            if own is not None:
                score.memory = own

    def remember(self, seq: int, models: Models) -> None:
        """Keep what callers have from the sample ``seq`` on."""
        self.past.append((seq, models))

    def begin_anew(self, i: int) -> None:
        """Forget a contestant's score: as bad as can be until it has been scored, and soon forgotten."""
        self.scores[i] = Score(np.empty(0), self._span_V**2, 1.0)

    def _judged(self, seq: int, count: int) -> Models:
        """The snapshots that were an answer's age old at the oldest instant of a block."""
        oldest = seq - self._lag - count + 1 - round(self._config.serving_age_s / self._dt_s)
        judged = self.past[0][1] if self.past else self.start
        for at, models in self.past:
            if at <= oldest:
                judged = models
        return judged
