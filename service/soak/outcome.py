"""``soak.json``, and the slope of the memory that it tells."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from adaptive.types import FloatArray
from service.soak.invariant import Invariant
from service.soak.ledger import Happened, Ledger

#: Before this the memory of a process is not judged, and a process that lived shorter after it neither, s.
MEMORY_WARM_S: Final = 180.0
MEMORY_LEAST_S: Final = 300.0
_FLOOR_S: Final = 60.0


def memory_slope(ledger: Ledger) -> float | None:
    """kB per hour of the serving process that lived longest after its warm-up; None where none lived long enough."""
    best: tuple[float, float] | None = None
    for name in ("a", "b", "service"):
        rows = ledger.memory.get(name, [])
        for pid in {row[2] for row in rows}:
            t = np.array([row[0] for row in rows if row[2] == pid])
            kb = np.array([row[1] for row in rows if row[2] == pid])
            after = t >= t[0] + MEMORY_WARM_S
            if not after.any() or np.ptp(t[after]) < MEMORY_LEAST_S:
                continue
            lived = float(np.ptp(t[after]))
            if best is None or lived > best[0]:
                best = lived, 3600.0 * _slope(*_floor(t[after], kb[after]))
    return None if best is None else best[1]


def _floor(t_s: FloatArray, kb: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The least of every minute, and when it was: what is in use for a moment (a state that is handed over, a
    checkpoint) is given back within a minute, and is no growth."""
    minute = ((t_s - t_s[0]) // _FLOOR_S).astype(np.int64)
    at = [int(np.argmin(np.where(minute == m, kb, np.inf))) for m in range(int(minute[-1]) + 1) if np.any(minute == m)]
    return t_s[at], kb[at]


def _slope(t_s: FloatArray, values: FloatArray) -> float:
    """Median of the slopes between the two halves (Theil and Sen's, each point with the one half a run later)."""
    half = len(t_s) // 2
    return float(np.median((values[half : 2 * half] - values[:half]) / (t_s[half : 2 * half] - t_s[:half])))


def summary(ledger: Ledger, invariants: Mapping[str, Invariant], samples: dict[str, int]) -> dict[str, Any]:
    """The content of ``soak.json``."""
    service, echo = ledger.latency_us("service"), ledger.latency_us("echo")

    def at(values: FloatArray, percent: float) -> float | None:
        return round(float(np.percentile(values, percent)), 1) if values.size else None

    slope = memory_slope(ledger)
    return {
        "verdict": "broken" if any(i.held is False for i in invariants.values()) else "held",
        "duration_s": round(ledger.duration_s, 1),
        "faults": {kind: _of_kind([f for f in ledger.faults if f.kind == kind]) for kind in _kinds(ledger)},
        "invariants": {name: invariant.as_dict() for name, invariant in invariants.items()},
        "latency": {
            "p50_us": at(service, 50),
            "p99_us": at(service, 99),
            "p999_us": at(service, 99.9),
            "echo_p50_us": at(echo, 50),
            "echo_p99_us": at(echo, 99),
        },
        "memory_slope_kb_per_hour": None if slope is None else round(slope, 1),
        "samples": samples,
    }


def _kinds(ledger: Ledger) -> list[str]:
    return list(dict.fromkeys(f.kind for f in ledger.faults))


def _of_kind(faults: list[Happened]) -> dict[str, Any]:
    pick: Callable[[list[float]], float | None] = lambda values: round(max(values), 3) if values else None  # noqa: E731
    took = [f.recovered_s - (f.end_s if math.isfinite(f.end_s) else f.begin_s) for f in faults]
    return {
        "count": len(faults),
        "recovered": sum(1 for f in faults if math.isfinite(f.recovered_s)),
        "worst_recovery_s": pick([value for value in took if math.isfinite(value)]),
        "worst_silence_s": pick([f.silent_s for f in faults]),
        "told_by": sorted({f.told for f in faults if f.told}),
    }
