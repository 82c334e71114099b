"""How long the service took over its queries: the last thousand, and counts since the start."""

from __future__ import annotations

from typing import Final

import numpy as np

_KEPT: Final = 1024


class LatencyMeter:
    """Keeps the last durations; one thread adds, others may read."""

    def __init__(self) -> None:
        self._us = np.zeros(_KEPT)
        self.count = 0
        self.errors = 0

    def add(self, duration_s: float, failed: bool = False) -> None:
        """Count one query that took ``duration_s`` in the service, wire not included."""
        self._us[self.count % _KEPT] = duration_s * 1e6
        self.count += 1
        self.errors += failed

    def summary(self) -> dict[str, float | int | None]:
        """``count``, ``errors``, and of the last thousand ``p50_us`` and ``p99_us``; null before the first."""
        known = self._us[: min(self.count, _KEPT)].copy()
        p50, p99 = np.percentile(known, (50, 99)).tolist() if known.size else (None, None)
        return {
            "count": self.count,
            "errors": self.errors,
            "p50_us": None if p50 is None else round(p50, 1),
            "p99_us": None if p99 is None else round(p99, 1),
        }
