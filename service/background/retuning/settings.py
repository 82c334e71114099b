"""Settings of the re-tuning in the background: the table ``[axis.retuning]``."""

from __future__ import annotations

from dataclasses import dataclass, field

from adaptive.errors import InputError
from adaptive.tuning.config import RetuneConfig


@dataclass(frozen=True, slots=True)
class RetuningConfig:
    """When and how to re-tune the hyper-parameters.

    Attributes
    ----------
    enabled : False switches re-tuning off, also on request.
    period_s : time from the end of a re-tuning to the next, s of samples; 0: only on request.
    fresh : samples of the window that a proposal is tried on; it was not tuned on them.
    wait_s : longest wait for the fresh samples, s of samples; then the proposal is dropped.
    lead_s : time between announcement and adoption, s of samples, so that a standby adopts at the same sample.
    timeout_s : longest time of the process, s. torch : find starting points with torch if it is installed.
    search : range of the search and the criterion of a better model; see ``adaptive.tuning.config``.
    """

    enabled: bool = True
    period_s: float = 60.0
    fresh: int = 200
    wait_s: float = 120.0
    lead_s: float = 0.5
    timeout_s: float = 60.0
    torch: bool = True
    search: RetuneConfig = field(default_factory=RetuneConfig)

    def __post_init__(self) -> None:
        if not (self.period_s >= 0.0 and 0.0 <= self.lead_s <= 60.0):
            raise InputError(f"period_s, lead_s: got {self.period_s}, {self.lead_s}, expected >= 0 s, and 0 to 60 s")
        if not (self.fresh >= 20 and self.wait_s > 0.0 and self.timeout_s > 0.0):
            raise InputError(
                f"fresh, wait_s, timeout_s: got {self.fresh}, {self.wait_s}, {self.timeout_s}, "
                "expected at least 20 samples, and positive times"
            )
