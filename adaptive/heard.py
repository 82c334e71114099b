"""The voltages of samples without a reading, and a guess at those of samples that never came."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from adaptive.admission import AdmissionState
from adaptive.hypotheses import MOST_BRIDGED
from adaptive.types import FloatArray, Sample

#: Samples without a reading whose voltages are kept.
MOST_HEARD = MOST_BRIDGED


class Heard:
    """Pairs (seq, voltage in V) of samples whose readings were none, since the last one taken."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, float]] = deque(maxlen=MOST_HEARD)

    def put(self, sample: Sample) -> None:
        """Keep the voltage of a sample: no reading, but the stage goes on."""
        self._kept.append((sample.seq, sample.u_V))

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()

    def missed(self, gates: AdmissionState, sample: Sample, max_gap: int) -> tuple[list[float], bool]:
        """Voltages, V, of the samples without a reading before ``sample``, and whether too many never came."""
        first, missing = gates.seq + 1, sample.seq - gates.seq - 1
        heard = {seq: u for seq, u in self._kept if seq < sample.seq}
        # Nobody knows the voltages of samples that never came; a straight line between is the best guess.
        slope_V = (sample.u_V - gates.u_V) / (missing + 1)
        between = [heard.get(first + i, gates.u_V + slope_V * (i + 1)) for i in range(min(missing, MOST_HEARD))]
        return between, missing > MOST_HEARD or missing - len(heard) > max_gap

    def array(self) -> FloatArray:
        """(n, 2) pairs, for a file."""
        return np.array(self._kept, dtype=np.float64).reshape(-1, 2)

    def restore(self, pairs: Iterable[Iterable[float]]) -> None:
        """Inverse of ``array``."""
        self._kept.clear()
        self._kept.extend((int(seq), float(u)) for seq, u in pairs)
