"""``seconds.csv`` of a soak: what was seen in each second, to look up what a verdict or a picture only hints at."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from service.soak.ledger import Ledger, Probe
from service.soak.track import Second

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
