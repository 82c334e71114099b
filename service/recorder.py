"""Every sample onto disk, in a thread of its own, without ever holding up who hands it over.

``put`` only appends to a bounded queue; where the queue is full the samples are dropped and counted. The thread
gathers them into batches, the batches into segments of bounded length, and removes the oldest segment when all of
them together outgrow their share of the disk. A disk that fails (full, read-only, gone) degrades the recording and
nothing else: samples are counted as lost, and a new segment is tried again after a while.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from service.errors import FieldError
from service.recorder_files import OPEN, OpenSegment, Rows, claim, make_room, next_number, salvage


@dataclass(frozen=True, slots=True)
class RecorderConfig:
    """How a recorder writes.

    Attributes
    ----------
    directory : where the segments go; made if missing. One axis has one directory.
    segment_rows : samples a segment holds before it is closed (600,000 are ten minutes at 1 kHz, some 15 MB).
    max_bytes : all closed segments together, bytes; the oldest are removed beyond that.
    queue_samples : samples that may wait for the disk.
    flush_s : longest time that a sample waits in memory, s.
    retry_s : pause after a failure of the disk, s.
    """

    directory: Path
    segment_rows: int = 600_000
    max_bytes: int = 2_000_000_000
    queue_samples: int = 100_000
    flush_s: float = 0.5
    retry_s: float = 5.0

    def __post_init__(self) -> None:
        for name, least in (("segment_rows", 1), ("max_bytes", 1), ("queue_samples", 1)):
            value = getattr(self, name)
            if value < least:
                raise FieldError(name, value, f"a whole number of at least {least}")
        for name in ("flush_s", "retry_s"):
            if not getattr(self, name) > 0.0:
                raise FieldError(name, getattr(self, name), "a positive time in s")


class Recorder:
    """Writes the samples of one axis. Thread-safe; use as a context manager, or call :meth:`close`.

    Never raises after construction; the constructor raises InputError on a bad configuration only. A directory
    that cannot be made or written to shows in :meth:`counters` and is tried again.
    """

    def __init__(self, config: RecorderConfig) -> None:
        self.config = config
        self._queue: deque[Rows] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = False
        self._counts = {"offered": 0, "written": 0, "dropped": 0, "lost": 0, "errors": 0, "segments": 0, "removed": 0}
        self._salvaged = 0
        self._error = ""
        self._segment: OpenSegment | None = None
        self._claim: IO[bytes] | None = None
        self._ready = False
        self._not_before = 0.0
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
            if self._stop or self._waiting + len(rows) > self.config.queue_samples:
                self._counts["dropped"] += len(rows)
                return False
            self._queue.append(rows)
            self._waiting += len(rows)
        return True

    def counters(self) -> dict[str, Any]:
        """Samples offered, written, dropped (queue full) and lost (disk); segments closed and removed; the last error.

        ``degraded`` is True from a failure of the disk until the next batch is written.
        """
        with self._lock:
            return {
                **self._counts,
                "salvaged": self._salvaged,
                "waiting": self._waiting,
                "degraded": bool(self._error),
                "error": self._error,
            }

    def close(self, timeout_s: float = 10.0) -> bool:
        """Write what waits, close the segment, end the thread. False where that did not end within the time."""
        with self._lock:
            self._stop = True
        self._wake.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            # Reading the flag before the queue: what was handed over before the stop is still written.
            stop = self._stop
            rows = self._take()
            if rows is not None:
                self._write(rows)
            elif stop:
                break
            if not stop:
                self._wake.wait(self.config.flush_s)
        self._close_segment()
        if self._claim is not None:
            self._claim.close()

    def _take(self) -> Rows | None:
        with self._lock:
            parts = list(self._queue)
            self._queue.clear()
            self._waiting = 0
        if not parts:
            return None
        return Rows(
            np.concatenate([p.seq for p in parts]),
            np.concatenate([p.t_s for p in parts]),
            np.concatenate([p.u_V for p in parts]),
            np.concatenate([p.y_um for p in parts]),
            [word for p in parts for word in p.reason],
        )

    def _count(self, **more: int) -> None:
        with self._lock:
            for name, value in more.items():
                self._counts[name] += value

    def _failed(self, error: OSError) -> None:
        self._not_before = time.monotonic() + self.config.retry_s
        with self._lock:
            self._counts["errors"] += 1
            self._error = f"{error.strerror or error}"

    def _prepare(self) -> None:
        self.config.directory.mkdir(parents=True, exist_ok=True)
        if self._claim is None:
            self._claim = claim(self.config.directory)
        if not self._ready:
            self._salvaged = len(salvage(self.config.directory))
            self._ready = True
        self._count(removed=make_room(self.config.directory, self.config.max_bytes))

    def _write(self, rows: Rows) -> None:
        # After a failure nothing is tried for a while, except at the end: a last chance costs nobody anything.
        if time.monotonic() < self._not_before and not self._stop:
            self._count(lost=len(rows))
            return
        done = 0
        try:
            while done < len(rows):
                if self._segment is None:
                    self._prepare()
                    number = next_number(self.config.directory)
                    self._segment = OpenSegment(self.config.directory / f"segment-{number:06d}{OPEN}")
                stop = min(len(rows), done + self.config.segment_rows - self._segment.rows)
                part = Rows(
                    rows.seq[done:stop], rows.t_s[done:stop], rows.u_V[done:stop], rows.y_um[done:stop],
                    rows.reason[done:stop],
                )  # fmt: skip
                self._segment.write(part)
                self._count(written=len(part))
                done = stop
                if self._segment.rows >= self.config.segment_rows:
                    self._close_segment()
            if time.monotonic() >= self._not_before:
                with self._lock:
                    self._error = ""
        except OSError as error:
            self._failed(error)
            self._count(lost=len(rows) - done)
            if self._segment is not None:
                # What this segment already holds is made into Parquet at the next try.
                self._segment.abandon()
                self._segment, self._ready = None, False

    def _close_segment(self) -> None:
        segment, self._segment = self._segment, None
        if segment is None:
            return
        try:
            made = segment.close()
            self._count(segments=int(made is not None))
            self._count(removed=make_room(self.config.directory, self.config.max_bytes))
        except OSError as error:
            segment.abandon()
            self._ready = False
            self._failed(error)
