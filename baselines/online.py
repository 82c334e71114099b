"""What the online baselines share: the gates of a raw sample, the counters, the running error.

The names of the gates are those of ``adaptive.online.gates``, so that the service counts all models alike.
"""

from __future__ import annotations

import math
from typing import Any

from adaptive.errors import InputError
from adaptive.online.gates import (
    DUPLICATE,
    GAP,
    LEARNT,
    NOT_FINITE,
    NUMERICS,
    OUT_OF_ORDER,
    OUTLIER,
    PASSED,
    SETTLING,
    TIMING,
    UNEXCITED,
)
from adaptive.state_codec import prefixed
from adaptive.types import FloatArray, Hyperparameters, InverseModel, OnlineModel, Sample, StateDict, WindowData

REASONS = (NOT_FINITE, DUPLICATE, OUT_OF_ORDER, TIMING, GAP, SETTLING, UNEXCITED, OUTLIER, NUMERICS)
#: Relative error of a time step beyond which a sample's clock is not believed.
_TIMING_TOLERANCE = 0.5
#: Beyond these magnitudes a reading cannot be one (µm, V); keeps squares finite.
_ABSURD = 1e9


class OnlineBaseline:
    """Gates and bookkeeping of one axis; the models derive from it and implement ``_advance``.

    Deterministic, bounded in time and memory. Not for several threads at once. The abilities of
    :class:`adaptive.types.OnlineModel` that a baseline lacks are implemented here, trivially.
    """

    def __init__(self, dt_s: float, settle: int) -> None:
        self._dt = dt_s
        self._settle = settle
        self._seq = -1
        self._t_s = 0.0
        self._since_start = 0
        self._square = 0.0
        self._counters = dict.fromkeys((LEARNT, PASSED, *REASONS), 0)

    @property
    def seq(self) -> int:
        """Sequence number of the last sample handled, -1 before any."""
        return self._seq

    # ---- abilities that only a learner has

    def resync(self) -> None:
        """Nothing: ``handle`` restarts by itself after a gap in time or numbers."""

    def take_place_of(self, other: OnlineModel) -> None:
        """Nothing, as in ``resync``: the position of a baseline is its last sample."""

    def freeze(self) -> None:
        """Nothing: a competition gives a frozen baseline no samples."""

    def thaw(self) -> None:
        """Nothing; see ``freeze``."""

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """None: a baseline tracks no memory of its own."""
        return None

    def window_data(self) -> WindowData | None:
        """None: there are no hyper-parameters to tune."""
        return None

    def adopt(self, hyper: Hyperparameters) -> str:
        """Refused."""
        return "it has no hyper-parameters"

    @property
    def trouble(self) -> str:
        """Always "": a baseline does not judge the sensor."""
        return ""

    @property
    def why(self) -> str:
        return ""

    @property
    def distrusts(self) -> bool:
        return False

    def diagnostics(self) -> dict[str, Any]:
        """Empty."""
        return {}

    def take_events(self) -> list[tuple[str, str]]:
        """Empty."""
        return []

    def warm(self) -> None:
        """Nothing: the first samples load every step."""

    # ---- samples, counters and the shared state

    def counters(self) -> dict[str, int]:
        """Samples by outcome; every outcome there is appears."""
        return dict(self._counters)

    def handle(self, sample: Sample) -> str:
        """Take one raw sample. Returns "learnt", "passed" (good, but none was due) or the gate that refused it."""
        outcome = self._gate(sample)
        if not outcome:
            missing = self._seq >= 0 and sample.seq > self._seq + 1
            first = self._seq < 0
            self._seq, self._t_s = sample.seq, sample.t_s
            if first or missing:
                self._since_start = 0
                self._restart(sample.u_V, sample.y_um, first)
            else:
                self._since_start += 1
            if missing:
                outcome = GAP
            else:
                outcome = self._advance(sample.u_V, sample.y_um, self._since_start >= self._settle)
        self._counters[outcome] += 1
        return outcome

    def _gate(self, sample: Sample) -> str:
        if not (math.isfinite(sample.t_s) and abs(sample.u_V) < _ABSURD and abs(sample.y_um) < _ABSURD):
            return NOT_FINITE
        if self._seq < 0:
            return ""
        if sample.seq == self._seq:
            return DUPLICATE
        if sample.seq < self._seq:
            return OUT_OF_ORDER
        expected = (sample.seq - self._seq) * self._dt
        return TIMING if abs(sample.t_s - self._t_s - expected) > _TIMING_TOLERANCE * expected else ""

    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        """Called at the first sample and after a gap, in place of ``_advance``'s step through time."""
        raise NotImplementedError

    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        """Take a good sample; returns the outcome. ``settled``: enough samples since start or gap."""
        raise NotImplementedError

    @classmethod
    def from_state(cls, state: StateDict) -> OnlineModel:
        """Inverse of ``state_dict`` of the same class."""
        raise NotImplementedError

    def restored(self, state: StateDict) -> OnlineModel:
        """A baseline of this class with ``state``. Raises InputError where a field is missing."""
        return self.from_state(state)

    def _common_state(self) -> StateDict:
        counted = prefixed("count_", self._counters)
        return {
            "seq": self._seq,
            "t_s": self._t_s,
            "since_start": self._since_start,
            "square_um2": self._square,
            **counted,
        }

    def _restore_common(self, state: StateDict) -> None:
        self._seq, self._t_s = int(state["seq"]), float(state["t_s"])
        self._since_start, self._square = int(state["since_start"]), float(state["square_um2"])
        for name in self._counters:
            self._counters[name] = int(state[f"count_{name}"])


def field_of(state: StateDict, name: str, kind: str) -> Any:
    """A field of a stored state; raises InputError where it is missing."""
    if name not in state:
        raise InputError(f"{name}: missing in the state of a {kind} model; start from a model file instead")
    return state[name]
