"""A service that is killed and started again goes on where it was: no record is lost, nothing learnt, no jump."""

from __future__ import annotations

import ast
import json
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.service.client.client import Client
from dehyst.service.config.settings import read_config
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.query import STALE
from dehyst.service.runtime.session import SURELY, open_client, open_service
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.checkpoint import CheckpointFolder, decode_checkpoint
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from dehyst.sim.recordings import read
from tests.service.conftest import DT_S, make_models, unused_port, write_config
from tests.service.living import Asker, Process, Stage, eventually, samples

pytestmark = pytest.mark.e2e
ROOT = Path(__file__).resolve().parents[3]
EXTRA = 'recorder = "rec"\ncheckpoints = "kept"\ncheckpoint_s = 0.5\nstale_s = 0.4\nserved = "lssvm_adaptive"\n'
#: A queue and a learner that takes seconds for it.
SLOW = "queue_samples = 100_000\n[axis.learner]\nwindow = 1500\nlearn_every = 2\n"
#: Loaded before anything else: a clock of the wall that stands a day earlier and runs backwards.
BACKWARDS = "import time\n_now = time.time\n_start = _now()\ntime.time = lambda: 2 * _start - _now() - 86400.0\n"


@pytest.fixture
def processes() -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.kill()


def test_a_killed_service_goes_on_with_all_that_it_had(tmp_path: Path, processes: list[Process]) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=EXTRA)
    endpoint = f"tcp/127.0.0.1:{port}"
    (tmp_path / "clock").mkdir()
    (tmp_path / "clock" / "sitecustomize.py").write_text(BACKWARDS)
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    with Client.connect(endpoint, timeout_s=2.0, wait_s=20.0, retry_s=20.0) as client:
        with Stage([endpoint]) as stage:
            eventually(lambda: client.status()["seq"] > 2500)
        first_sent = stage.sent
        # A dead stage: answers go on, and say how old they are; a query that names its snapshot is as ever.
        eventually(lambda: client.status()["stale"])
        assert client.point(40.0).flags & STALE
        seq = client.status()["snapshot_seq"]
        assert not client.point(40.0, as_of=seq).flags & STALE
        before = client.status()
        assert before["seq"] == first_sent - 1
        asker = Asker(client)
        memory = asker.last.memory
        then = client.trajectory(40.0 + np.arange(20.0), memory=memory, as_of=seq)
        assert eventually(lambda: client.status()["recorder"]["written"]) == first_sent

        # Killed, and started again by a clock of the wall that has gone mad.
        processes[0].process.kill()
        processes[0].process.wait(10)
        start = time.monotonic()
        processes.append(Process(*serve, path=tmp_path / "clock"))
        asker.ask_for(0.2)
        after = client.status()
        assert after["instance"] != before["instance"]
        print(f"serving {processes[1].start_s:.2f} s after the start, {time.monotonic() - start:.2f} s with the client")
        assert after["snapshot_seq"] == seq
        assert after["fingerprint"] == before["fingerprint"]
        assert (after["samples"]["received"], after["samples"]["learnt"]) == (
            before["samples"]["received"],
            before["samples"]["learnt"],
        )
        # Not only within the slew limit: to the last bit.
        now = client.trajectory(40.0 + np.arange(20.0), memory=memory, as_of=seq)
        np.testing.assert_array_equal(now.u_V, then.u_V)
        assert asker.step_V < 0.01

        # The stage goes on where it was, and so does the learning; nothing is stale any more.
        with Stage([endpoint], first=first_sent) as stage:
            eventually(lambda: client.status()["samples"]["learnt"] > before["samples"]["learnt"] + 200)
            eventually(lambda: not client.status()["stale"])
            assert client.status()["samples"]["lost"] == 0
    processes[1].send(signal.SIGTERM)
    assert processes[1].process.wait(30) == 0
    recorded = read(tmp_path / "rec")
    assert recorded.seq is not None
    np.testing.assert_array_equal(recorded.seq, np.arange(recorded.seq[-1] + 1))
    assert recorded.seq[-1] >= first_sent

    # The newest checkpoint is cut off, and one of another axis lies there: the one before is taken, with the reasons.
    kept = sorted((tmp_path / "kept").glob("*.ckpt"))
    meta, state = decode_checkpoint(kept[-2].read_bytes())
    kept[-1].write_bytes(kept[-1].read_bytes()[:-100])
    of_y = CheckpointFolder(tmp_path / "kept", "demo", "y", meta.dt_s, {}, 1000).write(replace(meta, axis="y"), state)
    assert of_y > kept[-1]
    # What is told at a start is told to whoever listens already.
    ear = f"tcp/127.0.0.1:{unused_port()}"
    config.write_text(config.read_text().replace("listen = ", f'connect = ["{ear}"]\nlisten = '))
    events: list[dict[str, Any]] = []
    with open_service([ear]) as listening:
        listening.declare_subscriber(
            "dehyst/v1/demo/x/event", lambda sample: events.append(json.loads(sample.payload.to_bytes()))
        )
        processes.append(Process(*serve))
        eventually(lambda: "learnt_again" in [event["event"] for event in events])
        told = [(event["event"], event["detail"]) for event in events]
        assert [name for name, _ in told[:3]] == ["checkpoint_refused", "checkpoint_refused", "restored"]
        assert "axis is 'y', expected 'x'" in told[0][1]
        assert "damaged or cut off" in told[1][1]
        assert told[2][1].endswith(f"sample {meta.seq}")
        with Client.connect(endpoint, timeout_s=2.0, wait_s=20.0) as client:
            # What came behind it is in the journal.
            assert client.status()["seq"] == recorded.seq[-1]


def test_killed_while_samples_flow_it_loses_no_record_and_next_to_no_learning(
    tmp_path: Path, processes: list[Process]
) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=EXTRA.replace("checkpoint_s = 0.5\n", ""))
    endpoint = f"tcp/127.0.0.1:{port}"
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    first = 0
    # What was under way at each kill: behind what had been told, up to what had been sent.
    under_way: list[int] = []
    with Client.connect(endpoint, timeout_s=2.0, wait_s=20.0, retry_s=20.0) as client:
        for goes_on in (False, False, False, True):
            with Stage([endpoint], first=first) as stage:
                learnt = client.status()["samples"]["learnt"]
                eventually(lambda least=learnt + 1500: client.status()["samples"]["learnt"] > least)
                before = status_in_journal(client)
                told = before["seq"]
                sent = stage.sent - 1
                processes[-1].process.kill()
                processes[-1].process.wait(10)
                if goes_on:
                    processes.append(Process(*serve))
                    eventually(lambda least=sent: client.point(40.0) and client.status()["seq"] > least + 500)
                    sent = client.status()["seq"]
            first = stage.sent
            if not goes_on:
                processes.append(Process(*serve))
                client.point(40.0)
                after = client.status()
                print(f"in the journal {told}, sent {sent}, going on from {after['seq']}")
                assert after["instance"] != before["instance"]
                assert told <= after["seq"]
                assert after["samples"]["learnt"] >= before["samples"]["learnt"]
                sent = first - 1
            under_way += range(told + 1, sent + 1)
        eventually(lambda: client.status()["seq"] == first - 1)
        last = client.status()
    processes[-1].send(signal.SIGTERM)
    assert processes[-1].process.wait(30) == 0
    recorded = read(tmp_path / "rec")
    assert recorded.seq is not None
    assert len(np.unique(recorded.seq)) == len(recorded)
    # What is missing was under way, or came while there was nobody to take it; and it is counted.
    missing = np.setdiff1d(np.arange(first), recorded.seq)
    assert np.setdiff1d(missing, under_way).size == 0
    assert last["samples"]["lost"] == missing.size


def test_what_waits_at_a_stop_is_recorded_and_learnt_by_the_next_start(
    tmp_path: Path, processes: list[Process]
) -> None:
    """A stop used to learn for two seconds, and what was left went where no start reads it."""
    config = write_config(tmp_path, port := unused_port(), extra=EXTRA + SLOW)
    endpoint = f"tcp/127.0.0.1:{port}"
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    n, a_message = 57_000, 9500  # a start learns 60,000 again at most
    with Client.connect(endpoint, timeout_s=10.0, wait_s=20.0) as client, open_client([endpoint], 20.0) as session:
        # Together the learner needs seconds for them.
        for first in range(0, n, a_message):
            session.put("dehyst/v1/demo/x/sample", samples(first, a_message), congestion_control=SURELY)
        eventually(lambda: client.status()["samples"]["waiting"] > n // 2)
    processes[0].send(signal.SIGTERM)
    begun = time.monotonic()
    log = processes[0].process.communicate(timeout=60)[1]
    print(f"stopped after {time.monotonic() - begun:.1f} s")
    assert processes[0].process.returncode == 0
    assert "samples still waited; they are in the recording, and the next start learns them" in log
    recorded = read(tmp_path / "rec")
    np.testing.assert_array_equal(recorded.seq, np.arange(n))
    assert not (tmp_path / "rec" / "_aside").exists()
    processes.append(Process(*serve))
    with Client.connect(endpoint, timeout_s=10.0, wait_s=20.0) as client:
        status = client.status()
        assert status["seq"] == n - 1
        assert status["samples"]["received"] == n


def status_in_journal(client: Client) -> dict[str, Any]:
    """A status, once each sample that was handled by then is in the journal: how long that takes is the machine's."""
    asked = client.status()
    # A batch is handled, then offered to the recorder; the next batch is handled after that.
    offered = eventually(lambda: (now := client.status())["seq"] > asked["seq"] and now["recorder"]["offered"])
    eventually(lambda: client.status()["recorder"]["written"] >= offered)
    return asked


def test_the_wall_clock_decides_nothing() -> None:
    """It may be told to people, under a name that says so; every other use of it is a bug waiting for a leap."""
    found = []
    # Those of the soak are the ones that set the clock back.
    for path in sorted(p for p in (ROOT / "service").rglob("*.py") if "soak" not in p.parts):
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in (
                "time.time",
                "datetime.now",
                "datetime.datetime.now",
            ):
                line = source.splitlines()[node.lineno - 1]
                if "unix" not in line and "wall_s" not in line:
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {line.strip()}")
    assert not found


def turned(name: str) -> dict[str, Any]:
    """The models of the file, of which one has its gain, or what it has learnt, times -1."""
    models: dict[str, Any] = dict(make_models())
    model = models[name]
    if name == "linear":
        gain = model.parameters.gain_um_per_V
        models[name] = replace(model, parameters=replace(model.parameters, gain_um_per_V=-gain))
    else:
        models[name] = replace(model, alpha=-model.alpha)
    return models


@pytest.mark.parametrize("name", ["linear", "lssvm_adaptive"])
def test_a_checkpoint_of_another_model_file_is_refused_and_the_file_serves(
    tmp_path: Path, processes: list[Process], name: str
) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=EXTRA)
    serve = ("serve", "--config", str(config))
    processes.append(Process(*serve))
    with Client.connect(f"tcp/127.0.0.1:{port}", timeout_s=2.0, wait_s=20.0, retry_s=20.0) as client:
        with Stage([f"tcp/127.0.0.1:{port}"]):
            eventually(lambda: client.status()["checkpoints"]["written"] > 1)
        processes[0].send(signal.SIGTERM)
        assert processes[0].process.wait(30) == 0
        write_bundle(tmp_path / "x.npz", turned(name), BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))
        processes.append(Process(*serve))
        status = client.status()
        assert status["seq"] == -1
        assert status["checkpoints"]["refused"] >= 2
        begun = load_axis("demo", read_config(config).axes[0])
        assert status["fingerprint"] == fingerprint(begun.newest.models["lssvm_adaptive"])
        assert client.point(40.0, model="linear").u_V == (0.0 if name == "linear" else 39.0 / 11.0)
