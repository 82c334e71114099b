"""``soak.json``: what is in it, how it is written, and its verdict in one line."""

from __future__ import annotations

import csv
import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from adaptive.types import FloatArray
from lab.soak.verdict.invariant import Invariant
from lab.soak.verdict.ledger import Happened, Ledger, Probe
from lab.soak.verdict.memory import memory_slopes
from lab.soak.verdict.track import Second
from service.storage.atomic_write import atomic_write

#: Verdicts of a run that is over, and of one that goes on.
HELD, BROKEN = "held", "broken"
RUNNING, BROKEN_SO_FAR = "running", "broken so far"


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
    """Write ``soak.json`` atomically."""
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    with atomic_write(path) as file:
        file.write(text.encode())


# --- ``seconds.csv`` of a soak: what was seen in each second, to look up what a verdict or a picture only hints at.


#: Name of the file.
SECONDS: Final = "seconds.csv"
#: ``calm``: no fault was on, and none had yet to be recovered from. ``held``: samples without their voltage in time.
#: Empty: nothing was seen.
COLUMNS: Final = (
    "t_s", "calm", "fault", "samples", "held", "error_mean_pct", "error_max_pct", "answers", "failed", "unsafe",
    "query_p50_us", "query_max_us", "echo_p50_us", "echo_max_us", "silent_s", "snapshot_age_max_s", "bare_late_s",
    "others_share",
)  # fmt: skip

T = TypeVar("T")


def write_seconds(path: Path, ledger: Ledger) -> None:
    """Write a row for every second of the run. What is told at the end of a second is in the row of that end.

    Raises OSError.
    """
    seconds = _by_second(ledger.seconds, lambda second: second.t_s)
    probes = _by_second(ledger.probes, lambda probe: probe.t_s)
    bare, others = (_by_second(rows, lambda row: row[0]) for rows in (ledger.bare, ledger.others))
    faults = _faults_by_second(ledger)
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(COLUMNS)
        for k in range(math.ceil(ledger.duration_s)):
            lines.writerow([
                k, int(ledger.quiet(float(k)) and ledger.quiet(k + 1.0)), " ".join(faults[k]),
                *_of_stage(seconds.get(k, ()), ledger.range_um), *_of_prober(probes.get(k, ())),
                *(_number(max((row[1] for row in rows.get(k, ())), default=math.nan), 5) for rows in (bare, others)),
            ])  # fmt: skip


def _faults_by_second(ledger: Ledger) -> defaultdict[int, list[str]]:
    """Kinds of the faults that were on in each whole second; one that has not ended is on until the end of the run."""
    on: defaultdict[int, list[str]] = defaultdict(list)
    for fault in ledger.faults:
        end_s = fault.end_s if fault.ended else ledger.duration_s
        for k in range(math.floor(fault.begin_s), math.floor(end_s) + 1):
            on[k].append(fault.kind)
    return on


def _of_stage(rows: Sequence[Second], range_um: float) -> list[object]:
    judged, share = sum(row.judged for row in rows), 100.0 / range_um
    return [
        sum(row.samples for row in rows),
        sum(row.held for row in rows),
        _number(share * sum(row.error_sum_um for row in rows) / judged if judged else math.nan, 4),
        _number(share * max(row.error_max_um for row in rows) if judged else math.nan, 4),
    ]


def _of_prober(rows: Sequence[Probe]) -> list[object]:
    if not rows:
        return [""] * 9
    service, echo, ages_s = (
        np.concatenate([np.asarray(getattr(row, name), dtype=np.float64) for row in rows])
        for name in ("service_us", "echo_us", "ages_s")
    )
    trips = [_number(float(of(us)) if us.size else math.nan, 0) for us in (service, echo) for of in (np.median, np.max)]
    return [
        service.size, sum(row.failed for row in rows), sum(row.unsafe for row in rows), *trips,
        _number(max(row.silent_s for row in rows), 4), _number(float(ages_s.max()) if ages_s.size else math.nan, 4),
    ]  # fmt: skip


def _by_second(rows: Iterable[T], at: Callable[[T], float]) -> dict[int, list[T]]:
    """By the whole second in which they were told."""
    return {k: list(those) for k, those in groupby(sorted(rows, key=at), lambda row: math.floor(at(row)))}


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
