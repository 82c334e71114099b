"""What the online baselines share: admission of raw samples, outcome counters, running error.

Outcomes have the names of ``adaptive.online.gates``, so the service counts the samples of all models alike.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
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
from adaptive.types import (
    FloatArray,
    Hyperparameters,
    InverseModel,
    OnlineModel,
    Sample,
    StateDict,
    WindowData,
    prefixed,
)

REASONS = (NOT_FINITE, DUPLICATE, OUT_OF_ORDER, TIMING, GAP, SETTLING, UNEXCITED, OUTLIER, NUMERICS)
#: Relative error of a time step above which the sample is refused.
_TIMING_TOLERANCE = 0.5
#: Magnitude (µm, V) from which a value is refused as not finite; keeps squares finite.
_LARGEST = 1e9


class OnlineBaseline(ABC):
    """Admission and bookkeeping of one axis; a model derives from it and implements ``_restart`` and ``_advance``.

    Deterministic, bounded in time and memory. Not thread-safe. The abilities of :class:`adaptive.types.OnlineModel`
    that a baseline lacks are implemented here, trivially.

    Parameters
    ----------
    dt_s : sample time, s.
    settle : samples after a start or a gap that do not teach.
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

    def counters(self) -> dict[str, int]:
        """Number of samples by outcome, for every outcome."""
        return dict(self._counters)

    def handle(self, sample: Sample) -> str:
        """Take a raw sample. Returns "learnt", "passed" (good, but not due to teach), or the reason of a refusal."""
        outcome = self._refusal(sample)
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

    # ---- abilities that only a learner has

    def resync(self) -> None:
        """Do nothing: ``handle`` restarts by itself after a gap in time or numbers."""

    def take_place_of(self, other: OnlineModel) -> None:
        """Do nothing, as in ``resync``: the position of a baseline is its last sample."""

    def freeze(self) -> None:
        """Do nothing: a competition gives a frozen baseline no samples."""

    def thaw(self) -> None:
        """Do nothing; see ``freeze``."""

    def memory_for(self, model: InverseModel, smoothed: bool = False) -> FloatArray | None:
        """None: a baseline tracks no memory of its own."""
        return None

    def window_data(self) -> WindowData | None:
        """None: there are no hyper-parameters to tune."""
        return None

    def adopt(self, hyper: Hyperparameters) -> str:
        """Refuse: there are no hyper-parameters."""
        return "it has no hyper-parameters"

    @property
    def trouble(self) -> str:
        """Always "": a baseline does not judge the sensor."""
        return ""

    @property
    def why(self) -> str:
        """Always ""; see ``trouble``."""
        return ""

    @property
    def distrusts(self) -> bool:
        """Always False; see ``trouble``."""
        return False

    def diagnostics(self) -> dict[str, Any]:
        """Empty."""
        return {}

    def take_events(self) -> list[tuple[str, str]]:
        """Empty."""
        return []

    def warm(self) -> None:
        """Do nothing: the first samples load every step."""

    # ---- inside a sample, and the shared state

    def _refusal(self, sample: Sample) -> str:
        if not (math.isfinite(sample.t_s) and abs(sample.u_V) < _LARGEST and abs(sample.y_um) < _LARGEST):
            return NOT_FINITE
        if self._seq < 0:
            return ""
        if sample.seq == self._seq:
            return DUPLICATE
        if sample.seq < self._seq:
            return OUT_OF_ORDER
        expected = (sample.seq - self._seq) * self._dt
        return TIMING if abs(sample.t_s - self._t_s - expected) > _TIMING_TOLERANCE * expected else ""

    @abstractmethod
    def _restart(self, u_V: float, y_um: float, first: bool) -> None:
        """Begin at the first sample or after a gap, where the time since the sample before is not one step."""

    @abstractmethod
    def _advance(self, u_V: float, y_um: float, settled: bool) -> str:
        """Take a good sample one step after the last. Returns the outcome. ``settled``: it may teach."""

    @classmethod
    @abstractmethod
    def from_state(cls, state: StateDict) -> OnlineModel:
        """Inverse of ``state_dict`` of the same class."""

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
    """The entry ``name`` of the stored state of a ``kind`` model. Raises InputError where it is missing."""
    if name not in state:
        raise InputError(f"{name}: missing in the state of a {kind} model; start from a model file instead")
    return state[name]
