"""The rules by which a competition replaces its champion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baselines.competition.config import CompetitionConfig

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
