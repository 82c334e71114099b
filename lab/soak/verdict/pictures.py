"""The pictures of a soak: error, memory and latency over time, every fault marked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lab.soak.fault_plan import FAULT_KINDS, MACHINE, PROCESS, STAGE
from lab.soak.verdict.invariants import TRACKING_PCT, warm_up_s
from lab.soak.verdict.observations import Observations, Target
from service.reports.plot_style import figure, save
from service.viewer.colours import ADAPTIVE, EVENT, LIMIT, SERIES, TROUBLE

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
