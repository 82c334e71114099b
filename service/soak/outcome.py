"""``soak.json``: what is in it, how it is written, and its verdict in one line."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive.types import FloatArray
from service.soak.invariant import Invariant
from service.soak.ledger import Happened, Ledger
from service.soak.memory import memory_slopes

#: Verdicts of a run that is over, and of one that goes on.
HELD, BROKEN = "held", "broken"
RUNNING, BROKEN_SO_FAR = "running", "broken so far"
#: Appended to the name of a file that is not whole yet.
PART: Final = ".part"


def summary(
    ledger: Ledger, invariants: Mapping[str, Invariant], samples: Mapping[str, int], *, over: bool = True
) -> dict[str, Any]:
    """The content of ``soak.json``; ``over``: whether the run is."""
    broken = any(i.held is False for i in invariants.values())
    service, echo = ledger.latency_us("service"), ledger.latency_us("echo")

    def at(values: FloatArray, percent: float) -> float | None:
        return round(float(np.percentile(values, percent)), 1) if values.size else None

    trends = memory_slopes(ledger)
    return {
        "verdict": (BROKEN if broken else HELD) if over else (BROKEN_SO_FAR if broken else RUNNING),
        "not_judged": [name for name, invariant in invariants.items() if invariant.held is None],
        "duration_s": round(ledger.duration_s, 1),
        "faults": of_kinds(ledger.faults),
        "invariants": {name: invariant.as_dict() for name, invariant in invariants.items()},
        "latency": {
            "p50_us": at(service, 50),
            "p99_us": at(service, 99),
            "p999_us": at(service, 99.9),
            "echo_p50_us": at(echo, 50),
            "echo_p99_us": at(echo, 99),
        },
        "memory_slope_kb_per_hour": round(trends[0].slope, 1) if trends else None,
        "samples": dict(samples),
    }


def of_kinds(faults: Iterable[Happened]) -> dict[str, Any]:
    """By kind: how many faults, and how they ended."""
    kinds: dict[str, list[Happened]] = {}
    for fault in faults:
        kinds.setdefault(fault.kind, []).append(fault)
    return {kind: _of_kind(those) for kind, those in kinds.items()}


def _of_kind(faults: list[Happened]) -> dict[str, Any]:
    took = [f.recovered_s - (f.end_s if math.isfinite(f.end_s) else f.begin_s) for f in faults]
    return {
        "count": len(faults),
        "recovered": sum(1 for f in faults if math.isfinite(f.recovered_s)),
        "worst_recovery_s": _most([value for value in took if math.isfinite(value)]),
        "worst_silence_s": _most([f.silent_s for f in faults]),
        "told_by": sorted({f.told for f in faults if f.told}),
    }


def _most(values: list[float]) -> float | None:
    return round(max(values), 3) if values else None


def verdict_line(found: Mapping[str, Any]) -> str:
    """Such as ``held; not judged: memory (too short a run)``."""
    left = [f"{name} ({found['invariants'][name]['why']})" for name in found["not_judged"]]
    return str(found["verdict"]) + (f"; not judged: {', '.join(left)}" if left else "")


def write_found(path: Path, found: Mapping[str, Any]) -> None:
    """Write ``soak.json`` whole or not at all: whoever reads it never sees half of it."""
    part = path.with_name(path.name + PART)
    part.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)
