"""A folder belongs to one axis, and one process at a time writes into it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import FieldError
from dehyst.service.storage.owner import FolderOwnedError, FolderOwner, owner_of
from dehyst.service.storage.segments import LOCK
from tests.service.conftest import unused_port, write_config
from tests.service.living import Process, Stage, eventually

HOLDS = """
import sys, time
from pathlib import Path
from dehyst.service.storage.owner import FolderOwner
FolderOwner(Path(sys.argv[1]), ".lock", sys.argv[2]).take()
print("held", flush=True)
time.sleep(60)
"""


def test_the_lock_ends_with_its_process_and_the_name_stays(tmp_path: Path) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLDS, str(tmp_path), "demo/x"], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline()
        mine = FolderOwner(tmp_path, LOCK, "demo/x")
        held = rf"{tmp_path}, held by demo/x, process {holder.pid}"
        with pytest.raises(FolderOwnedError, match=held):
            mine.take()
        with pytest.raises(FieldError, match=rf"recorder: got {held}, expected a folder that no other process"):
            mine.hold("recorder", 0.1)
    finally:
        holder.kill()
        holder.communicate(timeout=10)
    other = FolderOwner(tmp_path, LOCK, "demo/y")
    with pytest.raises(FieldError, match=rf"recorder: got {tmp_path}, which holds files of demo/x, expected"):
        other.hold("recorder", 0.0)
    assert owner_of(tmp_path, LOCK) == "demo/x"
    mine.hold("recorder", 1.0)
    mine.take()  # what is held is held
    mine.release()


@pytest.mark.e2e
def test_a_second_service_with_the_folder_of_the_first_is_refused(tmp_path: Path) -> None:
    """It used to start, to lose all it was to record, and after a kill to learn what the other had recorded."""
    configs = []
    for name, axis in (("a", "x"), ("b", "x"), ("c", "y")):
        (tmp_path / name).mkdir()
        extra = f'recorder = "{tmp_path}/rec"\ncheckpoints = "kept"\ncheckpoint_s = 0.5\n'
        configs.append((write_config(tmp_path / name, port := unused_port(), axes=(axis,), extra=extra), port))

    def refused(config: Path) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "dehyst.lab.cli", "serve", "--config", str(config)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 2, done.stderr
        return done.stderr.splitlines()[-1]

    first = Process("serve", "--config", str(configs[0][0]))
    try:
        # Before the first sample too.
        word = refused(configs[1][0])
        pid = first.process.pid
        assert word.startswith(f"dehyst serve: recorder: got {tmp_path}/rec, held by demo/x, process {pid}, expected")
        endpoint = f"tcp/127.0.0.1:{configs[0][1]}"
        with Client.connect(endpoint, wait_s=20.0) as client, Stage([endpoint]) as stage:
            eventually(lambda: client.status()["recorder"]["written"] > 1000)
    finally:
        first.kill()
    assert "which holds files of demo/x" in refused(configs[2][0])
    # The same axis goes on where the killed one was, whoever starts it.
    again = Process("serve", "--config", str(configs[0][0]))
    try:
        with Client.connect(endpoint, wait_s=20.0) as client:
            assert client.status()["seq"] > 1000
            assert client.status()["seq"] < stage.sent
    finally:
        again.kill()
