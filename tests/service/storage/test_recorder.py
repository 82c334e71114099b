"""The recorder: every sample comes back, a crash loses no segment, a full disk harms nothing but the recording."""

from __future__ import annotations

import contextlib
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

from dehyst.service.background.job import BackgroundJob
from dehyst.service.storage import segments as recorder_files
from dehyst.service.storage.recorder import ASIDE, Recorder, RecorderConfig
from dehyst.service.storage.segments import Journal, Rows, read_journal, rows_of, segments
from dehyst.sim.recordings import check, read
from tests.service.axes import loop_of
from tests.service.living import eventually
from tests.service.storage.test_stored_files import make_axis
from tests.service.storage.test_stored_files import recording as arriving

ROOT = Path(__file__).resolve().parents[3]


def config(directory: Path, **more: object) -> RecorderConfig:
    return RecorderConfig(directory, flush_s=0.02, retry_s=0.05, **more)  # type: ignore[arg-type]


def block(start: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    seq = np.arange(start, start + n)
    return seq, seq * 0.001, np.sin(seq * 0.01), 10.0 * np.sin(seq * 0.01 - 0.1)


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


def written_rows(directory: Path) -> int:
    """Rows in the files of the open segments, as a killed process would leave them."""
    return sum(len(read_journal(path)) for path in directory.glob("*.journal"))


def test_what_was_put_is_in_the_file_at_once_however_long_the_disk_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the pause of the thread that writes nor the disk's own sync may keep samples in memory."""
    hold = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda fd: hold.wait(60.0))
    with Recorder(RecorderConfig(tmp_path, flush_s=60.0, sync_s=1e-3)) as recorder:
        try:
            for k in range(100):
                recorder.put(*block(5 * k, 5), reason="learnt")
                eventually(lambda k=k: recorder.counters()["written"] == 5 * (k + 1))
            assert written_rows(tmp_path) == 500
        finally:
            hold.set()
    assert len(read(tmp_path)) == 500


def test_the_oldest_segments_go_when_the_disks_share_is_used_up_journals_included(tmp_path: Path) -> None:
    share = 160_000
    sizes = []
    with Recorder(config(tmp_path, segment_rows=100_000, max_bytes=share)) as recorder:
        rows = recorder.config.rows
        assert rows == share // 160
        for start in range(0, 4 * rows, rows // 5):
            recorder.put(*block(start, rows // 5), reason="learnt")
            # As in life, where a segment takes minutes: the one before is closed by then.
            eventually(lambda done=start // rows: recorder.counters()["segments"] >= done)
            sizes.append(on_disk(tmp_path))
        assert recorder.counters()["removed"] > 0
    # A segment that is being closed is there twice for a moment.
    assert max(sizes) <= share + 40 * rows
    assert on_disk(tmp_path) <= share
    recording = read(tmp_path)
    assert recording.seq is not None
    assert recording.seq[-1] == 4 * rows - 1
    assert np.all(np.diff(recording.seq) == 1)


def on_disk(folder: Path) -> int:
    """Bytes of all files of a recording, without those that go while it is counted."""
    total = 0
    for path in folder.glob("*segment-*"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def test_a_full_queue_drops_and_counts_and_never_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hold = threading.Event()
    write = Journal.write

    def slow(self: Journal, rows: Rows) -> int:
        hold.wait(10.0)
        return write(self, rows)

    monkeypatch.setattr(Journal, "write", slow)
    recorder = Recorder(config(tmp_path, queue_samples=500))
    try:
        recorder.put(*block(0, 100), reason="learnt")
        eventually(lambda: recorder.counters()["waiting"] == 0)
        start = time.monotonic()
        taken = [recorder.put(*block(100 * k, 100), reason="learnt") for k in range(1, 21)]
        assert time.monotonic() - start < 5.0
        assert taken == [True] * 5 + [False] * 15
    finally:
        hold.set()
        assert recorder.close()
    counters = recorder.counters()
    assert (counters["offered"], counters["written"], counters["dropped"]) == (2100, 600, 1500)
    assert len(read(tmp_path)) == 600
    assert not recorder.put(*block(0, 1), reason="late")


@pytest.mark.parametrize("where", ["open", "write", "close"])
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

    if where == "close":
        monkeypatch.setattr(BackgroundJob, "_work", failing(BackgroundJob._work))
    else:
        name = {"open": "__init__", "write": "write"}[where]
        monkeypatch.setattr(Journal, name, failing(getattr(Journal, name)))
    with Recorder(config(tmp_path, segment_rows=200)) as recorder:
        recorder.put(*block(0, 300), reason="learnt")
        eventually(lambda: recorder.counters()["written"] == 300)
        full.set()
        recorder.put(*block(300, 250), reason="learnt")
        eventually(lambda: recorder.counters()["degraded"])
        assert "No space left" in recorder.counters()["error"]
        assert recorder.put(*block(600, 100), reason="learnt")
        full.clear()
        again = iter(range(10_000, 1_000_000, 10))
        eventually(
            lambda: recorder.put(*block(next(again), 10), reason="learnt") and not recorder.counters()["degraded"]
        )
        recorder.put(*block(700, 300), reason="learnt")
    counters = recorder.counters()
    assert counters["errors"] >= 1
    assert counters["offered"] == counters["written"] + counters["lost"] + counters["dropped"]
    recording = read(tmp_path)
    assert recording.seq is not None
    assert set(range(300)) | set(range(700, 1000)) <= set(recording.seq.tolist())
    assert len(recording) == counters["written"]


def test_a_journal_that_cannot_be_closed_costs_no_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of a killed instance may hold it; a failing disk shows in what is written itself."""
    with contextlib.closing(Journal(recorder_files.journal_of(tmp_path, 1))) as left:
        left.write(rows_of(*block(0, 100), reason="learnt"))
    failed = type("Failed", (), {"running": False, "result": {"error": "held by another"}, "cancel": lambda self: None})
    monkeypatch.setattr(recorder_files, "closing", lambda directory, but: failed())
    with Recorder(RecorderConfig(tmp_path, flush_s=0.02, retry_s=60.0), 100) as recorder:
        for start in range(100, 300, 10):
            recorder.put(*block(start, 10), reason="learnt")
            eventually(lambda start=start: recorder.counters()["written"] == start - 90)
            if start == 200:
                eventually(lambda: "held by another" in recorder.counters()["error"])
        counters = recorder.counters()
    assert (counters["lost"], counters["errors"], counters["degraded"]) == (0, 1, True)
    assert len(read(tmp_path)) == 300


def test_a_journal_that_another_process_has_closed_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (1, 2):
        with contextlib.closing(Journal(recorder_files.journal_of(tmp_path, number))) as left:
            left.write(rows_of(*block(100 * number, 100), reason="learnt"))
    convert = recorder_files.convert

    def twice(journal: Path) -> Path | None:
        if recorder_files.number_of(journal) == 1:
            convert(journal)
        return convert(journal)

    monkeypatch.setattr(recorder_files, "convert", twice)
    assert len(recorder_files.close_left_open(tmp_path)) == 1
    assert len(read(tmp_path)) == 200


@pytest.mark.parametrize("more", [0, 1], ids=["no sample comes", "a sample comes"])
def test_a_killed_process_leaves_a_stream_that_the_next_run_closes(tmp_path: Path, more: int) -> None:
    program = (
        "import sys, time, numpy as np\n"
        "from pathlib import Path\n"
        "from dehyst.service.storage.recorder import Recorder, RecorderConfig\n"
        "r = Recorder(RecorderConfig(Path(sys.argv[1]), flush_s=0.02))\n"
        "for k in range(1000):\n"
        "    seq = np.arange(10 * k, 10 * k + 10)\n"
        "    r.put(seq, 1e-3 * seq, np.zeros(10), np.zeros(10), 'learnt')\n"
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
        if more:
            recorder.put(20_000, 20.0, 0.0, 0.0, "learnt")
    assert recorder.counters()["salvaged"] == 1
    recording = read(tmp_path)
    assert recording.seq is not None
    assert bool(recording.seq[-1] == 20_000) is bool(more)
    assert np.all(np.diff(recording.seq[: len(recording) - more]) == 1)
    assert len(recording) - more >= written
    assert not list(tmp_path.glob("*.part"))


def test_a_journal_cut_anywhere_keeps_its_whole_rows(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "segment-000001.journal")
    for k in range(3):
        seq, t_s, u_V, y_um = block(50 * k, 50)
        rows = rows_of(seq, t_s, u_V, y_um, ["learnt", f"word-{k}"] * 25)
        rows["index"] = seq
        journal.write(rows)
    journal.close()
    whole = journal.path.read_bytes()
    for cut in (len(whole), len(whole) - 1, len(whole) - 39, 16 + 40 * 30 + 7, 17, 16, 3, 0):
        path = tmp_path / f"segment-{100 + cut:06d}.journal"
        path.write_bytes(whole[:cut] + bytes(400))  # the disk may have been given more than was written
        rows = read_journal(path)
        assert len(rows) <= max(0, cut - 16) // 40
        assert len(rows) >= max(0, cut - 16) // 40 - 4  # and those that define words
        assert rows["index"].tolist() == rows["seq"].tolist() == list(range(len(rows)))
        assert rows["reason"].tolist() == [("learnt", f"word-{k // 50}")[k % 2] for k in range(len(rows))]
        made = recorder_files.convert(path)
        assert (0 if made is None else len(read(made, None))) == len(rows)
        assert not path.exists()


def test_a_restart_finds_what_came_behind_its_checkpoint_across_segments(tmp_path: Path) -> None:
    with Recorder(config(tmp_path, segment_rows=500), index=7) as recorder:
        for start in range(0, 1200, 100):
            recorder.put(*block(start, 100), reason="learnt")
            time.sleep(0.03)
    behind = recorder_files.rows_behind(tmp_path, 7 + 1100, "")
    assert behind is not None
    assert behind.seq.tolist() == list(range(1100, 1200))
    assert recorder_files.rows_behind(tmp_path, 7 + 1200, "") is None
    assert recorder_files.rows_behind(tmp_path, 3, "") is None
    # One that was killed right after it had opened a segment.
    recorder_files.journal_of(tmp_path, 900).write_bytes(recorder_files.HEADER)
    assert recorder_files.rows_behind(tmp_path, 7 + 1200, "") is None
    # An instance that took over an older state handles some samples again, and what follows is of its count.
    with Recorder(config(tmp_path), index=1150) as recorder:
        recorder.put(*block(5000, 50), reason="learnt")
        eventually(lambda: recorder.counters()["written"] == 50)
        again = recorder_files.rows_behind(tmp_path, 1100, "")
    assert again is not None
    assert again.seq.tolist()[-1] == 5049


def test_what_was_dropped_before_it_was_handled_is_recorded_apart(tmp_path: Path) -> None:
    axis = make_axis(queue_samples=100)
    with Recorder(config(tmp_path)) as recorder:
        loop = loop_of(axis, recorder)  # not started yet: nobody takes
        offered = [loop.offer(arriving(first, 30)) for first in range(0, 150, 30)]
        assert offered == [True, True, True, False, False]
        loop.start()
        loop.close()
        eventually(lambda: recorder.counters()["written"] == 90 and recorder.counters()["aside"] == 60)
        # They count for nothing by which a restart goes on.
        assert recorder.index == axis.sequence.received == 90
        behind = recorder_files.rows_behind(tmp_path, 60, "")
        assert behind is not None
        assert behind.seq.tolist() == list(range(60, 90))
    handled, dropped = read(tmp_path), read(tmp_path / ASIDE)
    assert handled.seq is not None
    assert dropped.seq is not None
    assert dropped.reason is not None
    assert handled.seq.tolist() == list(range(90))
    assert dropped.seq.tolist() == list(range(90, 150))
    assert set(dropped.reason) == {"dropped"}
    np.testing.assert_array_equal(dropped.y_um, arriving(90, 60).y_um)
    assert not recorder.put_aside(*block(0, 1), reason="dropped")
