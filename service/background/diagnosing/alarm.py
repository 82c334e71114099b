"""The alarm of the diagnosis: compares the figures of the learner with those of a reference period."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.background.diagnosing.settings import WatchConfig


@dataclass(frozen=True, slots=True)
class Levels:
    """Figures of a learner: gain of the stage, offset in V, recent rms error in % of the voltage span, validity."""

    gain: float
    offset_V: float
    error_pct: float
    valid: bool

    @staticmethod
    def of(diagnostics: Mapping[str, Any]) -> Levels | None:
        """From the diagnostics of a learner; None if they lack a figure or one is not finite."""
        try:
            levels = Levels(
                float(diagnostics["gain"]),
                float(diagnostics["offset_V"]),
                float(diagnostics["recent_rms_error_pct"]),
                bool(diagnostics.get("valid", 1.0)),
            )
        except (KeyError, TypeError, ValueError):
            return None
        return levels if all(math.isfinite(v) for v in (levels.gain, levels.offset_V, levels.error_pct)) else None


class Alarm:
    """Raises an alarm when a figure has been out of bounds for ``hold_s``. The caller passes the time."""

    def __init__(self, config: WatchConfig, span_V: float) -> None:
        self._config = config
        self._span_V = max(abs(span_V), 1e-12)
        self._normal: Levels | None = None
        self._since_s: float | None = None

    @property
    def armed(self) -> bool:
        """Whether it has reference levels."""
        return self._normal is not None

    def arm(self, levels: Levels | None) -> None:
        """Take ``levels`` as the reference; None disarms."""
        self._normal, self._since_s = levels, None

    def check(self, t_s: float, now: Levels) -> str:
        """The reason for an alarm at ``t_s``; "" for no alarm."""
        if self._normal is None:
            return ""
        why = self._out_of_bounds(now, self._normal)
        if not why:
            self._since_s = None
            return ""
        if self._since_s is None or t_s < self._since_s:
            self._since_s = t_s
        return why if t_s - self._since_s >= self._config.hold_s else ""

    def _out_of_bounds(self, now: Levels, normal: Levels) -> str:
        c = self._config
        gain = now.gain / normal.gain - 1.0 if normal.gain else 0.0
        if abs(gain) > c.gain_alarm:
            return f"the learner's gain moved by {100.0 * gain:+.1f} %"
        offset = (now.offset_V - normal.offset_V) / self._span_V
        if abs(offset) > c.offset_alarm:
            return f"the learner's offset moved by {100.0 * offset:+.1f} % of the span"
        if now.error_pct > max(c.error_factor * normal.error_pct, c.error_floor_pct):
            return f"the learner's error grew from {normal.error_pct:.2g} to {now.error_pct:.2g} % of the span"
        if normal.valid and not now.valid:
            return "the learner lost its validity"
        return ""
