"""Settings of the background work: the tables ``[axis.diagnosis]`` and ``[axis.retuning]`` of a configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.tuning.config import RetuneConfig
from dehyst.service.config.schema import Setting

#: Time of the samples that a diagnosis takes.
RECENT: Final = Setting(unit="s", low=1.5, high=3600.0)


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
    history_s: Annotated[float, Setting(unit="s", low=2.0, high=3600.0)] = 40.0
    reference_s: Annotated[float, Setting(unit="s", low=2.0, high=3600.0)] = 20.0
    recent_s: Annotated[float, RECENT] = 10.0
    collect_s: Annotated[float, RECENT] = 6.0
    gain_alarm: Annotated[float, Setting(low=1e-4, high=1.0)] = 0.01
    offset_alarm: Annotated[float, Setting(low=1e-4, high=1.0)] = 0.02
    error_factor: Annotated[float, Setting(low=1.1, high=1e6)] = 4.0
    error_floor_pct: Annotated[float, Setting(low=0.0, high=100.0)] = 0.5
    hold_s: Annotated[float, Setting(unit="s", low=0.0, high=600.0)] = 0.5
    cooldown_s: Annotated[float, Setting(unit="s", low=0.0, high=1e6)] = 30.0
    timeout_s: Annotated[float, Setting(unit="s", low=1.0, high=3600.0)] = 120.0
    reports: str = ""

    def __post_init__(self) -> None:
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
    period_s: Annotated[float, Setting(unit="s", low=0.0)] = 60.0
    fresh: Annotated[int, Setting(low=20)] = 200
    wait_s: Annotated[float, Setting(unit="s", low=0.0, above=True)] = 120.0
    lead_s: Annotated[float, Setting(unit="s", low=0.0, high=60.0)] = 0.5
    timeout_s: Annotated[float, Setting(unit="s", low=0.0, above=True)] = 60.0
    search: RetuneConfig = field(default_factory=RetuneConfig)
