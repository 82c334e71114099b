"""Settings of the diagnosis in the background: the table ``[axis.diagnosis]`` of a service's configuration."""

from __future__ import annotations

from dataclasses import dataclass

from adaptive.errors import InputError


@dataclass(frozen=True, slots=True)
class WatchConfig:
    """When to diagnose, on what, and for how long.

    Attributes
    ----------
    enabled : False switches it off: no samples are kept, no process is started.
    history_s : how far back samples are kept, s; what lies before the recent ones settles the loop's memory.
    reference_s : length of the stretch in which all was well, taken after the start and after each verdict, s.
    recent_s : what a request looks at, s. collect_s : what is waited for after an alarm, and looked at, s.
    gain_alarm : relative change of the stage's gain since the reference that raises an alarm.
    offset_alarm : change of its offset, share of the model's voltage span.
    error_factor, error_floor_pct : the learner's recent rms error against that of the reference, and in percent of
        the voltage span, beyond both of which it raises an alarm.
    hold_s : how long it must last, s. cooldown_s : least time between two alarms, s.
    timeout_s : longest time that a diagnosis may take before it is ended, s.
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
                f"history_s: got {self.history_s:g} s, expected at least {longest:g} s, the longest stretch looked at"
            )
