"""When to look: the learner's own figures against those of the time when all was well."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.background.diagnosing.settings import WatchConfig


@dataclass(frozen=True, slots=True)
class Levels:
    """What the learner says of itself: the stage's gain, offset in V, rms error in % of the span, validity."""

    gain: float
    offset_V: float
    error_pct: float
    valid: bool

    @staticmethod
    def of(told: Mapping[str, Any]) -> Levels | None:
        """From a learner's diagnostics; None where it does not tell."""
        try:
            levels = Levels(
                float(told["gain"]),
                float(told["offset_V"]),
                float(told["recent_rms_error_pct"]),
                bool(told.get("valid", 1.0)),
            )
        except (KeyError, TypeError, ValueError):
            return None
        return levels if all(math.isfinite(v) for v in (levels.gain, levels.offset_V, levels.error_pct)) else None


class Alarm:
    """Raised once something has been out of its bounds for ``hold_s``. Explicit state, no clock: time is handed in."""

    def __init__(self, config: WatchConfig, span_V: float) -> None:
        self._config = config
        self._span_V = max(abs(span_V), 1e-12)
        self._normal: Levels | None = None
        self._since_s: float | None = None

    @property
    def armed(self) -> bool:
        """Whether it knows what is normal."""
        return self._normal is not None

    def arm(self, levels: Levels | None) -> None:
        """Take ``levels`` for normal; None disarms."""
        self._normal, self._since_s = levels, None

    def check(self, t_s: float, now: Levels) -> str:
        """Why there is an alarm at ``t_s``, or an empty text."""
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
