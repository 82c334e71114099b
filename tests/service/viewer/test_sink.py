"""Recordings are written by the real Rerun and read back; a dead viewer holds nobody up."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.viewer import style
from dehyst.service.viewer.computed_run import write_recording
from dehyst.service.viewer.output import Output, OutputConfig
from dehyst.service.viewer.records import Diagnostics, Event, Record, SceneConfig, Status, Tracking
from tests.service.conftest import unused_port
from tests.service.living import eventually

MODELS = ("lssvm_adaptive", "linear")


def read_back(path: Path) -> tuple[dict[str, FloatArray], dict[str, list[Any]], Any]:
    """Scalars as (n, 3) of t_s, seq, value by path; other components by 'path:component'; the reader."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    curves: dict[str, list[FloatArray]] = defaultdict(list)
    others: dict[str, list[Any]] = defaultdict(list)
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        where = str(chunk.entity_path).lstrip("/")
        for name in batch.schema.names:
            if name == "Scalars:scalars":
                t_s = np.array([v.value for v in batch.column("t_s")], dtype=np.float64) * 1e-9
                seq = batch.column("seq").to_numpy(zero_copy_only=False)
                values = [v[0] for v in batch.column(name).to_pylist()]
                curves[where].append(np.column_stack([t_s, seq, values]))
            elif ":" in name:
                others[f"{where}:{name}"] += batch.column(name).to_pylist()
    joined = {path: np.concatenate(parts) for path, parts in curves.items()}
    return {path: rows[np.argsort(rows[:, 1])] for path, rows in joined.items()}, others, reader


def unit(model: str, error_um: FloatArray) -> Tracking:
    k = np.arange(len(error_um))
    reference_um = 40.0 + 30.0 * np.sin(2 * np.pi * k * 1e-3)
    std_V = np.full(len(k), 0.01) if model == MODELS[0] else None
    return Tracking(model, k, k * 1e-3, reference_um / 11.0, reference_um - error_um, reference_um, std_V)


def a_run(n: int = 3000) -> list[Record]:
    rng = np.random.default_rng(5)
    said: list[Record] = [
        Diagnostics(k * 1e-3, k, {"gain": 1.0 - 1e-5 * k, "counters": {"learnt": k}}) for k in range(0, n, 50)
    ]
    return [
        *said,
        unit("lssvm_adaptive", 0.02 * rng.standard_normal(n)),
        unit("linear", 2.0 * rng.standard_normal(n)),
        Status(1.0, 1000, {"stage": "demo"}),
        Event(1.5, 1500, "gain drops", "WARN", change=True),
    ]


def test_an_offline_run_reads_back_with_every_value(tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.rrd"
    records = a_run()
    write_recording(path, SceneConfig("demo/x", MODELS, range_um=60.0), records)
    write_recording(path, SceneConfig("demo/x", MODELS, range_um=60.0), records)  # Overwrites, does not append.
    curves, others, reader = read_back(path)
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1
    for record in records:
        if isinstance(record, Tracking):
            got = curves[f"error_um/{record.model}"]
            assert got[:, 0] == pytest.approx(record.t_s, abs=1e-9)
            assert got[:, 1].tolist() == record.seq.tolist()
            assert got[:, 2].tolist() == (record.reference_um - record.y_um).tolist()
            assert curves[f"voltage/{record.model}_V"][:, 2].tolist() == record.u_V.tolist()
    assert len(curves["displacement/reference_um"]) == 3000
    assert curves["voltage_sigma_mV"][:, 2] == pytest.approx(np.full(3000, 10.0))
    assert curves["drift/gain"][:, 2] == pytest.approx(1.0 - 1e-5 * np.arange(0, 3000, 50))
    assert others["events:TextLog:text"] == [["1.500 s  gain drops"]]
    assert others["events:TextLog:level"] == [["WARN"]]
    assert len(others["loops/now:LineStrips2D:strips"]) >= 10
    assert len(others["loops/before_change:LineStrips2D:strips"]) >= 1
    assert ["LSSVM, adaptive"] in others["error_um/lssvm_adaptive:SeriesLines:names"]
    assert "stage" in others["status:TextDocument:text"][0][0]


def test_the_blueprint_in_the_file_shows_every_curve_that_has_a_name(tmp_path: Path) -> None:
    path, config = tmp_path / "run.rrd", SceneConfig("demo/x", MODELS)
    write_recording(path, config, a_run(100))
    _, _, reader = read_back(path)
    texts: set[str] = set()
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for column in (c for c in batch.schema.names if c.endswith(("display_name", "ViewContents:query"))):
            texts |= {text for row in batch.column(column).to_pylist() if row for text in row}
    assert {"Tracking error, µm", "Displacement: wanted and reached, µm", "Query latency, µs", "Events"} <= texts
    for curve in style.lines(config):
        if curve != style.DISPLACEMENT.format("linear"):
            assert {f"+ /{curve}", f"+ /{curve.split('/')[0]}/**"} & texts, curve


def test_a_file_that_cannot_be_written_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    config = OutputConfig(SceneConfig("demo/x", MODELS), rrd=tmp_path / "file" / "run.rrd")
    with pytest.raises(InputError, match=r"rrd: cannot write .*run\.rrd"):
        Output(config)


def dead_url() -> tuple[socket.socket, str]:
    """A viewer that takes connections and never answers: worse than one that is not there."""
    listener = socket.create_server(("127.0.0.1", 0))
    return listener, f"rerun+http://127.0.0.1:{listener.getsockname()[1]}/proxy"


def test_a_dead_viewer_blocks_nobody_and_what_is_lost_is_counted(tmp_path: Path) -> None:
    listener, url = dead_url()
    scene = SceneConfig("demo/x", MODELS)
    with listener:
        dead = Output(OutputConfig(scene, connect=url, queue_batches=5))
        alive = Output(OutputConfig(scene, rrd=tmp_path / "run.rrd", queue_batches=5))
        pid = dead.pid
        assert pid is not None
        # Stopped outright, so that the test does not depend on how much a connection may hold.
        os.kill(pid, 19)
        n = 60
        for k in range(n):
            batch = [unit_piece(k)]
            start = time.perf_counter()
            dead.offer(batch)
            assert time.perf_counter() - start < 5.0
            eventually(lambda batch=batch: alive.offer(batch))
        assert dead.dropped >= n - 10, "the queue is bounded"
        start = time.perf_counter()
        assert dead.close(timeout_s=0.5) is False
        assert time.perf_counter() - start < 5.0
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        assert alive.close(timeout_s=30.0) is True
    curves, _, _ = read_back(tmp_path / "run.rrd")
    assert len(curves["error_um/linear"]) == n * 200


def unit_piece(k: int) -> Tracking:
    seq = np.arange(200) + 200 * k
    return Tracking("linear", seq, seq * 1e-3, seq * 0.0, seq * 0.0, seq * 0.0 + 1.0)


def test_drawing_steps_back_behind_those_it_watches(tmp_path: Path) -> None:
    """By a session of its own: where sessions share the processor, what is nice within one is nobody else's gain."""
    output = Output(OutputConfig(SceneConfig("demo/x", MODELS), rrd=tmp_path / "run.rrd"))
    try:
        pid = output.pid
        assert pid is not None
        nice, until = min(os.nice(0) + 5, 19), time.monotonic() + 30.0
        while os.getpriority(os.PRIO_PROCESS, pid) != nice and time.monotonic() < until:
            time.sleep(0.3)  # the child begins
        assert os.getsid(pid) == pid != os.getsid(0)
        assert os.getpriority(os.PRIO_PROCESS, pid) == nice
        group = Path(f"/proc/{pid}/autogroup")
        assert not group.exists() or group.read_text().strip()[-6:] in ("", "nice 5")
    finally:
        assert output.close(timeout_s=30.0) is True


def test_the_web_viewer_serves_its_page_on_this_machine_only() -> None:
    from dehyst.service.viewer.rerun_sink import page_of, spawn_viewer, viewer_command

    port, web_port = unused_port(), unused_port()
    command = viewer_command(port, web_port=web_port)
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    viewer, url = spawn_viewer(port, web_port=web_port)
    try:
        until = time.monotonic() + 30.0
        while True:
            try:
                with urllib.request.urlopen(page_of(url, web_port), timeout=5.0) as page:
                    text = page.read().decode()
                break
            except OSError:
                assert viewer.poll() is None
                assert time.monotonic() < until
                time.sleep(0.1)
    finally:
        viewer.terminate()
        viewer.wait(10.0)
    assert "rerun" in text.lower()


#: Killed while it writes a batch: four bytes that announce a thousand more, and one of them.
KILLED = """
import os, signal, struct, sys
from pathlib import Path
from dehyst.service.viewer import style
from dehyst.service.viewer.output import Output, OutputConfig
from dehyst.service.viewer.records import SceneConfig
if __name__ == "__main__":
    output = Output(OutputConfig(SceneConfig("demo/x", ("linear",)), rrd=Path(sys.argv[1])))
    print(output.pid, flush=True)
    os.write(output._queue._writer.fileno(), struct.pack("!i", 1000) + b"x")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_child_of_a_process_that_is_killed_in_the_middle_of_a_batch_ends(tmp_path: Path) -> None:
    program = tmp_path / "killed.py"
    program.write_text(KILLED, encoding="utf-8")
    said = subprocess.run(
        [sys.executable, str(program), str(tmp_path / "run.rrd")],
        stdout=subprocess.PIPE,
        text=True,
        timeout=90,
        check=False,
    )
    eventually(lambda: not Path(f"/proc/{int(said.stdout)}/exe").exists())
