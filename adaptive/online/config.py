"""The learner's frozen configuration, to and from flat entries of a state file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.online.drift import DriftConfig
from dehyst.adaptive.online.gates import AdmissionConfig, EnvelopeConfig
from dehyst.adaptive.online.kernel_window import Eviction
from dehyst.adaptive.smoothing import SmootherConfig
from dehyst.adaptive.types import StateDict, joined, under
from dehyst.adaptive.window.window import SolverConfig

#: Groups of settings that are tables of their own.
_TABLES: Final[dict[str, type[Any]]] = {
    "admission": AdmissionConfig, "drift": DriftConfig, "solver": SolverConfig, "envelope": EnvelopeConfig,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class LearnerConfig:
    """Frozen configuration of a learner.

    window : samples that the LSSVM holds.
    learn_every, filter_every : samples between two steps of window (whole steps of the filter) and filter.
    eviction : whose slot a new sample takes: its nearest neighbour's, or the oldest's.
    cutoff_hz, lag : of the smoother; without lag, what the cut-off needs.
    serving_age_s : age of the model when its answers take effect; errors are judged at that age.
    valid_enter, valid_leave : rms prediction error, shares of the voltage span, at which the model becomes valid again,
    and invalid.
    fallback_floor : share of the voltage span by which the learner may be worse than the identified model.
    creep_s : time within which what the constant takes up at rest goes over to the frame; 0: it stays.
    envelope : what the stage can become.
    """

    window: int = 500
    learn_every: int = 10
    filter_every: int = 2
    eviction: Eviction = "nearest"
    cutoff_hz: float = 200.0
    lag: int | None = None
    serving_age_s: float = 0.08
    valid_enter: float = 0.004
    valid_leave: float = 0.012
    fallback_floor: float = 0.002
    creep_s: float = 0.1
    admission: AdmissionConfig = field(default_factory=AdmissionConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    envelope: EnvelopeConfig = field(default_factory=EnvelopeConfig)

    def __post_init__(self) -> None:
        if self.window < 10:
            raise InputError(f"window: got {self.window}, expected at least 10 samples")
        if self.learn_every < 1 or self.filter_every < 1:
            raise InputError(
                f"learn_every, filter_every: got {self.learn_every}, {self.filter_every}, expected at least 1 sample"
            )
        if self.eviction not in ("nearest", "fifo"):
            raise InputError(f"eviction: got {self.eviction!r}, expected 'nearest' or 'fifo'")
        if not 0.0 <= self.serving_age_s <= 10.0:
            raise InputError(f"serving_age_s: got {self.serving_age_s}, expected 0 to 10 s")
        if not 0.0 <= self.creep_s <= 1e6:
            raise InputError(f"creep_s: got {self.creep_s}, expected a time in s, or 0 to leave the frame where it is")
        if not 0.0 < self.valid_enter <= self.valid_leave:
            raise InputError(
                f"valid_enter, valid_leave: got {self.valid_enter}, {self.valid_leave}, expected 0 < enter <= leave"
            )

    @property
    def window_every(self) -> int:
        """Updates of the filter between two steps of the window."""
        return max(1, self.learn_every // self.filter_every)

    def state_dict(self) -> StateDict:
        """All fields under flat names."""
        own = asdict(self)
        return joined({name: own.pop(name) for name in _TABLES}) | own

    @classmethod
    def from_state(cls, values: StateDict) -> LearnerConfig:
        """Inverse of ``state_dict``."""
        own = {name: value for name, value in values.items() if "." not in name}
        return cls(**own, **{name: table(**under(f"{name}.", values)) for name, table in _TABLES.items()})

    def smoother(self, dt_s: float) -> SmootherConfig:
        """The smoother at a sample time."""
        made = SmootherConfig.for_rate(dt_s, self.cutoff_hz)
        return made if self.lag is None else replace(made, lag=self.lag)
