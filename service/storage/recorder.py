"""Every sample onto disk, in a thread of its own, without ever holding up who hands it over.

``put`` only appends to a bounded queue and wakes the thread; where the queue is full the samples are dropped and
counted. Within about a millisecond the thread appends them to a journal, which outlives this process. It has a segment
of bounded length made of each journal, and removes the oldest when all of them outgrow their share of the disk. A disk
that fails (full, read-only, gone) degrades the recording and nothing else: samples are counted as lost, and a new
segment is tried again after a while.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.protocol.errors import FieldError
from service.storage.journal import Journal, Rows, Syncer
from service.storage.segments import Closer, claim, journal_of, left_open, make_room, next_number

# --- How a recorder writes.


#: Folder, in that of a recorder, for samples that were never handled; what reads a folder passes over such names.
ASIDE: Final = "_aside"


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """How a recorder writes.

    Attributes
    ----------
    directory : where the segments go; made if missing. One axis has one directory.
    segment_rows : samples a segment holds before it is closed (600,000 are ten minutes at 1 kHz, some 15 MB).
    max_bytes : all closed segments together, bytes; the oldest are removed beyond that. The journals of the newest two
    segments, 40 bytes a sample, come on top.
    queue_samples : samples that may wait for the disk.
    flush_s : longest time that a sample waits in memory, s. It is about a millisecond where the disk keeps up: handing
    samples over wakes who writes them. And how often it is looked whether a segment is closed.
    sync_s : longest time that a sample waits for the disk itself, s: what a cut of the power loses.
    retry_s : pause after a failure of the disk, s.
    """

    directory: Path
    segment_rows: int = 600_000
    max_bytes: int = 2_000_000_000
    queue_samples: int = 100_000
    flush_s: float = 0.03
    sync_s: float = 5.0
    retry_s: float = 5.0

    def __post_init__(self) -> None:
        for name, least in (("segment_rows", 1), ("max_bytes", 1), ("queue_samples", 1)):
            value = getattr(self, name)
            if value < least:
                raise FieldError(name, value, f"a whole number of at least {least}")
        for name in ("flush_s", "sync_s", "retry_s"):
            if not getattr(self, name) > 0.0:
                raise FieldError(name, getattr(self, name), "a positive time in s")

    def aside(self) -> RecorderConfig:
        """For samples that nobody handles: beside the others, with a tenth of their share of the disk on top of it."""
        return replace(self, directory=self.directory / ASIDE, max_bytes=max(1, self.max_bytes // 10))


class Recorder:
    """Writes the samples of one axis. Thread-safe; use as a context manager, or call :meth:`close`.

    Never raises after construction; the constructor raises InputError on a bad configuration only. A directory
    that cannot be made or written to shows in :meth:`counters` and is tried again.
    """

    def __init__(self, config: RecorderConfig, index: int = 0) -> None:
        self.config = config
        #: Number of the next sample in the order in which the axis handles them.
        self.index = index
        self._queue: deque[tuple[int, Rows]] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = False
        self._counts = {"offered": 0, "written": 0, "dropped": 0, "lost": 0, "errors": 0, "segments": 0, "removed": 0}
        self._salvaged = 0
        self._error = ""
        self._segment: Journal | None = None
        self._claim: IO[bytes] | None = None
        # Whether journals may lie there that are to be closed; whether one of them is this recorder's own.
        self._left_open, self._own = True, False
        self._closer: Closer | None = None
        # Writes what nobody handles into a folder of its own, from the first such sample on.
        self._aside: Recorder | None = None
        self._not_before = 0.0
        self._syncer = Syncer(config.sync_s)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def put(self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]) -> bool:
        """Hand over n samples (numbers or (n,)); ``reason`` is one word for all or one for each.

        Returns False where they were dropped because the queue is full or the recorder is closed. Raises InputError
        on unequal lengths. The arrays are copied.
        """
        numbers = np.array(seq, dtype=np.int64).reshape(-1)
        t, u, y = (np.array(c, dtype=np.float64).reshape(-1) for c in (t_s, u_V, y_um))
        rows = Rows(numbers, t, u, y, [reason] * len(numbers) if isinstance(reason, str) else list(reason))
        with self._lock:
            self._counts["offered"] += len(rows)
            first, self.index = self.index, self.index + len(rows)
            if self._stop or self._waiting + len(rows) > self.config.queue_samples:
                self._counts["dropped"] += len(rows)
                return False
            self._queue.append((first, rows))
            self._waiting += len(rows)
        # What a killed process has only in memory is lost: the thread takes it now and not when its pause is over.
        self._wake.set()
        return True

    def put_aside(
        self, seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]
    ) -> bool:
        """As :meth:`put`, for samples that nobody handles: into a folder of their own, since they have no place in the
        order in which a restart and a replay go through the others.
        """
        with self._lock:
            if self._aside is None and not self._stop:
                self._aside = Recorder(self.config.aside())
            aside = self._aside
        return aside is not None and aside.put(seq, t_s, u_V, y_um, reason)

    def counters(self) -> dict[str, Any]:
        """Samples offered, written, dropped (queue full) and lost (disk); segments closed and removed; the last error;
        samples written ``aside``. ``degraded`` is True from a failure of the disk until the next batch is written.
        """
        with self._lock:
            return {
                **self._counts,
                "salvaged": self._salvaged,
                "waiting": self._waiting,
                "aside": 0 if self._aside is None else self._aside.counters()["written"],
                "degraded": bool(self._error),
                "error": self._error,
            }

    def close(self, timeout_s: float = 10.0) -> bool:
        """Write what waits, close the segment, end the thread. False where that did not end within the time."""
        with self._lock:
            self._stop = True
        self._wake.set()
        self._thread.join(timeout_s)
        if self._aside is not None:
            self._aside.close(timeout_s)
        return not self._thread.is_alive()

    def rebase(self, index: int) -> None:
        """The next sample handed over is the ``index``-th that its axis handles: it has gone on from another state."""
        with self._lock:
            self.index = index

    def _run(self) -> None:
        while True:
            # In this order: what is handed over meanwhile wakes it once more, and what came before the stop is written.
            self._wake.clear()
            stop = self._stop
            taken = self._take()
            if taken is not None:
                self._write(*taken)
            elif stop:
                break
            self._look_after_closing()
            if not stop:
                self._wake.wait(self.config.flush_s)
        if self._segment is not None:
            self._segment.close()
        self._close_all()
        if self._claim is not None:
            self._claim.close()

    def _take(self) -> tuple[Rows, NDArray[np.int64]] | None:
        with self._lock:
            parts = list(self._queue)
            self._queue.clear()
            self._waiting = 0
        if not parts:
            return None
        index = np.concatenate([first + np.arange(len(rows)) for first, rows in parts])
        return Rows.joined([rows for _, rows in parts]), index

    def _count(self, **more: int) -> None:
        with self._lock:
            for name, value in more.items():
                self._counts[name] += value

    def _failed(self, error: OSError) -> None:
        self._not_before = time.monotonic() + self.config.retry_s
        with self._lock:
            self._counts["errors"] += 1
            self._error = f"{error.strerror or error}"

    def _begin_segment(self) -> Journal:
        directory = self.config.directory
        directory.mkdir(parents=True, exist_ok=True)
        if self._claim is None:
            self._claim = claim(directory)
        self._count(removed=make_room(directory, self.config.max_bytes))
        return Journal(journal_of(directory, next_number(directory)))

    def _write(self, rows: Rows, index: NDArray[np.int64]) -> None:
        # After a failure nothing is tried for a while, except at the end: a last chance costs nobody anything.
        if time.monotonic() < self._not_before and not self._stop:
            self._count(lost=len(rows))
            return
        done = 0
        try:
            while done < len(rows):
                if self._segment is None:
                    self._segment = self._begin_segment()
                stop = min(len(rows), done + self.config.segment_rows - self._segment.rows)
                self._segment.write(rows.part(done, stop), index[done:stop])
                self._count(written=stop - done)
                done = stop
                if self._segment.rows >= self.config.segment_rows:
                    self._segment.close()
                    self._segment, self._left_open, self._own = None, True, True
            if self._segment is not None:
                self._syncer.look(self._segment)
            if time.monotonic() >= self._not_before:
                with self._lock:
                    self._error = ""
        except OSError as error:
            self._failed(error)
            self._count(lost=len(rows) - done)
            if self._segment is not None:
                # What this journal already holds is made into Parquet later.
                self._segment.close()
                self._segment, self._left_open = None, True

    def _look_after_closing(self) -> None:
        """Have segments made of the journals that are full, or that a crash or a failing disk left behind."""
        closer = self._closer
        if closer is None and self._left_open and self._segment is not None and time.monotonic() >= self._not_before:
            self._left_open = False
            try:
                self._closer = Closer(self.config.directory, self._segment.path)
            except OSError as error:
                self._left_open = True
                self._failed(error)
        elif closer is not None and not closer.running:
            self._closer = None
            self._take_result(closer)

    def _take_result(self, closer: Closer) -> None:
        try:
            made = closer.result()
            if self._own:
                self._count(segments=made)
            else:
                self._salvaged += made
            self._count(removed=make_room(self.config.directory, self.config.max_bytes))
        except OSError as error:
            self._left_open = True
            self._failed(error)

    def _close_all(self) -> None:
        """At the end: wait for what is being closed, then close the rest."""
        if self._closer is not None:
            self._take_result(self._closer)
        if self._claim is None and not self._claimed_what_a_crash_left():
            return
        self._own = self._own or self._segment is not None
        try:
            self._take_result(Closer(self.config.directory, None))
        except OSError as error:
            self._failed(error)

    def _claimed_what_a_crash_left(self) -> bool:
        """Whether journals lie there, though no sample came by which the folder would have become this recorder's."""
        if not left_open(self.config.directory):
            return False
        try:
            self._claim = claim(self.config.directory)
        except OSError:
            return False  # another's, or of a disk that nothing can be written to
        return True
