"""One soak: identify the stage, run the plan, judge the observations, draw, and write the files."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.soak.fault_plan import SoakPlan
from lab.soak.live import Say, run_live, withheld
from lab.soak.rig import identify, stage_config
from lab.soak.verdict.interim import InterimJudge
from lab.soak.verdict.invariants import TRACKING_PCT, judge, recorded
from lab.soak.verdict.observations import FAST, REAL_TIME, RESTART_GAP, Intervals, Observations, assess_recovery
from lab.soak.verdict.outcome import SECONDS, report, soak_summary, write_seconds, write_summary
from service.storage.output_folder import clear_output

#: Files and folders of a run. Those of an older run are removed first; other files stay.
OURS = ("soak.json", "report.md", "plan.json", SECONDS, "error.png", "latency.png", "memory.png",
        "soak.rrd", "model.npz", "a", "b", "logs")  # fmt: skip
#: Limit of the error for a stage from a file, as a multiple of the error before the first fault.
OWN_STAGE_RATIO = 2.0
#: Records that wait to be written when the disk is full, or to be sent when the router dies, are lost too, s. Seconds
#: are identified by their beginning.
WAITING_S = 1.0
#: Longest gap between two seconds with samples, s.
_BEFORE_S = 30.0


@dataclass(frozen=True, slots=True)
class Done:
    """A finished soak: the content of ``soak.json``, and whether the run was ended early."""

    found: dict[str, Any]
    interrupted: bool


def run(
    out: Path, plan: SoakPlan, *, fast: bool, stage_file: Path | None, stopped: Callable[[], bool], say: Say
) -> Done:
    """Run the plan and write the results into ``out``. ``stage_file``: a stage in place of the default one.

    Raises InputError on a folder or a stage that cannot be used, ServiceError if a process does not start.
    """
    clear_output(out, OURS)
    (out / "logs").mkdir()
    stage = stage_config(stage_file, plan.seed)
    say(f"[1/3] identifying stage {stage.name!r} from 10 s of the chapter's signal")
    control = identify(stage, out / "model.npz", plan.seed)
    where = "in one process, as fast as it goes" if fast else "in real time, in processes over zenoh"
    say(f"[2/3] {plan.duration_s:g} s with {len(plan.faults)} faults, {where}")
    if plan.left_out:
        say(f"      no time for: {', '.join(plan.left_out)}")
    observed = Observations(0.0, control.range_um, control.slew_V_per_s * control.dt_s, FAST if fast else REAL_TIME)
    observed.planned = len(plan.faults)
    # For a stage from a file the limit is known only when the first fault begins; it is judged at the end.
    interim = InterimJudge(observed, out / "soak.json", say, TRACKING_PCT if stage_file is None else None)
    missing: int | None = None
    if fast:
        from lab.soak.fast import run_fast

        samples = run_fast(out, stage, control, plan, observed, interim, stopped, say)
    else:
        monitor = run_live(out, stage, control, plan, observed, interim, stopped, say)
        missing, samples = _kept(out, observed, monitor.track.seen, monitor.track.received)
        samples |= {"withheld_by_faults": withheld(monitor.stage)}
        samples |= {"without_their_voltage_in_time": sum(s.held for s in observed.seconds)}
    say("[3/3] judging and drawing")
    assess_recovery(observed)
    invariants = judge(observed, missing, **_tracking_limit(observed, stage_file))
    found = soak_summary(observed, invariants, samples)
    observed.notes += _machine(observed)
    interrupted = observed.duration_s < plan.duration_s - 1.0
    write_summary(out / "soak.json", found)
    write_seconds(out / SECONDS, observed)
    pictures = _draw(out, observed)
    text = report(found, observed, plan, pictures, interrupted)
    (out / "report.md").write_text(text, encoding="utf-8")
    happened = [
        {"kind": f.kind, "begin_s": f.begin_s, "end_s": f.end_s, "recovered_s": f.recovered_s, "silent_s": f.silent_s,
         "told": f.reported_by, "value": f.value}
        for f in observed.faults
    ]  # fmt: skip
    kept = {"seed": plan.seed, "duration_s": plan.duration_s, "left_out": plan.left_out, "faults": happened}
    (out / "plan.json").write_text(json.dumps({**kept, "events": observed.events}, indent=1) + "\n", encoding="utf-8")
    return Done(found, interrupted)


def _tracking_limit(observed: Observations, stage_file: Path | None) -> dict[str, float]:
    if stage_file is None:
        return {}
    first = observed.faults[0].begin_s if observed.faults else observed.duration_s
    calm = [s for s in observed.seconds if s.judged and 2.0 <= s.t_s < first]
    if not calm:
        return {}
    # A second in which the stage held a voltage says something about the machine, not about the model.
    calm = [s for s in calm if not s.held] or calm
    mae_um = sum(s.error_sum_um for s in calm) / sum(s.judged for s in calm)
    return {"tracking_pct": OWN_STAGE_RATIO * 100.0 * mae_um / observed.range_um}


def _machine(observed: Observations) -> list[str]:
    """A sentence on how busy the machine was."""
    if not observed.loop_delays or not observed.other_load:
        return []
    late_ms = [1e3 * late_s for _, late_s in observed.loop_delays]
    share = [100.0 * share for _, share in observed.other_load]
    (usual, often), (late, later) = (_median_and_tenth(values) for values in (share, late_ms))
    return [
        f"the machine: others than the soak had {usual:.0f} % of the cores in the median second, {often:.0f} % in one "
        f"of ten; a bare loop was late by up to {late:.1f} ms and {later:.1f} ms"
    ]


def _median_and_tenth(values: list[float]) -> tuple[float, float]:
    ordered = sorted(values)
    return ordered[len(ordered) // 2], ordered[len(ordered) * 9 // 10]


def _kept(out: Path, observed: Observations, seen: Intervals, received: int) -> tuple[int, dict[str, int]]:
    """Number of samples that the monitor saw and no service recorded though it could, and all counts of samples."""
    # A standby records too, in a folder of its own.
    folders = [out / name / folder for name in ("a", "b") for folder in ("recording", "recording-standby")]
    found, rows = recorded(folders)
    nowhere = Intervals()
    for start, stop in seen.minus(found):
        nowhere.add(start, stop)
    missing = sum(stop - start for start, stop in nowhere.minus(unrecordable(observed)))
    return missing, {
        "seen": len(seen),
        "received_by_monitor": received,
        "recorded": len(found),
        "rows_recorded": rows,
        "in_no_recording": len(nowhere),
        "in_no_recording_and_no_fault_on": missing,
    }


def unrecordable(observed: Observations) -> Intervals:
    """Samples that the services could not record though the monitor saw them: while no file may grow, and while the
    router is gone. The services count both cases themselves."""
    excused = Intervals()
    for fault in observed.faults:
        begin, end = fault.window_s
        if fault.kind not in ("disk_full", "restart_router"):
            continue
        # Begin earlier: the samples of a second begin where the second before ended.
        around = observed.seconds_between(begin - _BEFORE_S, end)
        for last, second in itertools.pairwise(around):
            if begin - WAITING_S - 1.0 <= second.t_s <= end and second.samples:
                # Some sample numbers may be missing, also at the beginning of a second.
                follows = 0 < second.seq - last.seq < RESTART_GAP
                excused.add(last.seq + 1 if follows else second.seq - second.samples + 1, second.seq + 1)
    return excused


def _draw(out: Path, observed: Observations) -> list[str]:
    from lab.soak.verdict.pictures import draw_error, draw_latency, draw_memory

    drawn = []
    for name, draw, there in (
        ("error.png", draw_error, bool(observed.seconds)),
        ("latency.png", draw_latency, bool(observed.query_seconds)),
        ("memory.png", draw_memory, bool(observed.memory)),
    ):
        if there:
            draw(out / name, observed)
            drawn.append(name)
    return drawn
