"""The files of a soak: ``soak.json`` with the verdict, ``seconds.csv``, ``report.md``, and the pictures."""

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
from lab.soak.fault_plan import FAULT_KINDS, MACHINE, PROCESS, STAGE, SoakPlan
from lab.soak.verdict.invariants import TRACKING_PCT, Invariant, memory_slopes, warm_up_s
from lab.soak.verdict.observations import REAL_TIME, FaultRecord, Observations, QuerySecond, SampleSecond, Target
from service.reports.plot_style import figure, save
from service.storage.output import atomic_write
from service.viewer.colours import ADAPTIVE, EVENT, LIMIT, SERIES, TROUBLE

# --- The files of a soak: ``soak.json`` with the verdict, ``seconds.csv``, and ``report.md``.

#: Verdicts of a finished run, and of one that goes on.
HELD, BROKEN = "held", "broken"
RUNNING, BROKEN_SO_FAR = "running", "broken so far"


def soak_summary(
    observed: Observations, invariants: Mapping[str, Invariant], samples: Mapping[str, int], *, over: bool = True
) -> dict[str, Any]:
    """The content of ``soak.json``; ``over``: whether the run has ended."""
    broken = any(i.held is False for i in invariants.values())
    service, echo = observed.latency_us("service"), observed.latency_us("echo")

    def at(values: FloatArray, percent: float) -> float | None:
        return round(float(np.percentile(values, percent)), 1) if values.size else None

    trends = memory_slopes(observed)
    return {
        "verdict": (BROKEN if broken else HELD) if over else (BROKEN_SO_FAR if broken else RUNNING),
        "not_judged": [name for name, invariant in invariants.items() if invariant.held is None],
        "duration_s": round(observed.duration_s, 1),
        "faults": of_kinds(observed.faults),
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


def of_kinds(faults: Iterable[FaultRecord]) -> dict[str, Any]:
    """By kind: how many faults there were, and how they ended."""
    kinds: dict[str, list[FaultRecord]] = {}
    for fault in faults:
        kinds.setdefault(fault.kind, []).append(fault)
    return {kind: _of_kind(those) for kind, those in kinds.items()}


def _of_kind(faults: list[FaultRecord]) -> dict[str, Any]:
    took = [f.recovered_s - (f.end_s if math.isfinite(f.end_s) else f.begin_s) for f in faults]
    return {
        "count": len(faults),
        "recovered": sum(1 for f in faults if math.isfinite(f.recovered_s)),
        "worst_recovery_s": _most([value for value in took if math.isfinite(value)]),
        "worst_silence_s": _most([f.silent_s for f in faults]),
        "told_by": sorted({f.reported_by for f in faults if f.reported_by}),
        "worst_error_pct": _most([f.error_pct for f in faults if math.isfinite(f.error_pct)]),
        "worst_named_s": _most([f.named_s for f in faults if math.isfinite(f.named_s)]),
        "breaches": [breach for f in faults for breach in f.breaches][:20],
        "unjudged": [part for f in faults for part in f.unjudged][:20],
    }


def _most(values: list[float]) -> float | None:
    return round(max(values), 3) if values else None


def verdict_line(found: Mapping[str, Any]) -> str:
    """The verdict in one line, such as ``held; not judged: memory (too short a run)``."""
    left = [f"{name} ({found['invariants'][name]['why']})" for name in found["not_judged"]]
    return str(found["verdict"]) + (f"; not judged: {', '.join(left)}" if left else "")


def write_summary(path: Path, found: Mapping[str, Any]) -> None:
    """Write ``soak.json`` atomically."""
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    with atomic_write(path) as file:
        file.write(text.encode())


# --- seconds.csv

#: Name of the file.
SECONDS: Final = "seconds.csv"
#: ``calm``: no fault and no recovery. ``held``: samples without their voltage in time. Empty: not observed.
COLUMNS: Final = (
    "t_s", "calm", "fault", "samples", "held", "error_mean_pct", "error_max_pct", "answers", "failed", "unsafe",
    "query_p50_us", "query_max_us", "echo_p50_us", "echo_max_us", "silent_s", "snapshot_age_max_s", "bare_late_s",
    "others_share",
)  # fmt: skip

T = TypeVar("T")


def write_seconds(path: Path, observed: Observations) -> None:
    """Write a row for every second of the run. A value that is measured at the end of a second is in that second's
    row.

    Raises OSError.
    """
    seconds = _by_second(observed.seconds, lambda second: second.t_s)
    probes = _by_second(observed.query_seconds, lambda probe: probe.t_s)
    bare, others = (_by_second(rows, lambda row: row[0]) for rows in (observed.loop_delays, observed.other_load))
    faults = _faults_by_second(observed)
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(COLUMNS)
        for k in range(math.ceil(observed.duration_s)):
            lines.writerow([
                k, int(observed.quiet(float(k)) and observed.quiet(k + 1.0)), " ".join(faults[k]),
                *_of_stage(seconds.get(k, ()), observed.range_um), *_of_prober(probes.get(k, ())),
                *(_number(max((row[1] for row in rows.get(k, ())), default=math.nan), 5) for rows in (bare, others)),
            ])  # fmt: skip


def _faults_by_second(observed: Observations) -> defaultdict[int, list[str]]:
    """Kinds of the faults in each whole second. A fault that has not ended lasts until the end of the run."""
    on: defaultdict[int, list[str]] = defaultdict(list)
    for fault in observed.faults:
        end_s = fault.end_s if fault.ended else observed.duration_s
        for k in range(math.floor(fault.begin_s), math.floor(end_s) + 1):
            on[k].append(fault.kind)
    return on


def _of_stage(rows: Sequence[SampleSecond], range_um: float) -> list[object]:
    judged, share = sum(row.judged for row in rows), 100.0 / range_um
    return [
        sum(row.samples for row in rows),
        sum(row.held for row in rows),
        _number(share * sum(row.error_sum_um for row in rows) / judged if judged else math.nan, 4),
        _number(share * max(row.error_max_um for row in rows) if judged else math.nan, 4),
    ]


def _of_prober(rows: Sequence[QuerySecond]) -> list[object]:
    if not rows:
        return [""] * 9
    service, echo, ages_s = (
        np.concatenate([np.asarray(values, dtype=np.float64) for values in columns])
        for columns in ([r.service_us for r in rows], [r.echo_us for r in rows], [r.ages_s for r in rows])
    )
    trips = [_number(float(of(us)) if us.size else math.nan, 0) for us in (service, echo) for of in (np.median, np.max)]
    return [
        service.size, sum(row.failed for row in rows), sum(row.unsafe for row in rows), *trips,
        _number(max(row.silent_s for row in rows), 4), _number(float(ages_s.max()) if ages_s.size else math.nan, 4),
    ]  # fmt: skip


def _by_second(rows: Iterable[T], at: Callable[[T], float]) -> dict[int, list[T]]:
    """Rows by the whole second of their time."""
    return {k: list(those) for k, those in groupby(sorted(rows, key=at), lambda row: math.floor(at(row)))}


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


# --- report.md


def report(
    found: dict[str, Any], observed: Observations, plan: SoakPlan, pictures: list[str], interrupted: bool
) -> str:
    """The report, from the content of ``soak.json`` and the observations."""
    lines = [f"# Soak: {verdict_line(found)}", ""]
    how = "in real time, in processes" if observed.mode == REAL_TIME else "in one process, as fast as it goes"
    lines.append(
        f"{found['duration_s']:g} s of {plan.duration_s:g} s {how}; seed {plan.seed}; {len(observed.faults)} of "
        f"{len(plan.faults)} planned faults." + (" Interrupted: this is what ran." if interrupted else "")
    )
    if plan.left_out:
        lines += ["", f"No time was left for: {', '.join(plan.left_out)}."]
    lines += ["", *(f"- {note}" for note in dict.fromkeys(observed.notes))]
    lines += ["", "## What must hold", "", "| invariant | held | worst | limit | |", "|---|---|---|---|---|"]
    for name, row in found["invariants"].items():
        worst = "-" if row["worst"] is None else f"{row['worst']:.4g}"
        held = {True: "yes", False: "**no**", None: "not judged"}[row["held"]]
        lines.append(f"| {name} | {held} | {worst} | {row['limit']:.4g} {row['unit']} | {row['text']} |")
    lines += ["", "## Faults", ""]
    lines += [
        "| fault | | how often | well again after, s | allowed | silence, s | error, % | named after, s | told by |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind, row in found["faults"].items():
        recovery = "never" if row["recovered"] < row["count"] else _two_digits(row["worst_recovery_s"])
        told = (
            ", ".join(row["told_by"]).replace("-", "nobody is to", 1)
            if row["told_by"] == ["-"]
            else ", ".join(row["told_by"])
        )
        lines.append(
            f"| {kind} | {FAULT_KINDS[kind].what} | {row['count']} | {recovery} | {FAULT_KINDS[kind].recover_s:g} | "
            f"{_two_digits(row['worst_silence_s'])} | {_two_digits(row['worst_error_pct'])} | "
            f"{_two_digits(row['worst_named_s'])} | {told or '**nobody**'} |"
        )
    for kind, row in found["faults"].items():
        lines += [f"- **{kind}: {breach}**" for breach in row["breaches"]]
        lines += [f"- {kind}, not judged: {part}" for part in row["unjudged"]]
    for end_s, name in observed.ended:
        lines += ["", f"**{name} ended by itself at {end_s:.1f} s**; see `logs/`."]
    latency = found["latency"]
    if latency["p50_us"] is not None and latency["echo_p50_us"]:
        ratios = [latency[q] / latency[f"echo_{q}"] for q in ("p50_us", "p99_us")]
        lines += [
            "", "## Latency outside fault windows", "",
            f"A point: median {latency['p50_us']:.0f} µs, 99 % within {latency['p99_us']:.0f} µs, 99.9 % within "
            f"{latency['p999_us']:.0f} µs. A bare echo of as many bytes through the same router, in turns with it: "
            f"median {latency['echo_p50_us']:.0f} µs, 99 % within {latency['echo_p99_us']:.0f} µs. That is "
            f"{ratios[0]:.2f} and {ratios[1]:.2f} times.",
        ]  # fmt: skip
    slope = found["memory_slope_kb_per_hour"]
    lines += ["", "## Memory", "", "Not judged." if slope is None else f"{slope:.0f} kB an hour."]
    samples = ", ".join(f"{name} {value}" for name, value in found["samples"].items())
    lines += ["", "## Samples", "", f"{samples}.", ""]
    lines += [f"Second by second in `{SECONDS}`.", ""]
    lines += [f"![{name}]({name})" for name in pictures]
    return "\n".join(lines) + "\n"


def _two_digits(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


# --- The pictures of a soak: error, memory and latency over time, every fault marked.

#: Colours of faults by the place where they happen, and of faults of the reference.
_PLACES = {PROCESS: EVENT, STAGE: SERIES[0], MACHINE: TROUBLE}
_OTHER_PLACE = LIMIT
_MAX_LABELS = 60


def draw_error(path: Path, observed: Observations) -> None:
    """Mean and largest |error| of every second in percent of the range, and the largest step of the voltage."""
    drawn, (top, bottom) = _canvas(2, (2.0, 1.0))
    t = np.array([s.t_s for s in observed.seconds])
    mean = 100.0 / observed.range_um * np.array([s.mae_um for s in observed.seconds])
    at_most = 100.0 / observed.range_um * np.array([s.error_max_um if s.judged else np.nan for s in observed.seconds])
    top.semilogy(t, np.maximum(at_most, 1e-4), color=SERIES[3], lw=0.9, label="largest of the second")
    top.semilogy(t, np.maximum(mean, 1e-4), color=ADAPTIVE, lw=1.3, label="mean of the second")
    top.axhline(TRACKING_PCT, color="black", lw=0.8, ls="--", label="limit of the mean outside fault windows")
    top.set_ylabel("|wanted - read|, % of range")
    bottom.plot(t, np.array([s.step_max_V for s in observed.seconds]) / observed.step_limit_V, color=SERIES[1], lw=1.0)
    bottom.axhline(1.0, color="black", lw=0.8, ls="--")
    bottom.set_ylabel("largest voltage step,\nshare of the slew limit")
    _finish(drawn, path, observed, (top, bottom))


def draw_latency(path: Path, observed: Observations) -> None:
    """Round trips of the prober's queries beside a bare echo's, and how long nobody answered."""
    drawn, (top, bottom) = _canvas(2, (2.0, 1.0))
    shown: tuple[tuple[Target, str, str], ...] = (
        ("service", ADAPTIVE, "query"),
        ("echo", SERIES[1], "bare echo"),
    )
    for which, colour, title in shown:
        trips = [(p.t_s, p.round_trips_us(which)) for p in observed.query_seconds]
        rows = [row for row in trips if len(row[1])]
        t = np.array([row[0] for row in rows])
        if not rows:
            continue
        p50, p99 = (np.array([np.percentile(values, q) for _, values in rows]) for q in (50, 99))
        top.semilogy(t, p50, color=colour, lw=1.2, label=f"{title}, median of the second")
        top.semilogy(t, p99, color=colour, lw=0.7, alpha=0.6, label=f"{title}, its 99 %")
    top.set_ylabel("round trip, µs")
    t = np.array([p.t_s for p in observed.query_seconds])
    silent_s = np.maximum([p.silent_s for p in observed.query_seconds], 1e-3)
    bottom.semilogy(t, silent_s, color=EVENT, lw=1.0, label="longest time without an answer")
    late = np.array(observed.loop_delays).reshape(-1, 2)
    if len(late):
        bottom.semilogy(late[:, 0], np.maximum(late[:, 1], 1e-5), color=LIMIT, lw=0.8, label="a bare loop's delay")
    bottom.set_ylabel("longest time without\nan answer, s")
    _finish(drawn, path, observed, (top, bottom))


def draw_memory(path: Path, observed: Observations) -> None:
    """Resident memory of every process, and the processor's time that each takes."""
    drawn, (top, bottom) = _canvas(2, (1.5, 1.0))
    for i, (name, rows) in enumerate(sorted(observed.memory.items())):
        t, mb = np.array([r[0] for r in rows]), np.array([r[1] for r in rows]) / 1024.0
        # A line ends where a process does.
        mb[np.flatnonzero(np.diff([r[2] for r in rows]) != 0)] = np.nan
        colour = SERIES[i % len(SERIES)]
        top.plot(t, mb, color=colour, lw=1.2, label=name)
        cpu = observed.cpu.get(name, [])
        used = np.diff([r[1] for r in cpu]) / np.maximum(np.diff([r[0] for r in cpu]), 1e-3)
        same = np.diff([r[2] for r in cpu]) == 0
        bottom.plot(np.array([r[0] for r in cpu])[1:], np.where(same, 100.0 * used, np.nan), color=colour, lw=0.8)
    top.axvline(warm_up_s(observed.duration_s), color="black", lw=0.6, ls=":")
    top.set_ylabel("resident memory, MB")
    bottom.set_ylabel("processor, % of a core")
    _finish(drawn, path, observed, (top, bottom))


def _canvas(rows: int, heights: tuple[float, ...]) -> tuple[Any, Any]:
    drawn, axes = figure(rows, 1, (13.0, 7.5), sharex=True, height_ratios=heights)
    return drawn, axes[:, 0]


def _finish(drawn: Any, path: Path, observed: Observations, panels: tuple[Any, ...]) -> None:
    end = max(observed.duration_s, 1.0)
    for panel in panels:
        panel.set_xlim(0.0, end)
        for fault in observed.faults:
            colour = _PLACES.get(FAULT_KINDS[fault.kind].where, _OTHER_PLACE)
            begin, well = fault.begin_s, fault.recovered_s
            panel.axvspan(begin, well if np.isfinite(well) else fault.window_s[1], color=colour, alpha=0.12, lw=0)
            panel.axvline(begin, color=colour, lw=0.7, alpha=0.8)
    if len(observed.faults) <= _MAX_LABELS:
        for fault in observed.faults:
            panels[0].annotate(
                fault.kind, (fault.begin_s, 1.01), xycoords=("data", "axes fraction"), rotation=60, fontsize=7,
                color=_PLACES.get(FAULT_KINDS[fault.kind].where, _OTHER_PLACE), ha="left", va="bottom",
            )  # fmt: skip
    panels[-1].set_xlabel(
        "time, s (marked: faults, until all was well again; "
        "red: processes, blue: samples, pink: machine, grey: reference)"
    )
    named = [pair for panel in panels for pair in zip(*panel.get_legend_handles_labels(), strict=True)]
    if named:
        handles, labels = zip(*named, strict=True)
        drawn.legend(handles, labels, fontsize=8, ncols=9, loc="outside lower center")
    save(drawn, path)
