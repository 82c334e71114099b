"""The judges of a competition: each block of motion is foretold by the snapshots that callers had when it happened."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from adaptive.types import FloatArray, InverseModel, OnlineModel
from baselines.contest import Score
from baselines.contest_config import CompetitionConfig

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
            own = getattr(model, "memory_for", lambda *_: None)(snapshot, True)
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
