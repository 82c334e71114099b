"""The files of a soak: ``soak.json`` with the verdict, ``report.md`` and ``soak.png``."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dehyst.lab.soak.fault_plan import FAULT_KINDS, MACHINE, PROCESS, STAGE, SoakPlan
from dehyst.lab.soak.judge import TRACKING_PCT, Invariant, memory_in_use
from dehyst.lab.soak.observed import FaultRecord, Observations
from dehyst.service.reports.plot_style import figure, save
from dehyst.service.reports.tables import markdown
from dehyst.service.storage.output import atomic_write
from dehyst.service.viewer.colours import ADAPTIVE, EVENT, LIMIT, SERIES, TROUBLE

HELD, BROKEN = "held", "broken"


def soak_summary(
    observed: Observations, invariants: Mapping[str, Invariant], samples: Mapping[str, int]
) -> dict[str, Any]:
    """The content of ``soak.json``."""
    calm = observed.calm()
    trips = [np.asarray(p.trips_us) for p in observed.probes if calm(p.t_s)]
    trips_us = np.concatenate(trips) if trips else np.zeros(0)
    kinds = dict.fromkeys(fault.kind for fault in observed.faults)
    return {
        "verdict": BROKEN if any(i.held is False for i in invariants.values()) else HELD,
        "not_judged": [name for name, invariant in invariants.items() if invariant.held is None],
        "duration_s": round(observed.duration_s, 1),
        "faults": {kind: _of_kind([f for f in observed.faults if f.kind == kind]) for kind in kinds},
        "invariants": {name: invariant.as_dict() for name, invariant in invariants.items()},
        "latency": {
            name: round(float(np.percentile(trips_us, percent)), 1) if trips_us.size else None
            for name, percent in (("p50_us", 50), ("p99_us", 99), ("p999_us", 99.9))
        },
        "samples": dict(samples),
    }


def _of_kind(faults: Sequence[FaultRecord]) -> dict[str, Any]:
    """How many faults of a kind there were, and how they ended."""
    took = [f.recovered_s - (f.end_s if math.isfinite(f.end_s) else f.begin_s) for f in faults]
    return {
        "count": len(faults),
        "recovered": sum(math.isfinite(value) for value in took),
        "worst_recovery_s": _most(took),
        "worst_silence_s": _most(f.silent_s for f in faults),
        "told_by": sorted({f.told for f in faults if f.told}),
        "worst_error_pct": _most(f.error_pct for f in faults),
        "worst_named_s": _most(f.named_s for f in faults),
        "breaches": [breach for f in faults for breach in f.breaches][:20],
        "unjudged": [part for f in faults for part in f.unjudged][:20],
    }


def _most(values: Iterable[float]) -> float | None:
    return round(max(known), 3) if (known := [value for value in values if math.isfinite(value)]) else None


def verdict_line(found: Mapping[str, Any]) -> str:
    """The verdict in one line, such as ``held; not judged: memory (too short a run)``."""
    left = [f"{name} ({found['invariants'][name]['why']})" for name in found["not_judged"]]
    return str(found["verdict"]) + (f"; not judged: {', '.join(left)}" if left else "")


def write_summary(path: Path, found: Mapping[str, Any]) -> None:
    """Write ``soak.json`` atomically."""
    with atomic_write(path) as file:
        file.write((json.dumps(found, indent=1, allow_nan=False) + "\n").encode())


# --- report.md


def report(found: Mapping[str, Any], observed: Observations, plan: SoakPlan, interrupted: bool) -> str:
    """The report, from the content of ``soak.json`` and the observations."""
    lines = [
        f"# Soak: {verdict_line(found)}", "",
        f"{found['duration_s']:g} s of {plan.duration_s:g} s; seed {plan.seed}; {len(observed.faults)} of "
        f"{len(plan.faults)} planned faults." + (" Interrupted: this is what ran." if interrupted else ""),
        *(["", f"No time was left for: {', '.join(plan.left_out)}."] if plan.left_out else []),
        "", *(f"- {note}" for note in dict.fromkeys(observed.notes)), "", "## What must hold", "",
    ]  # fmt: skip
    said = {True: "yes", False: "**no**", None: "not judged"}
    rows = [
        (name, said[row["held"]], _digits(row["worst"], ".4g"), f"{row['limit']:.4g} {row['unit']}", row["text"])
        for name, row in found["invariants"].items()
    ]
    lines += [markdown(("invariant", "held", "worst", "limit", ""), rows), "", "## Faults", ""]
    head = ("fault", "", "how often", "well again after, s", "allowed", "silence, s", "error, %", "named after, s",
            "told by")  # fmt: skip
    rows = [
        (
            kind, FAULT_KINDS[kind].what, str(row["count"]),
            _digits(row["worst_recovery_s"]) if row["recovered"] == row["count"] else "never",
            f"{FAULT_KINDS[kind].recover_s:g}",
            *(_digits(row[name]) for name in ("worst_silence_s", "worst_error_pct", "worst_named_s")),
            "nobody is to" if row["told_by"] == ["-"] else ", ".join(row["told_by"]) or "**nobody**",
        )
        for kind, row in found["faults"].items()
    ]  # fmt: skip
    lines.append(markdown(head, rows))
    for kind, row in found["faults"].items():
        lines += [f"- **{kind}: {breach}**" for breach in row["breaches"]]
        lines += [f"- {kind}, not judged: {part}" for part in row["unjudged"]]
    for end_s, name in observed.ended:
        lines += ["", f"**{name} ended by itself at {end_s:.1f} s**; see `logs/`."]
    if found["latency"]["p50_us"] is not None:
        p50, p99, p999 = found["latency"].values()
        lines += ["", f"A point without a fault: median {p50:.0f} µs, 99 % within {p99:.0f}, 99.9 % within {p999:.0f}."]
    lines += ["", "Samples: " + ", ".join(f"{name} {value}" for name, value in found["samples"].items()) + ".", ""]
    return "\n".join([*lines, "![soak.png](soak.png)"]) + "\n"


def _digits(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else f"{value:{form}}"


# --- soak.png

#: Colours of faults by the place where they happen, and of faults of the reference.
_PLACES = {PROCESS: EVENT, STAGE: SERIES[0], MACHINE: TROUBLE}
_MAX_LABELS = 60


def draw(path: Path, observed: Observations) -> None:
    """Error of every second, times without an answer, and memory in use, every fault marked."""
    drawn, axes = figure(3, 1, (13.0, 9.0), sharex=True, height_ratios=(2.0, 1.2, 1.0))
    error, times, memory = panels = axes[:, 0]
    seconds, percent = observed.seconds, 100.0 / observed.range_um
    t_s = [s.t_s for s in seconds]
    at_most = [max(s.error_max_um * percent, 1e-4) if s.judged else math.nan for s in seconds]
    error.semilogy(t_s, at_most, color=SERIES[3], lw=0.9, label="largest of the second")
    error.semilogy(t_s, [s.mae_um * percent for s in seconds], color=ADAPTIVE, lw=1.3, label="mean of the second")
    error.axhline(TRACKING_PCT, color="black", lw=0.8, ls="--")
    error.set_ylabel("|wanted - read|,\n% of range")
    asked = [p for p in observed.probes if len(p.trips_us)]
    medians = [1e-6 * float(np.median(p.trips_us)) for p in asked]
    times.semilogy([p.t_s for p in asked], medians, color=ADAPTIVE, lw=1.2, label="median of a query")
    silent = [max(p.silent_s, 1e-3) for p in observed.probes]
    times.semilogy([p.t_s for p in observed.probes], silent, color=EVENT, lw=1.0, label="longest without an answer")
    times.set_ylabel("s")
    for i, (name, (at_s, mb)) in enumerate(memory_in_use(observed).items()):
        memory.plot(at_s, mb, color=SERIES[i % len(SERIES)], lw=1.2, label=name)
    memory.set_ylabel("memory in use, MB")
    memory.set_xlabel("time, s (marked: faults; red: processes, blue: samples, pink: machine, grey: reference)")
    for panel in panels:
        panel.set_xlim(0.0, max(observed.duration_s, 1.0))
        for fault in observed.faults:
            well = fault.recovered_s if math.isfinite(fault.recovered_s) else fault.window_s[1]
            colour = _PLACES.get(FAULT_KINDS[fault.kind].where, LIMIT)
            panel.axvspan(fault.begin_s, well, color=colour, alpha=0.12, lw=0)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8, loc="upper right")
    for fault in observed.faults[:_MAX_LABELS]:
        place = (fault.begin_s, 1.01)
        error.annotate(fault.kind, place, xycoords=("data", "axes fraction"), rotation=60, fontsize=7, va="bottom")
    save(drawn, path)
