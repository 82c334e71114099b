"""A service that is killed and started again goes on where it was: no record is lost, nothing learnt, no jump."""

from __future__ import annotations

import ast
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.client import Client
from service.wire_query import STALE
from sim.recordings import read
from tests.service.conftest import unused_port, write_config
from tests.service.living import Asker, Process, Stage, eventually

pytestmark = pytest.mark.e2e
ROOT = Path(__file__).resolve().parents[2]
EXTRA = 'recorder = "rec"\ncheckpoints = "kept"\ncheckpoint_s = 0.5\nstale_s = 0.4\nserved = "lssvm_adaptive"\n'
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
        eventually(lambda: client.status()["stale"], 5.0)
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
            assert not client.status()["stale"]
            assert client.status()["samples"]["lost"] == 0
    processes[1].send(signal.SIGTERM)
    assert processes[1].process.wait(30) == 0
    recorded = read(tmp_path / "rec")
    assert recorded.seq is not None
    np.testing.assert_array_equal(recorded.seq, np.arange(recorded.seq[-1] + 1))
    assert recorded.seq[-1] >= first_sent

    # The newest checkpoint is cut off, and one of another axis lies there: the one before is taken, with the reason.
    kept = sorted((tmp_path / "kept").glob("*.ckpt"))
    kept[-1].write_bytes(kept[-1].read_bytes()[:-100])
    processes.append(Process(*serve))
    with Client.connect(endpoint, timeout_s=2.0, wait_s=20.0) as client:
        # What came behind it is in the journal.
        assert client.status()["seq"] == recorded.seq[-1]


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
