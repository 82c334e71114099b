"""The recorder: every sample comes back, a crash loses no segment, a full disk harms nothing but the recording."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from adaptive.errors import InputError
from service import recorder_files
from service.recorder import Recorder, RecorderConfig
from service.recorder_files import segments
from sim.recordings import check, read

ROOT = Path(__file__).resolve().parents[2]


def config(directory: Path, **more: object) -> RecorderConfig:
    return RecorderConfig(directory, flush_s=0.02, retry_s=0.05, **more)  # type: ignore[arg-type]


def block(start: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    seq = np.arange(start, start + n)
    return seq, seq * 0.001, np.sin(seq * 0.01), 10.0 * np.sin(seq * 0.01 - 0.1)


def wait_for(condition: object, timeout_s: float = 10.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


def test_what_was_put_is_read_back_to_the_last_bit_across_segments(tmp_path: Path) -> None:
    with Recorder(config(tmp_path, segment_rows=700)) as recorder:
        for start in range(0, 2000, 100):
            assert recorder.put(*block(start, 100), reason="learnt" if start < 1000 else ["redundant"] * 100)
    counters = recorder.counters()
    assert (counters["offered"], counters["written"], counters["dropped"], counters["lost"]) == (2000, 2000, 0, 0)
    assert counters["segments"] == len(segments(tmp_path)) == 3
    recording = read(tmp_path)
    seq, t_s, u_V, y_um = block(0, 2000)
    assert recording.seq is not None
    assert recording.reason is not None
    np.testing.assert_array_equal(recording.seq, seq)
    np.testing.assert_array_equal(recording.t_s, t_s)
    np.testing.assert_array_equal(recording.u_V, u_V)
    np.testing.assert_array_equal(recording.y_um, y_um)
    assert recording.reason.tolist() == ["learnt"] * 1000 + ["redundant"] * 1000
    assert [f.kind for f in check(recording)] == ["note"]


def test_refused_samples_are_kept_as_they_came(tmp_path: Path) -> None:
    with Recorder(config(tmp_path)) as recorder:
        recorder.put(*block(0, 300), reason="learnt")
        recorder.put(300, 0.3, 1.0, float("nan"), "not_finite")
    recording = read(tmp_path)
    assert recording.reason is not None
    assert np.isnan(recording.y_um[-1])
    assert recording.reason[-1] == "not_finite"


def test_the_oldest_segments_go_when_the_disks_share_is_used_up(tmp_path: Path) -> None:
    with Recorder(config(tmp_path, segment_rows=1000)) as recorder:
        recorder.put(*block(0, 1000), reason="learnt")
    size = segments(tmp_path)[0].stat().st_size
    with Recorder(config(tmp_path, segment_rows=1000, max_bytes=int(3.5 * size))) as recorder:
        for start in range(1000, 10_000, 1000):
            recorder.put(*block(start, 1000), reason="learnt")
    kept = segments(tmp_path)
    assert sum(path.stat().st_size for path in kept) <= 3.5 * size
    assert [path.stem for path in kept][-1] == "segment-000010"
    assert recorder.counters()["removed"] == 10 - len(kept)
    recording = read(tmp_path)
    assert recording.seq is not None
    assert recording.seq[-1] == 9999
    assert np.all(np.diff(recording.seq) == 1)


def test_a_full_queue_drops_and_counts_and_never_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hold = threading.Event()
    write = recorder_files.OpenSegment.write

    def slow(self: recorder_files.OpenSegment, rows: recorder_files.Rows) -> None:
        hold.wait(10.0)
        write(self, rows)

    monkeypatch.setattr(recorder_files.OpenSegment, "write", slow)
    recorder = Recorder(config(tmp_path, queue_samples=500))
    try:
        recorder.put(*block(0, 100), reason="learnt")
        wait_for(lambda: recorder.counters()["waiting"] == 0)
        start = time.monotonic()
        taken = [recorder.put(*block(100 * k, 100), reason="learnt") for k in range(1, 21)]
        assert time.monotonic() - start < 1.0
        assert taken == [True] * 5 + [False] * 15
    finally:
        hold.set()
        assert recorder.close()
    counters = recorder.counters()
    assert (counters["offered"], counters["written"], counters["dropped"]) == (2100, 600, 1500)
    assert len(read(tmp_path)) == 600
    assert not recorder.put(*block(0, 1), reason="late")


@pytest.mark.parametrize("where", ["open", "write", "convert"])
def test_a_full_disk_degrades_the_recording_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    full = threading.Event()

    def failing(real: object) -> object:
        def call(*args: object, **kwargs: object) -> object:
            if full.is_set():
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*args, **kwargs)  # type: ignore[operator]

        return call

    if where == "convert":
        monkeypatch.setattr(recorder_files, "convert", failing(recorder_files.convert))
    else:
        name = {"open": "__init__", "write": "write"}[where]
        monkeypatch.setattr(recorder_files.OpenSegment, name, failing(getattr(recorder_files.OpenSegment, name)))
    with Recorder(config(tmp_path, segment_rows=200)) as recorder:
        recorder.put(*block(0, 300), reason="learnt")
        wait_for(lambda: recorder.counters()["written"] == 300)
        full.set()
        recorder.put(*block(300, 300), reason="learnt")
        wait_for(lambda: recorder.counters()["degraded"])
        assert "No space left" in recorder.counters()["error"]
        assert recorder.put(*block(600, 100), reason="learnt")
        full.clear()
        time.sleep(0.1)
        recorder.put(*block(700, 300), reason="learnt")
        wait_for(lambda: not recorder.counters()["degraded"])
    counters = recorder.counters()
    assert counters["errors"] >= 1
    assert counters["offered"] == counters["written"] + counters["lost"] + counters["dropped"]
    recording = read(tmp_path)
    assert recording.seq is not None
    assert set(range(300)) | set(range(700, 1000)) <= set(recording.seq.tolist())
    assert len(recording) == counters["written"]


def test_a_directory_that_cannot_be_made_is_no_reason_to_fall(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with Recorder(config(tmp_path / "file" / "here")) as recorder:
        recorder.put(*block(0, 10), reason="learnt")
        wait_for(lambda: recorder.counters()["lost"] == 10)
        assert recorder.counters()["degraded"]


def test_two_recorders_do_not_share_a_directory(tmp_path: Path) -> None:
    with Recorder(config(tmp_path)) as first:
        first.put(*block(0, 300), reason="learnt")
        wait_for(lambda: first.counters()["written"] == 300)
        with Recorder(config(tmp_path)) as second:
            second.put(*block(0, 10), reason="learnt")
            wait_for(lambda: second.counters()["lost"] == 10)
            assert "another process records" in second.counters()["error"]
    assert len(read(tmp_path)) == 300


def test_a_killed_process_leaves_a_stream_that_the_next_start_closes(tmp_path: Path) -> None:
    program = (
        "import sys, time, numpy as np\n"
        "from pathlib import Path\n"
        "from service.recorder import Recorder, RecorderConfig\n"
        "r = Recorder(RecorderConfig(Path(sys.argv[1]), flush_s=0.02))\n"
        "for k in range(1000):\n"
        "    r.put(np.arange(10 * k, 10 * k + 10), np.zeros(10), np.zeros(10), np.zeros(10), 'learnt')\n"
        "    time.sleep(0.001)\n"
        "    if r.counters()['written'] > 500: print(r.counters()['written'], flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE)
    assert process.stdout is not None
    written = int(process.stdout.readline())
    os.kill(process.pid, signal.SIGKILL)
    process.stdout.close()
    process.wait(10)
    assert segments(tmp_path) == []
    (tmp_path / "segment-000099.part").write_bytes(b"half a file")
    with Recorder(config(tmp_path)) as recorder:
        recorder.put(20_000, 20.0, 0.0, 0.0, "learnt")
    assert recorder.counters()["salvaged"] == 1
    recording = read(tmp_path)
    assert recording.seq is not None
    assert recording.seq[-1] == 20_000
    assert np.all(np.diff(recording.seq[:-1]) == 1)
    assert len(recording) - 1 >= written
    assert not list(tmp_path.glob("*.part"))


def test_a_stream_cut_anywhere_keeps_its_whole_batches(tmp_path: Path) -> None:
    stream = recorder_files.OpenSegment(tmp_path / "segment-000001.arrows")
    ends = []
    for k in range(3):
        seq, t_s, u_V, y_um = block(50 * k, 50)
        stream.write(recorder_files.Rows(seq, t_s, u_V, y_um, ["learnt"] * 50))
        ends.append(stream.path.stat().st_size)
    stream.abandon()
    whole = stream.path.read_bytes()
    for cut in (*ends, ends[0] + 9, ends[1] - 1, ends[2] - 40, 20, 0):
        path = tmp_path / f"segment-{100 + cut:06d}.arrows"
        path.write_bytes(whole[:cut])
        expected = 50 * sum(end <= cut for end in ends)
        made = recorder_files.convert(path)
        assert (0 if made is None else len(read(made, None))) == expected
        assert not path.exists()


def test_bad_configuration_and_bad_rows(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="segment_rows: got 0"):
        config(tmp_path, segment_rows=0)
    with Recorder(config(tmp_path)) as recorder, pytest.raises(InputError, match="y_um: got 1 values, expected 2"):
        recorder.put([1, 2], [0.0, 0.1], [1.0, 2.0], [1.0], "learnt")
