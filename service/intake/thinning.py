"""Thins samples by a stated factor where a stage sends more than the learner can handle.

Whole stretches of 50 ms are handled and whole ones are left out. Over such a gap the hysteresis memory goes on without
loss, while single samples left out everywhere would leave the smoother nothing to work with.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive.types import BoolArray
from service.protocol.samples import SampleBatch

#: Length of a stretch, s, and its fewest samples.
_STRETCH_S: Final = 0.05
_LEAST_SAMPLES: Final = 100
#: Shares of the queue above which the factor is raised, and below which it may be lowered.
_HIGH, _LOW = 0.5, 0.05
#: Time for which the queue fills before the factor is raised, s; calm time before it is lowered, s, and the longest
#: one: each vain trial doubles it.
_RAISE_S, _CALM_S, _LONGEST_CALM_S = 0.5, 10.0, 600.0
_MOST: Final = 1000
#: Share by which the learner is to be faster than the samples that are left.
_RESERVE: Final = 1.1


class Thinner:
    """Chooses the samples of one axis that are handled. One thread calls it.

    Parameters
    ----------
    dt_s : sample time, s. capacity : samples that may wait for the learner.

    Attributes
    ----------
    factor : one of so many stretches is handled; 1 for all. thinned : samples left out since the start.
    """

    def __init__(self, dt_s: float, capacity: int) -> None:
        self.factor = 1
        self.thinned = 0
        self._length = max(_LEAST_SAMPLES, round(_STRETCH_S / dt_s))
        self._high, self._low = _HIGH * capacity, _LOW * capacity
        #: When the queue became half full, when it was last not empty, and when the factor changed and was lowered.
        self._high_s, self._busy_s, self._changed_s, self._lowered_s = np.inf, -np.inf, -np.inf, -np.inf
        self._waiting_then = self._sent = self._sent_then = self._kept_then = 0
        self._calm_s = _CALM_S

    def watch(self, waiting: int, now_s: float) -> bool:
        """Adapt the factor to the ``waiting`` samples at ``now_s`` (any monotonic clock); whether it has changed."""
        if waiting > self._low:
            self._busy_s = now_s
        if waiting <= self._high:
            self._high_s = np.inf
        elif self._high_s == np.inf:
            self._high_s, self._waiting_then = now_s, waiting
            self._sent_then, self._kept_then = self._sent, self._sent - self.thinned
        if now_s - self._high_s >= _RAISE_S and self.factor < _MOST:
            self._high_s = np.inf
            needed = self._needed(waiting)
            # While the queue empties the factor is large enough, and a learner that stands still needs another remedy.
            if waiting < self._waiting_then or not needed:
                return False
            if now_s - self._lowered_s < self._calm_s:
                self._calm_s = min(2.0 * self._calm_s, _LONGEST_CALM_S)
            self.factor, self._changed_s = needed, now_s
            return True
        if self.factor > 1 and now_s - max(self._busy_s, self._changed_s) >= self._calm_s:
            self.factor, self._changed_s, self._lowered_s = self.factor - 1, now_s, now_s
            return True
        return False

    def _needed(self, waiting: int) -> int:
        """The factor for which the samples handled while the queue filled would have been enough; 0: none were."""
        sent = self._sent - self._sent_then
        handled = self._sent - self.thinned - self._kept_then - (waiting - self._waiting_then)
        if handled <= 0:
            return 0
        wanted = math.ceil(_RESERVE * sent / handled)
        return min(max(wanted, self.factor + 1), 2 * self.factor + 4, _MOST)

    def split(self, batch: SampleBatch) -> tuple[SampleBatch | None, SampleBatch | None]:
        """(samples to handle, samples left out); None for none."""
        self._sent += len(batch)
        if self.factor == 1:
            return batch, None
        kept: BoolArray = (batch.seq // self._length) % self.factor == 0
        count = int(np.count_nonzero(kept))
        self.thinned += len(batch) - count
        if count == len(batch):
            return batch, None
        return (batch.where(kept) if count else None), batch.where(~kept)
