"""One demonstration: record, identify, run, score, draw, and write the files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adaptive.errors import InputError
from lab.demo.fast import run_fast
from lab.demo.live import record_identification, run_live
from lab.demo.plan import AXIS, MODELS, STAGE, TEACHER, Plan, plan_for
from lab.demo.result import DemoRun, draw_loops, draw_tracking
from lab.testbed.identified_stage import Rig, write_service_config
from service.config.settings import read_config
from service.identification.identifying import NAMES, Stretch, identify_all
from service.server.axis_loading import load_axis
from service.storage.model_file import BundleMeta, write_bundle
from service.storage.output import clear_output
from service.storage.recorder import Recorder, RecorderConfig
from service.viewer.records import Event, Record, SceneConfig, Tracking
from service.viewer.rerun_sink import write_recording
from sim.recordings import read, repaired
from sim.stage.stage import Stage

Say = Callable[[str], None]
#: Files and folders of a run. Those of an older run are removed first; other files stay.
OURS = ("summary.json", "tracking.png", "loops.png", "demo.rrd", "recording", "identification", "model.npz", "logs")


@dataclass(frozen=True, slots=True)
class Done:
    """A finished demonstration."""

    plan: Plan
    run: DemoRun
    summary: dict[str, Any]


def run(
    out: Path, *, fast: bool, duration_s: float, seed: int, view: list[str], say: Say, stage: Path | None = None
) -> Done:
    """Run everything and write the results into ``out``; ``stage`` is a stage file in place of the usual stage.

    Raises InputError on a folder that cannot be used, ServiceError if a process fails.
    """
    own = stage.resolve() if stage is not None else None
    clear_output(out, OURS)
    logs = out / "logs"
    logs.mkdir()
    plan = Plan(run_s=duration_s, seed=seed) if own is None else plan_for(own, logs, duration_s, seed)
    say(f"[1/4] recording {plan.identify_s:g} s of the chapter's training signal on a rested stage")
    _record(plan, out / "identification", logs, fast, _Bar(plan.identify_s, say))
    say("[2/4] identifying five inverse models from 10 s at 1 kHz")
    model = out / "model.npz"
    _identify(plan, out / "identification", model, say)
    kind = "as fast as possible, in one process" if fast else "in real time, in processes over zenoh"
    say(f"[3/4] {plan.run_s:g} s of a reference that no model has seen, {kind}")
    say(f"      after {plan.run_s / 2:g} s the stage changes: {plan.change_text}")
    rig = Rig(logs)
    config = _configure(plan, out, logs / "serve.toml", rig.endpoint)
    show = _Bar(plan.run_s, say)

    def progress(ticks: int, error_um: dict[str, float]) -> None:
        parts = ", ".join(f"{name} {100.0 * value / plan.range_um:.3f}" for name, value in error_um.items())
        show(ticks * plan.dt_s, f"mean |error| of the last second, % of range: {parts}")

    if fast:
        axis = load_axis(STAGE, read_config(config).axes[0])
        with Recorder(RecorderConfig(out / "recording")) as recorder:
            done = run_fast(plan, axis, recorder, progress)
        write_recording(out / "demo.rrd", _scene(plan), _records(plan, done))
    else:
        done = run_live(plan, config, rig, out / "demo.rrd", view, progress)
    say("[4/4] drawing")
    wanted_um = plan.reference()[0]
    summary = done.summary(plan, wanted_um) | {"mode": "fast" if fast else "real_time"}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    draw_tracking(out / "tracking.png", plan, wanted_um, done.y_um)
    draw_loops(out / "loops.png", plan, wanted_um, done.y_um)
    return Done(plan, done, summary)


class _Bar:
    """Prints a line of progress every five seconds of the run, and at its end."""

    def __init__(self, total_s: float, say: Say) -> None:
        self._total_s, self._say, self._next_s = total_s, say, 5.0

    def __call__(self, done_s: float, detail: str = "") -> None:
        if done_s + 1e-9 < self._next_s:
            return
        self._next_s = (done_s // 5.0 + 1.0) * 5.0
        filled = round(20.0 * min(1.0, done_s / self._total_s))
        self._say(f"  [{'#' * filled:<20}] {done_s:4.0f} of {self._total_s:g} s  {detail}".rstrip())


def _record(plan: Plan, folder: Path, logs: Path, fast: bool, bar: _Bar) -> None:
    u_V = plan.identification_voltage()
    with Recorder(RecorderConfig(folder)) as recorder:
        if not fast:
            record_identification(plan, recorder, logs, lambda received: bar(received * plan.dt_s))
            return
        stage = Stage(plan.stage(changing=False))
        y_um, _ = stage.run(stage.initial_state(), u_V)
        seq = np.arange(u_V.size)
        recorder.put(seq, seq * plan.dt_s, u_V, y_um, "identification")


def _identify(plan: Plan, data: Path, model: Path, say: Say) -> None:
    recording = read(data)
    whole = Stretch.of(repaired(recording))
    results = identify_all(
        whole, whole, recording.dt_s, follows=False, progress=lambda name: say(f"  {MODELS[name]} ...")
    )
    failed = [f"{result.name}: {result.failed}" for result in results if result.model is None]
    if failed:
        raise InputError(f"identification: {'; '.join(failed)}")
    models = {result.name: result.model for result in results if result.model is not None}
    assert set(models) == set(NAMES)
    meta = BundleMeta(
        stage=STAGE,
        axis=AXIS,
        dt_s=recording.dt_s,
        source=data.name,
        source_sha256=recording.sha256,
        y_min_um=float(whole.motion[:, 0].min()),
        y_max_um=float(whole.motion[:, 0].max()),
        u_min_V=float(whole.u_V.min()),
        u_max_V=float(whole.u_V.max()),
    )
    write_bundle(model, models, meta)


def _configure(plan: Plan, out: Path, path: Path, endpoint: str) -> Path:
    """Write the configuration of the service to ``path``."""
    stage = plan.stage(changing=True)
    axis = {
        "name": AXIS,
        "model": out / "model.npz",
        "u_min_V": stage.u_min_V,
        "u_max_V": stage.u_max_V,
        "slew_V_per_s": 4000.0,
        "learn": TEACHER,
        "snapshot_every": plan.block,
        "recorder": out / "recording",
        # Background tuning ends at a time that depends on the machine; a fast run must give the same numbers.
        "retuning": {"period_s": 0.0},
    }
    write_service_config(path, STAGE, axis, listen=[endpoint])
    return path


def _scene(plan: Plan) -> SceneConfig:
    models = (TEACHER, *(name for name in MODELS if name != TEACHER))
    return SceneConfig(f"{STAGE}/{AXIS}", models, range_um=plan.range_um)


def _records(plan: Plan, done: DemoRun) -> list[Record]:
    seq = np.arange(plan.ticks)
    t_s = seq.astype(np.float64) * plan.dt_s
    wanted_um = plan.reference()[0]
    records: list[Record] = [
        Tracking(name, seq, t_s, done.u_V[name], done.y_um[name], wanted_um, done.std_V[name]) for name in MODELS
    ]
    at = plan.change_tick
    records.append(Event(at * plan.dt_s, at, f"the stage changes: {plan.change_text}", "WARN", change=True))
    return records + list(done.notes)
