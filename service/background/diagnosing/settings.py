"""Settings of the diagnosis in the background: the table ``[axis.diagnosis]`` of a service's configuration."""

from __future__ import annotations

from dataclasses import dataclass

from adaptive.errors import InputError


@dataclass(frozen=True, slots=True)
class WatchConfig:
    """When to diagnose, which samples, and for how long.

    Attributes
    ----------
    enabled : False switches the diagnosis off: no samples are kept, no process is started.
    history_s : length of the samples kept, s; those before the recent ones settle the hysteresis memory.
    reference_s : length of the reference, s; it is taken after the start and after each verdict.
    recent_s : length of the samples diagnosed on request, s.
    collect_s : length of the samples collected after an alarm and then diagnosed, s.
    gain_alarm : relative change of the stage's gain since the reference that raises an alarm.
    offset_alarm : change of the stage's offset since the reference that raises an alarm, share of the voltage span.
    error_factor, error_floor_pct : an alarm is raised when the recent rms error of the learner exceeds this multiple of
        that in the reference, and this percentage of the voltage span.
    hold_s : time for which a condition must last to raise an alarm, s. cooldown_s : least time between two alarms, s.
    timeout_s : longest time of a diagnosis, s; then its process is killed.
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
