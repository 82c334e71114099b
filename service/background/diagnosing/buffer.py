"""The newest samples of one axis in a ring buffer of fixed size. One thread writes; any thread may copy."""

from __future__ import annotations

import threading
from typing import Final

import numpy as np

from adaptive.types import FloatArray
from service.protocol.samples import SampleBatch

#: Most samples that are kept, at any sample rate.
MOST_SAMPLES: Final = 200_000
#: Old samples in a row that mean a restarted count of the stage rather than late samples.
_RESTART_AFTER: Final = 200


class SampleBuffer:
    """The newest samples as rows (seq, t_s, u_V, y_um) of a (4, n) array; new samples overwrite the oldest."""

    def __init__(self, samples: int) -> None:
        self._rows = np.full((4, max(1, min(samples, MOST_SAMPLES))), np.nan)
        self._end = 0
        self._kept = 0
        self._last = -1
        self._old = 0
        self._lock = threading.Lock()

    @property
    def last_seq(self) -> int:
        """Number of the newest sample; -1 for none."""
        return self._last

    @property
    def size(self) -> int:
        """Number of samples kept."""
        return self._kept

    def add(self, batch: SampleBatch) -> bool:
        """Append the samples newer than all earlier ones. Returns False if the stage has restarted its count."""
        new = batch.seq > self._last
        going_on = True
        if not new.all():
            # Skip duplicates and late samples; a long run of them means a restarted stage.
            self._old = self._old + int(batch.seq.size - new.sum()) if not new.any() else 0
            if self._old >= _RESTART_AFTER:
                self.clear()
                new = np.ones_like(new)
                going_on = False
            elif not new.any():
                return True
        else:
            self._old = 0
        block = np.stack([batch.seq, batch.t_s, batch.u_V, batch.y_um])[:, new]
        n, room = block.shape[1], self._rows.shape[1]
        block = block[:, -room:]
        where = (self._end + np.arange(block.shape[1])) % room
        with self._lock:
            self._rows[:, where] = block
            self._end = int((self._end + block.shape[1]) % room)
            self._kept = min(room, self._kept + n)
            self._last = int(batch.seq[new][-1])
        return going_on

    def clear(self) -> None:
        """Remove all samples."""
        with self._lock:
            self._end = self._kept = self._old = 0
            self._last = -1

    def copy(self, samples: int | None = None) -> FloatArray:
        """The newest ``samples`` (all by default) as (4, n): seq, t_s, u_V, y_um; oldest first."""
        with self._lock:
            n = self._kept if samples is None else min(samples, self._kept)
            where = (self._end - n + np.arange(n)) % self._rows.shape[1]
            return np.asarray(self._rows[:, where])
