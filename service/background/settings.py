"""Settings of the background work: the tables ``[axis.diagnosis]`` and ``[axis.retuning]`` of a configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.tuning.config import RetuneConfig


@dataclass(frozen=True, slots=True)
class WatchConfig:
    """When to diagnose, which samples, and for how long.

    Attributes
    ----------
    enabled : false: no samples are kept, no process is started.
    history_s : time of the samples kept; those before the recent ones settle the hysteresis memory.
    reference_s : time of the reference, which is taken after the start and after each verdict.
    recent_s : time of the samples diagnosed on request.
    collect_s : time of the samples collected after an alarm and then diagnosed.
    gain_alarm : relative change of the gain since the reference that raises an alarm.
    offset_alarm : the same of the offset, share of the voltage span.
    error_factor, error_floor_pct : recent rms error that raises an alarm: multiple of that in the reference, and
        percentage of the voltage span.
    hold_s : time for which a condition must last to raise an alarm.
    cooldown_s : least time between two alarms.
    timeout_s : longest time of a diagnosis; then its process is killed.
    reports : folder for full reports on request (``"report": true``); empty for none.
    """

    enabled: bool = True
    history_s: float = 40.0
    reference_s: float = 20.0
    recent_s: float = 10.0
    collect_s: float = 6.0
    gain_alarm: float = 0.01
    offset_alarm: float = 0.02
    error_factor: float = 4.0
    error_floor_pct: float = 0.5
    hold_s: float = 0.5
    cooldown_s: float = 30.0
    timeout_s: float = 120.0
    reports: str = ""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("history_s", 2.0, 3600.0),
            ("reference_s", 2.0, 3600.0),
            ("recent_s", 1.5, 3600.0),
            ("collect_s", 1.5, 3600.0),
            ("gain_alarm", 1e-4, 1.0),
            ("offset_alarm", 1e-4, 1.0),
            ("error_factor", 1.1, 1e6),
            ("error_floor_pct", 0.0, 100.0),
            ("hold_s", 0.0, 600.0),
            ("cooldown_s", 0.0, 1e6),
            ("timeout_s", 1.0, 3600.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name}: got {value!r}, expected {low:g} to {high:g}")
        longest = max(self.reference_s, self.recent_s, self.collect_s)
        if self.history_s < longest:
            raise InputError(
                f"history_s: got {self.history_s:g} s, expected at least {longest:g} s, "
                "the longest of reference_s, recent_s and collect_s"
            )


@dataclass(frozen=True, slots=True)
class RetuningConfig:
    """When and how to re-tune the hyper-parameters.

    Attributes
    ----------
    enabled : false: no re-tuning, also on request.
    period_s : time of samples from the end of a re-tuning to the next; 0: only on request.
    fresh : new samples of the window that a proposal is tried on.
    wait_s : longest time of samples to wait for these; then the proposal is dropped.
    lead_s : time of samples from announcement to adoption, so that a standby adopts at the same one.
    timeout_s : longest time of the process.
    search : range of the search and the criterion of a better model; see ``adaptive.tuning.config``.
    """

    enabled: bool = True
    period_s: float = 60.0
    fresh: int = 200
    wait_s: float = 120.0
    lead_s: float = 0.5
    timeout_s: float = 60.0
    search: RetuneConfig = field(default_factory=RetuneConfig)

    def __post_init__(self) -> None:
        if not (self.period_s >= 0.0 and 0.0 <= self.lead_s <= 60.0):
            raise InputError(f"period_s, lead_s: got {self.period_s}, {self.lead_s}, expected >= 0 s, and 0 to 60 s")
        if not (self.fresh >= 20 and self.wait_s > 0.0 and self.timeout_s > 0.0):
            raise InputError(
                f"fresh, wait_s, timeout_s: got {self.fresh}, {self.wait_s}, {self.timeout_s}, "
                "expected at least 20 samples, and positive times"
            )
