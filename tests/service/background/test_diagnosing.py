"""The diagnosis in the background: job, watcher, and a real service whose stage changes its gain."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.background.diagnosis_worker import diagnose
from dehyst.service.background.job import BackgroundJob
from dehyst.service.background.settings import WatchConfig
from dehyst.service.background.watcher import WORKER, Watcher
from dehyst.service.client.client import Client
from dehyst.service.config.settings import AxisConfig
from dehyst.service.identification.identifying import identify_one
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.server.axis import Axis
from dehyst.service.storage.model_file import BundleMeta, read_bundle, write_bundle
from dehyst.sim.signals.references import demo_reference
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.online_models import PlainModel
from tests.service.background.test_diagnosing_parts import DT_S
from tests.service.living import eventually

#: What waits for a job, which runs at the lowest priority: beside other work it would not be done in time.
waits_for_a_job = pytest.mark.alone

QUICK = WatchConfig(history_s=8.0, reference_s=4.0, recent_s=3.0, collect_s=2.0, cooldown_s=5.0, timeout_s=60.0)


# ---- jobs and the watcher, on the stage that stands in for hardware


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    stage = Stage(preset("rich", dt_s=DT_S, seed=20))
    u_V = training_input(DT_S, 10.0)[1]
    y_um = stage.run(stage.initial_state(), u_V)[0]
    path = tmp_path_factory.mktemp("model") / "x.npz"
    models = {name: identify_one(name, u_V, y_um, DT_S, 200) for name in ("linear", "lssvm_adaptive")}
    meta = BundleMeta("demo", "x", DT_S, y_min_um=float(y_um.min()), y_max_um=float(y_um.max()))
    write_bundle(path, models, meta)
    return path


def voltages(model_file: Path, seconds: float) -> Any:
    """What the identified model gives for a reference with large and small swings."""
    model = read_bundle(model_file).models["lssvm_adaptive"]
    wanted = demo_reference(seconds, DT_S, (6.0, 78.0), 20)
    swing = 30.0 * (1.0 - np.cos(2.0 * np.pi * 0.5 * wanted.t_s)) + 10.0
    v, a = np.gradient(swing, DT_S), np.gradient(np.gradient(swing, DT_S), DT_S)
    return np.clip(model.feedforward(swing, v, a, model.rest_memory(0.0)).u_V, -2.0, 10.0)


def recorded(model_file: Path, seconds: float, change_s: float, **change: float) -> Any:
    """Samples (4, n) of the stage, changed at ``change_s``."""
    u_V = voltages(model_file, seconds)
    values = {name.replace("__", "."): value for name, value in change.items()}
    config = preset("rich", dt_s=DT_S, seed=21)
    stage = Stage(replace(config, changes=((change_s, values),)) if values else config)
    y_um = stage.run(stage.initial_state(), u_V)[0]
    seq = np.arange(u_V.size)
    return np.stack([seq, seq * DT_S, u_V, y_um])


def diagnosis_job(
    order: dict[str, Any], reference: Any, recent: Any, timeout_s: float, done: Callable[[dict[str, Any]], None]
) -> BackgroundJob:
    return BackgroundJob(WORKER, order, {"reference": reference, "recent": recent}, timeout_s, done)


def order(model_file: Path, from_seq: int) -> dict[str, Any]:
    return {"model": str(model_file), "name": "lssvm_adaptive", "from_seq": from_seq, "report": ""}


@pytest.mark.parametrize("clock_s", [0.0, -3600.0])
def test_what_is_recent_is_looked_at_though_a_longer_part_lies_before_a_gap(model_file: Path, clock_s: float) -> None:
    samples = recorded(model_file, 18.0, 9.0, gain_drift__gain=-0.03)
    # Nothing is heard for a second, and the stage's clock is set while the change is being looked at.
    samples[1, 14000:] += clock_s
    heard = np.r_[0:10500, 11500:18000]
    told = diagnose(order(model_file, 10000), samples[:, :8500], samples[:, heard])
    assert told["verdict"] == "changed"
    assert told["effects"][0]["name"] == "gain_drift"
    assert told["effects"][0]["parameters"]["gain"] == pytest.approx(-0.03, abs=0.004)


@waits_for_a_job
def test_a_job_that_cannot_be_done_says_why(model_file: Path, tmp_path: Path) -> None:
    samples = recorded(model_file, 3.0, 0.0)
    told: list[dict[str, Any]] = []
    jobs = (
        diagnosis_job(order(tmp_path / "none.npz", 0), samples, samples, 60.0, told.append),
        diagnosis_job(order(model_file, 2900), samples, samples, 60.0, told.append),
        diagnosis_job(order(model_file, 0), samples, samples, 0.05, told.append),
    )
    for job in jobs:
        job.start()
    eventually(lambda: not any(job.running for job in jobs), 60.0)
    assert all(sum(word in t["error"] for t in told) == 1 for word in ("none.npz", "usable samples", "timeout_s"))


def test_a_cancelled_job_tells_nothing_and_leaves_no_process(model_file: Path) -> None:
    samples = recorded(model_file, 3.0, 0.0)
    told: list[dict[str, Any]] = []
    job = diagnosis_job(order(model_file, 0), samples, samples, 60.0, told.append)
    job.start()
    eventually(lambda: job._process is not None, 10.0)
    job.cancel()
    assert not job.running
    assert job._process is not None
    assert job._process.poll() is not None
    assert told == []


class StandIn(PlainModel):
    """A learner that tells a gain; nothing is learnt."""

    def __init__(self, model: InverseModel) -> None:
        super().__init__(model)
        self.gain = 1.0

    def diagnostics(self) -> dict[str, Any]:
        return {"gain": self.gain, "offset_V": 0.0, "recent_rms_error_pct": 0.05, "valid": 1.0}


def watched(model_file: Path, config: WatchConfig = QUICK) -> tuple[Watcher, Axis, StandIn]:
    models = dict(read_bundle(model_file).models)
    limits = Limits(-2.0, 10.0, 4000.0, 0.0, 90.0)
    learner = StandIn(models["lssvm_adaptive"])
    axis = Axis(AxisConfig("x", model_file, limits, diagnosis=config), models, learner, limits)
    return Watcher(axis, config), axis, learner


def feed(watcher: Watcher, samples: Any, first: int, last: int) -> None:
    for k in range(first, last, 20):
        part = samples[:, k : min(last, k + 20)]
        watcher.take(SampleBatch(part[0].astype(np.int64), *(np.ascontiguousarray(row) for row in part[1:])))
        watcher.tick(k * DT_S)


@waits_for_a_job
def test_an_alarm_leads_to_a_verdict_and_a_new_reference(model_file: Path) -> None:
    samples = recorded(model_file, 18.0, 6.0, gain_drift__gain=-0.03)
    watcher, axis, learner = watched(model_file)
    feed(watcher, samples, 0, 6000)
    assert watcher.status()["armed"]
    learner.gain = 0.972
    feed(watcher, samples, 6000, 7500)
    assert [e["event"] for e in axis.take_events()] == ["diagnosis_alarm"]
    feed(watcher, samples, 7500, 11000)
    eventually(lambda: not watcher.status()["running"], 60.0)
    (event,) = axis.take_events()
    assert event["event"] == "diagnosis"
    assert event["detail"].startswith("the model's error grew: gain drift, -")
    status = watcher.status()
    json.dumps(status)
    assert (status["alarms"], status["started"], status["finished"], status["armed"]) == (1, 1, 1, False)
    assert status["last"]["effects"][0]["parameters"]["gain"] == pytest.approx(-0.03, abs=0.004)
    feed(watcher, samples, 11000, 17000)
    assert watcher.status()["armed"]
    assert watcher.status()["alarms"] == 1
    watcher.close()


def alarmed(model_file: Path, samples: Any) -> tuple[Watcher, Axis]:
    """A watcher with a reference, and an alarm some 0.7 s after sample 6000."""
    watcher, axis, learner = watched(model_file)
    feed(watcher, samples, 0, 6000)
    learner.gain = 0.972
    feed(watcher, samples, 6000, 7000)
    assert [e["event"] for e in axis.take_events()] == ["diagnosis_alarm"]
    return watcher, axis


@waits_for_a_job
def test_an_alarm_with_too_few_samples_after_it_waits_for_more(model_file: Path) -> None:
    samples = recorded(model_file, 14.0, 6.0, gain_drift__gain=-0.03)
    watcher, axis = alarmed(model_file, samples)
    # The stage says nothing for a second and a half, most of what is waited for.
    feed(watcher, samples, 8500, 9000)
    eventually(lambda: not watcher.status()["running"], 60.0)
    (event,) = axis.take_events()
    assert event["event"] == "diagnosis_waits"
    assert event["detail"].startswith("recent: got ")
    assert event["detail"].endswith("once more in 2 s")
    feed(watcher, samples, 9000, 10900)
    assert watcher.status()["started"] == 1
    feed(watcher, samples, 10900, 12000)
    eventually(lambda: not watcher.status()["running"], 60.0)
    (event,) = axis.take_events()
    assert event["detail"].startswith("the model's error grew: gain drift, -")
    status = watcher.status()
    assert status["last"]["effects"][0]["parameters"]["gain"] == pytest.approx(-0.03, abs=0.004)
    counted = {"alarms": 1, "started": 2, "waited": 1, "finished": 1, "failed": 0}
    assert {name: status[name] for name in counted} == counted
    watcher.close()


@waits_for_a_job
def test_requests_are_answered_at_once_and_one_runs_at_a_time(model_file: Path) -> None:
    samples = recorded(model_file, 13.0, 0.0)
    watcher, axis, _ = watched(model_file)
    assert not watcher.request({})["started"]
    # From a stage that has been moving for a while: creep since its first move is a change, and would be told.
    feed(watcher, samples, 4000, 13000)
    begin = time.perf_counter()
    assert watcher.request({"recent_s": 3.0}) == {"started": True, "job": 1}
    assert watcher.request({})["why"] == "one is running"
    assert time.perf_counter() - begin < 5.0
    for bad in ({"recent": 3.0}, {"recent_s": "3"}, {"recent_s": True}, {"recent_s": 0.1}, {"report": 1}):
        with pytest.raises(InputError):
            watcher.request(bad)
    with pytest.raises(InputError, match="reports"):
        watcher.request({"report": True})
    eventually(lambda: not watcher.status()["running"], 60.0)
    assert watcher.status()["last"]["verdict"] == "unchanged"
    assert axis.take_events()[-1]["event"] == "diagnosis"
    watcher.close()
    assert not watcher.request({})["started"]


@pytest.mark.e2e
@waits_for_a_job
def test_a_real_service_names_the_gain_step_of_a_real_stage(model_file: Path, tmp_path: Path, free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    config = tmp_path / "serve.toml"
    config.write_text(
        f'stage = "demo"\nlisten = ["{endpoint}"]\n[[axis]]\nname = "x"\nmodel = {json.dumps(str(model_file))}\n'
        "u_min_V = -2.0\nu_max_V = 10.0\nslew_V_per_s = 4000.0\n"
        f"recorder = {json.dumps(str(tmp_path / 'recording'))}\n"
        "[axis.diagnosis]\nhistory_s = 8\nreference_s = 4\nrecent_s = 3\ncollect_s = 2.5\n"
        f"reports = {json.dumps(str(tmp_path / 'reports'))}\n"
        "[axis.retuning]\nperiod_s = 0.0\nfresh = 60\n"
        "search = {starts = 2, rows = 100, iterations = 15}\n"
    )
    u_V = voltages(model_file, 20.0)
    began_at = time.time()
    cli = [sys.executable, "-m", "dehyst.lab.cli"]
    serve = subprocess.Popen([*cli, "serve", "--config", str(config), "--json"], stdout=subprocess.PIPE, text=True)
    stage = None
    try:
        assert serve.stdout is not None
        assert json.loads(serve.stdout.readline())["ready"]
        stage = subprocess.Popen(
            [
                *cli, "stage", "--endpoint", endpoint, "--duration", "20", "--batch", "20", "--seed", "21",
                "--change", "6:gain_drift.gain=-0.019", "--json",
            ],
            stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        assert stage.stdout is not None
        assert json.loads(stage.stdout.readline())["ready"]
        with Client.connect(endpoint, timeout_s=5.0) as client, open_client(endpoint) as session:
            events: list[dict[str, Any]] = []
            session.declare_subscriber(client.keys.event, lambda s: events.append(json.loads(s.payload.to_bytes())))
            for first in range(0, u_V.size, 500):
                session.put(
                    client.keys.command, wire.encode_command(first, u_V[first : first + 500]), congestion_control=SURELY
                )
            # Beside it an operator has the model tuned, by the same real wire.
            eventually(lambda: client.status()["seq"] > 1000, 30.0)
            tune = [*cli, "retune", "--endpoint", endpoint, "--who", "alice", "--json"]
            tuned = subprocess.run(tune, capture_output=True, text=True, timeout=60, check=True)
            assert json.loads(tuned.stdout)["result"] == {"started": True, "job": 1}
            said = eventually(lambda: [e for e in events if e["event"] == "diagnosis"], 100.0)
            assert said[0]["detail"].startswith("the model's error grew: gain drift, -")
            last = client.status()["diagnosis"]["last"]
            assert last["effects"][0]["name"] == "gain_drift"
            assert last["effects"][0]["parameters"]["gain"] == pytest.approx(-0.019, abs=0.004)
            last = eventually(lambda: client.status()["retuning"]["last"], 60.0)
            assert last["outcome"] in ("better", "worse", "unchanged"), last
            ask = [*cli, "ask-diagnosis", "--report", "--recent", "4", "--endpoint", endpoint, "--who", "bob", "--json"]
            asked = subprocess.run(ask, capture_output=True, text=True, timeout=60, check=True)
            assert json.loads(asked.stdout)["result"] == {"started": True, "job": 2}
            written = (tmp_path / "recording" / "operations.jsonl").read_text().splitlines()
            journal = [json.loads(line) for line in written]
            assert [(line["who"], line["verb"], line["ok"]) for line in journal] == [
                ("alice", "retune", True),
                ("bob", "diagnose", True),
            ]
            assert journal[1]["arguments"] == {"recent_s": 4.0, "report": True}
            times = [began_at, *(line["time_unix_s"] for line in journal), time.time()]
            assert times == sorted(times)
            assert 1000 < journal[0]["seq"] < journal[1]["seq"]
            eventually(lambda: client.status()["diagnosis"]["finished"] == 2, 120.0)
            folder = Path(client.status()["diagnosis"]["last"]["report"]["folder"])
            assert folder.parent == tmp_path / "reports"
            assert {"report.md", "report.json", "residual.png", "stage.toml"} <= {f.name for f in folder.iterdir()}
            assert "Noise floor" in (folder / "report.md").read_text() or (folder / "report.md").stat().st_size > 500
    finally:
        for process in (stage, serve):
            if process is not None:
                process.terminate()
                process.communicate(timeout=30)
