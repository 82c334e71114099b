"""Who of the contestants is served: the rules by which a champion gives way to another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from baselines.competition.config import CompetitionConfig

WINS = "it predicts better"
FAILED = "its answers are not finite, or it failed"


@dataclass(slots=True)
class Succession:
    """The champion, and for how long another has been clearly better.

    Attributes
    ----------
    config, span_V : margin, floor and patience; the voltage span that the floor is a share of.
    champion : index of who is served. ahead_s : how long another has been ahead, s of motion. changes : of champion.
    """

    config: CompetitionConfig
    span_V: float
    champion: int = 0
    ahead_s: float = 0.0
    changes: int = 0

    def choose(self, errors_V: Sequence[float], scored_s: float) -> str:
        """Choose by the rms errors, V, after ``scored_s`` more seconds of motion; infinite: not to be served.

        Returns why the champion has changed, or "" where it has not.
        """
        c, now, best = self.config, self.champion, int(np.argmin(errors_V))
        if math.isinf(errors_V[now]) and math.isfinite(errors_V[best]):
            return self._crown(best, FAILED)
        # The favourite comes back where it is no worse; any other must win clearly.
        other = 0 if now != 0 and errors_V[0] < errors_V[now] else best
        margin, floor_V = (1.0, 0.0) if other == 0 else (c.margin, c.floor * self.span_V)
        ahead = other != now and errors_V[now] > margin * errors_V[other] + floor_V
        self.ahead_s = self.ahead_s + scored_s if ahead else 0.0
        if ahead and self.ahead_s >= c.patience_s:
            return self._crown(other, WINS)
        return ""

    def _crown(self, champion: int, why: str) -> str:
        self.champion, self.ahead_s = champion, 0.0
        self.changes += 1
        return why
