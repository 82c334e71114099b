"""Validity of the served model, from its prediction errors.

The error is the measured voltage minus the voltage that the model gives for the measured motion, before the sample is
learnt, with the model as old as an answer is when it takes effect. The identified (frozen) model is judged likewise.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass
from math import sqrt

import numpy as np

from adaptive.types import FloatArray, StateDict

#: Time constants of the mean square errors, s: long for reports and stated uncertainty, short to detect trouble.
LONG_S, SHORT_S = 2.0, 0.1

#: The frozen model is served where the learner's short-term rms exceeds its own by this factor plus a floor.
FALLBACK_RATIO = 1.3


@dataclass(slots=True)
class Judgement:
    """Mean square prediction errors, V², over long and short time, of the learner and of the frozen model.

    error_V : the learner's last error. judged : number of errors. valid : whether the learnt model is valid.
    inside : number of errors within one stated standard deviation.
    fallback : whether the frozen model is served because it predicts better; fallen_s : for how long, s.
    doubt_V2 : extra variance after a jump whose cause is open; it decays as errors are seen.
    """

    long_V2: float
    short_V2: float
    frozen_V2: float
    frozen_short_V2: float
    error_V: float = 0.0
    judged: int = 0
    inside: int = 0
    valid: bool = True
    fallback: bool = False
    fallen_s: float = 0.0
    doubt_V2: float = 0.0

    def take(self, error_V: float, frozen_error_V: float, step_s: float) -> None:
        """Take one error of the learnt and of the frozen model, V."""
        squared = error_V * error_V
        slow, fast = min(1.0, step_s / LONG_S), min(1.0, step_s / SHORT_S)
        if self.judged > 0 and squared <= self.variance_V2:
            self.inside += 1
        self.error_V = error_V
        self.judged += 1
        self.long_V2 += (squared - self.long_V2) * slow
        self.short_V2 += (squared - self.short_V2) * fast
        self.doubt_V2 *= 1.0 - fast
        frozen = frozen_error_V * frozen_error_V
        self.frozen_V2 += (frozen - self.frozen_V2) * slow
        self.frozen_short_V2 += (frozen - self.frozen_short_V2) * fast

    def decide(self, enter_V: float, leave_V: float) -> bool:
        """Validity with hysteresis: lost when the short-term rms exceeds ``leave_V``, regained below ``enter_V``."""
        rms = sqrt(self.short_V2)
        if self.valid and rms > leave_V:
            self.valid = False
        elif not self.valid and rms < enter_V:
            self.valid = True
        return self.valid

    def choose(self, floor_V: float, step_s: float) -> bool:
        """Whether to serve the frozen model: taken when clearly better, left when worse."""
        learnt, frozen = sqrt(self.short_V2), sqrt(self.frozen_short_V2)
        if not self.fallback and learnt > FALLBACK_RATIO * frozen + floor_V:
            self.fallback = True
        elif self.fallback and learnt < frozen:
            self.fallback = False
        self.fallen_s = self.fallen_s + step_s if self.fallback else 0.0
        return self.fallback

    @property
    def variance_V2(self) -> float:
        """Variance behind the stated uncertainty: the larger of long and short term, plus ``doubt_V2``."""
        return max(self.long_V2, self.short_V2) + self.doubt_V2

    def state_dict(self) -> StateDict:
        return asdict(self)

    @classmethod
    def from_state(cls, values: StateDict) -> Judgement:
        return cls(
            long_V2=float(values["long_V2"]),
            short_V2=float(values["short_V2"]),
            frozen_V2=float(values["frozen_V2"]),
            frozen_short_V2=float(values["frozen_short_V2"]),
            error_V=float(values["error_V"]),
            judged=int(values["judged"]),
            inside=int(values["inside"]),
            valid=bool(values["valid"]),
            fallback=bool(values["fallback"]),
            fallen_s=float(values["fallen_s"]),
            doubt_V2=float(values["doubt_V2"]),
        )


class Delay:
    """The last ``steps`` + 1 coefficient vectors: errors are those of the model as it was ``steps`` ago."""

    def __init__(self, steps: int) -> None:
        self._past: deque[FloatArray] = deque(maxlen=steps + 1)

    def push(self, vector: FloatArray) -> FloatArray:
        """Take the newest, return the oldest kept."""
        self._past.append(vector)
        return self._past[0]

    def shift(self, by: float) -> None:
        """Add to the first entry of all kept."""
        for vector in self._past:
            vector[0] += by

    def array(self) -> FloatArray:
        """All vectors, oldest first, for a state file."""
        return np.array(self._past, dtype=np.float64)

    def restore(self, vectors: FloatArray) -> None:
        self._past.extend(np.array(v, dtype=np.float64) for v in vectors)
