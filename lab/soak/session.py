"""One soak: identify the stage, run the plan, judge the observations, draw, and write the files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from dehyst.lab.soak.fault_plan import SoakPlan
from dehyst.lab.soak.judge import assess, judge, recorded, unrecordable
from dehyst.lab.soak.live import Say, run_live
from dehyst.lab.soak.observed import Monitor, Observations
from dehyst.lab.soak.report import draw, report, soak_summary, write_summary
from dehyst.lab.soak.rig import SERVICES, identify
from dehyst.service.storage.output import clear_output
from dehyst.sim.stage.presets import preset

#: Files and folders of a run. Those of an older run are removed first; other files stay.
OURS: Final = ("soak.json", "report.md", "plan.json", "soak.png", "soak.rrd", "model.npz", "a", "b", "logs")


@dataclass(frozen=True, slots=True)
class Done:
    """A finished soak: the content of ``soak.json``, and whether the run was ended early."""

    found: dict[str, Any]
    interrupted: bool


def run(out: Path, plan: SoakPlan, *, stopped: Callable[[], bool], say: Say) -> Done:
    """Run the plan and write the results into ``out``.

    Raises InputError on a folder that cannot be used, ServiceError if a process does not start.
    """
    clear_output(out, OURS)
    (out / "logs").mkdir()
    stage = preset("rich", seed=plan.seed)
    say("[1/3] identifying the stage from 10 s of the chapter's signal")
    control = identify(stage, out / "model.npz", plan.seed)
    say(f"[2/3] {plan.duration_s:g} s with {len(plan.faults)} faults, in real time, in processes over zenoh")
    if plan.left_out:
        say(f"      no time for: {', '.join(plan.left_out)}")
    step_V = control.slew_V_per_s * control.dt_s
    observed = Observations(control.range_um, step_V, planned=len(plan.faults))
    missing, samples = _kept(out, observed, run_live(out, stage, control, plan, observed, stopped, say))
    say("[3/3] judging and drawing")
    assess(observed)
    found = soak_summary(observed, judge(observed, missing), samples)
    interrupted = observed.duration_s < plan.duration_s - 1.0
    write_summary(out / "soak.json", found)
    draw(out / "soak.png", observed)
    (out / "report.md").write_text(report(found, observed, plan, interrupted), encoding="utf-8")
    happened = [asdict(fault) for fault in observed.faults]
    kept = {"seed": plan.seed, "duration_s": plan.duration_s, "left_out": plan.left_out, "faults": happened}
    (out / "plan.json").write_text(json.dumps({**kept, "events": observed.events}, indent=1) + "\n", encoding="utf-8")
    return Done(found, interrupted)


def _kept(out: Path, observed: Observations, monitor: Monitor) -> tuple[int, dict[str, int]]:
    """Number of samples that the monitor saw and no service recorded though it could, and all counts of samples."""
    # A standby records too, in a folder of its own.
    found, rows = recorded(
        folder
        for name in SERVICES
        for where in (out / name, *sorted((out / name).glob("taken-*")))
        for folder in (where / "recording", where / "recording-standby")
    )
    nowhere = monitor.track.seen.minus(found)
    missing = len(nowhere.minus(unrecordable(observed)))
    faults = monitor.stage.get("faults", {})
    return missing, {
        "seen": len(monitor.track.seen),
        "received_by_monitor": monitor.track.received,
        "recorded": len(found),
        "rows_recorded": rows,
        "in_no_recording": len(nowhere),
        "in_no_recording_and_no_fault_on": missing,
        "withheld_by_faults": int(faults.get("gap", 0)) + int(faults.get("losses", 0)),
        "without_their_voltage_in_time": sum(s.held for s in observed.seconds),
    }
