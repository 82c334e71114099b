"""Records every sample to disk in a thread of its own, without delaying the caller.

``put`` only appends to a bounded queue and wakes the thread; if the queue is full, the samples are dropped and counted.
Within about a millisecond the thread appends them to a journal, which survives a crash of this process. Full journals
are converted to segments of bounded length, and the oldest segments are removed when all of them exceed their share of
the disk. A failing disk (full, read-only, gone) affects the recording only: samples are counted as lost, and after a
pause a new segment is started.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from dehyst.service.background.job import BackgroundJob
from dehyst.service.config.schema import Setting, check_bounds
from dehyst.service.storage import segments
from dehyst.service.storage.owner import FolderOwner

#: Folder inside that of a recorder for samples that the axis never handled; readers skip names with an underscore.
ASIDE: Final = "_aside"
#: Time between two looks whether the folder is still there, s.
_LOOK_S: Final = 0.2
#: Fewest samples per segment: each costs a process that closes it.
_LEAST_ROWS: Final = 1000
_SOME, _TIME = Setting(low=1), Setting(unit="s", low=0, above=True)


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """Settings of a recorder.

    Attributes
    ----------
    directory : folder of the segments; created if missing. Each axis needs its own.
    owner : stage and axis, as ``demo/x``, to which the folder belongs from then on; "" for any.
    segment_rows : samples per segment (600,000 are ten minutes at 1 kHz, about 15 MB).
    max_bytes : size of all files together; beyond it the oldest closed segments are removed. The journals of the
        newest two segments, 40 bytes per sample, count too; segments are shorter where they would take more than half.
    queue_samples : most samples that wait for the disk.
    flush_s : longest time that a sample waits in memory, s; about a millisecond if the disk keeps up, because `put`
        wakes the thread. Also the interval at which the recorder checks whether a segment has been closed.
    sync_s : longest time until a sample is synced to the disk, s; a power failure loses later samples.
    retry_s : pause after a failure of the disk, s.
    """

    directory: Path
    owner: str = ""
    segment_rows: Annotated[int, _SOME] = 600_000
    max_bytes: Annotated[int, _SOME] = 2_000_000_000
    queue_samples: Annotated[int, _SOME] = 100_000
    flush_s: Annotated[float, _TIME] = 0.03
    sync_s: Annotated[float, _TIME] = 5.0
    retry_s: Annotated[float, _TIME] = 5.0

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def rows(self) -> int:
        """Samples per segment: two journals, and what is made of one, fit into ``max_bytes``."""
        return min(self.segment_rows, max(_LEAST_ROWS, self.max_bytes // (4 * segments.RECORD.itemsize)))

    @property
    def journal_bytes(self) -> int:
        """Size of a full journal."""
        return self.rows * segments.RECORD.itemsize

    def aside(self) -> RecorderConfig:
        """Settings for samples that the axis does not handle: a folder inside this one, a tenth of its disk space."""
        return replace(self, directory=self.directory / ASIDE, max_bytes=max(1, self.max_bytes // 10))


class Recorder:
    """Records the samples of one axis. Thread-safe; use it as a context manager, or call `close`.

    A failing disk never raises: a directory that cannot be created or written shows in `counters` and is tried again.

    Parameters
    ----------
    index : number of the next sample in the order in which the axis handles them.
    hold_s : how long to wait for a process that still holds the folder, s. FieldError is then raised where it belongs
        to another. None: the folder is held from the first sample on, and another's shows in `counters`.
    """

    def __init__(self, config: RecorderConfig, index: int = 0, hold_s: float | None = None) -> None:
        self.config = config
        self._folder = FolderOwner(config.directory, segments.LOCK, config.owner)
        if hold_s is not None:
            self._folder.hold("recorder", hold_s)
        self.index = index
        self._queue: deque[segments.Rows] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = False
        names = ("offered", "written", "dropped", "lost", "errors", "segments", "removed", "bytes", "salvaged")
        self._counts = dict.fromkeys(names, 0)
        self._error = ""
        self._segment: segments.Journal | None = None
        # Whether there may be journals to close, and the number of the first one that is of this recorder.
        self._left_open, self._first = True, sys.maxsize
        self._closer: BackgroundJob | None = None
        # Records the samples that the axis does not handle; made with the first of them.
        self._aside: Recorder | None = None
        self._not_before = self._close_at = self._told_until = self._look_at = 0.0
        self._syncer = segments.Syncer(config.sync_s)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def put(self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]) -> bool:
        """Queue n samples (numbers or (n,) arrays, copied); ``reason`` is one word for all or one for each.

        Returns False if they were dropped, because the queue is full or the recorder is closed. Raises InputError on
        unequal lengths.
        """
        rows = segments.rows_of(seq, t_s, u_V, y_um, reason)
        with self._lock:
            self._counts["offered"] += len(rows)
            rows["index"] = self.index + np.arange(len(rows))
            self.index += len(rows)
            if self._stop or self._waiting + len(rows) > self.config.queue_samples:
                self._counts["dropped"] += len(rows)
                return False
            self._queue.append(rows)
            self._waiting += len(rows)
        # Wake the thread before its pause is over: a crash loses samples that are only in memory.
        self._wake.set()
        return True

    def put_aside(
        self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]
    ) -> bool:
        """As `put`, for samples that the axis does not handle.

        They go into a folder of their own: a restart or a replay must not learn them.
        """
        with self._lock:
            if self._aside is None and not self._stop:
                self._aside = Recorder(self.config.aside())
            aside = self._aside
        return aside is not None and aside.put(seq, t_s, u_V, y_um, reason)

    def counters(self) -> dict[str, Any]:
        """Counts for the status.

        Samples offered, written, dropped (queue full), lost (disk) and written ``aside``; segments closed and removed;
        bytes written to journals and segments; the last error.
        ``degraded`` is True from a failure of the disk until the next batch is written.
        """
        with self._lock:
            aside = 0 if self._aside is None else self._aside.counters()["written"]
            return {
                **self._counts, "waiting": self._waiting, "aside": aside,
                "degraded": bool(self._error), "error": self._error,
            }  # fmt: skip

    def close(self, timeout_s: float = 10.0) -> bool:
        """Write the queue, close the segment, end the thread. Returns False if that takes longer than ``timeout_s``."""
        with self._lock:
            self._stop = True
        self._wake.set()
        self._thread.join(timeout_s)
        if self._aside is not None:
            self._aside.close(timeout_s)
        return not self._thread.is_alive()

    def rebase(self, index: int) -> None:
        """Set the index of the next sample, after the axis has continued from another state."""
        with self._lock:
            self.index = index

    def _run(self) -> None:
        while True:
            # In this order: samples queued meanwhile wake the thread again; those queued before the stop are written.
            self._wake.clear()
            stop = self._stop
            taken = self._take()
            if taken:
                self._write(np.concatenate(taken))
            elif stop:
                break
            self._look_after_closing()
            if not stop:
                self._wake.wait(self.config.flush_s)
        self._leave_segment()
        self._close_all()
        self._folder.release()

    def _take(self) -> list[segments.Rows]:
        with self._lock:
            taken = list(self._queue)
            self._queue.clear()
            self._waiting = 0
        return taken

    def _count(self, **more: int) -> None:
        with self._lock:
            for name, value in more.items():
                self._counts[name] += value

    def _failed(self, error: OSError | str) -> float:
        """Count an error and tell it; returns when to try again, by ``time.monotonic``, s."""
        with self._lock:
            self._counts["errors"] += 1
            self._error = error if isinstance(error, str) else error.strerror or str(error)
        return time.monotonic() + self.config.retry_s

    def _begin_segment(self) -> segments.Journal:
        directory = self.config.directory
        self._folder.take()
        self._count(removed=segments.make_room(directory, self.config.max_bytes, self.config.journal_bytes))
        number = segments.next_number(directory)
        self._first = min(self._first, number)
        return segments.Journal(segments.journal_of(directory, number))

    def _write(self, rows: segments.Rows) -> None:
        # After a failure: pause, except at the end, where one more attempt costs nothing.
        if time.monotonic() < self._not_before and not self._stop:
            self._count(lost=len(rows))
            return
        done = 0
        self._look_for_folder()
        try:
            while done < len(rows):
                if self._segment is None:
                    self._segment = self._begin_segment()
                stop = min(len(rows), done + self.config.rows - self._segment.rows)
                written = self._segment.write(rows[done:stop])
                self._count(written=stop - done, bytes=written)
                done = stop
                if self._segment.rows >= self.config.rows:
                    self._leave_segment()
            if self._segment is not None:
                self._syncer.look(self._segment)
            if time.monotonic() >= max(self._not_before, self._told_until):
                with self._lock:
                    self._error = ""
        except OSError as error:
            self._not_before = self._failed(error)
            self._count(lost=len(rows) - done)
            self._leave_segment()

    def _leave_segment(self) -> None:
        """Close the open journal; its rows are converted to Parquet later."""
        if self._segment is not None:
            self._segment.close()
            self._segment, self._left_open = None, True

    def _look_for_folder(self) -> None:
        """Begin anew where the folder was removed or renamed; the recording is degraded for a while, but goes on."""
        now = time.monotonic()
        if self._segment is None or now < self._look_at:
            return
        self._look_at = now + _LOOK_S
        if self._segment.vanished:
            self._leave_segment()
            why = f"{self.config.directory} vanished while it was recorded into; it is made anew"
            self._told_until = self._failed(why)

    def _look_after_closing(self) -> None:
        """Convert the journals that are full, or that a crash or a failing disk left."""
        closer, at_s = self._closer, max(self._not_before, self._close_at)
        if closer is None and self._left_open and self._segment is not None and time.monotonic() >= at_s:
            self._left_open = False
            self._closer = segments.closing(self.config.directory, self._segment.path)
        elif closer is not None and not closer.running:
            self._closer = None
            self._take_result(lambda: segments.closed_by(closer))

    def _take_result(self, closed: Callable[[], list[Path]]) -> None:
        """``closed`` : returns the segments that were closed; raises OSError."""
        try:
            made = closed()
            own = sum(segments.number_of(path) >= self._first for path in made)
            written = sum(path.stat().st_size for path in made)
            removed = segments.make_room(self.config.directory, self.config.max_bytes)
            self._count(bytes=written, segments=own, salvaged=len(made) - own, removed=removed)
        except OSError as error:
            # An open journal can be read as it is: only the closing waits, the recording goes on.
            self._left_open = True
            self._close_at = self._told_until = self._failed(error)

    def _close_all(self) -> None:
        """Close what is open, in this thread: a process takes longer to start, and one that runs has stepped back."""
        if self._closer is not None:
            self._closer.cancel()
        if not segments.left_open(self.config.directory):
            return

        def closed() -> list[Path]:
            # One that has recorded nothing holds no folder yet, and leaves another's alone.
            self._folder.take()
            return segments.close_left_open(self.config.directory)

        self._take_result(closed)
