"""Writes the checkpoints of an axis, and restores an axis from a checkpoint and the journal behind it.

The thread that handles samples only copies the state; a thread of its own encodes and writes it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from adaptive.errors import DehystError, ModelFileError
from adaptive.types import StateDict
from service.intake.sample_queue import SampleQueue
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.storage.checkpoint import CheckpointFolder, CheckpointMeta
from service.storage.segments import rows_behind

#: Most samples that a restart learns again (one minute at 1 kHz, which takes 3 s), and samples per portion.
_MOST_AGAIN = 60_000
_PORTION = 100


class CheckpointKeeper:
    """Writes the checkpoints of one axis. A failing disk costs checkpoints only; they are counted."""

    def __init__(
        self,
        axis: Axis,
        queue: SampleQueue,
        stage: str,
        instance: str,
        folder: CheckpointFolder | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.folder = folder
        self._axis = axis
        self._queue = queue
        self._clock = clock
        self._names = (stage, axis.config.name, instance)
        self._copied: tuple[CheckpointMeta, StateDict] | None = None
        self._ready = threading.Condition()
        self._closing = False
        self._due_at_s = 0.0
        self._written_at_s: float | None = None
        self._counts: dict[str, Any] = {"written": 0, "errors": 0, "degraded": False, "error": ""}
        self._thread = threading.Thread(target=self._run, name=f"checkpoints-{axis.config.name}", daemon=True)
        if folder is not None:
            self._thread.start()

    def on_snapshot(self) -> None:
        """Copy the state if a checkpoint is due. Call it in the thread of the axis, right after a snapshot."""
        now_s = self._clock()
        if self.folder is not None and now_s >= self._due_at_s:
            self._due_at_s = now_s + self._axis.config.checkpoint_s
            self._copy()

    def write_now(self, timeout_s: float = 2.0) -> None:
        """Write a checkpoint of the present state. Raises ServiceError if the learner does not respond in time."""
        if self.folder is not None:
            self._queue.call(self._copy, timeout_s)

    def copy_now(self) -> None:
        """As `write_now`, in the thread that handles samples."""
        if self.folder is not None:
            self._copy()

    def state(self, timeout_s: float = 2.0) -> tuple[CheckpointMeta, StateDict]:
        """(meta, copy of the state), for a standby. Raises ServiceError if the learner does not respond in time."""
        return self._queue.call(lambda: (self._meta(), self._axis.state_dict()), timeout_s)

    def counters(self) -> dict[str, Any] | None:
        """Checkpoints written, age of the newest in s, failures of the disk; None if no checkpoints are written."""
        if self.folder is None:
            return None
        at = self._written_at_s
        return {**self._counts, "age_s": None if at is None else time.monotonic() - at}

    def close(self) -> None:
        """Write the last state and end the thread. Call it after the thread that handles samples has ended."""
        if self.folder is None:
            return
        self._copy()
        with self._ready:
            self._closing = True
            self._ready.notify()
        self._thread.join(10.0)

    def _meta(self) -> CheckpointMeta:
        stage, name, instance = self._names
        axis = self._axis
        meta = CheckpointMeta(stage, name, axis.dt_s, axis.handled_seq, axis.sequence.received, instance=instance)
        return replace(meta, time_unix_s=time.time())

    def _copy(self) -> None:
        meta = self._meta()
        copied = (meta, self._axis.state_dict())
        with self._ready:
            # Replaces a copy that has not been written yet.
            self._copied = copied
            self._ready.notify()

    def _run(self) -> None:
        assert self.folder is not None
        while True:
            with self._ready:
                while self._copied is None and not self._closing:
                    self._ready.wait()
                if self._copied is None:
                    return
                (meta, state), self._copied = self._copied, None
            try:
                self.folder.write(meta, state)
                self._counts.update(written=self._counts["written"] + 1, degraded=False, error="")
                self._written_at_s = time.monotonic()
            except (OSError, DehystError, ValueError) as error:
                words = (isinstance(error, OSError) and error.strerror) or str(error)
                if not self._counts["degraded"]:
                    self._axis.note("checkpoint_failed", f"{words}; tried again")
                self._counts.update(errors=self._counts["errors"] + 1, degraded=True, error=words)


def restore_newest(axis: Axis, folder: CheckpointFolder) -> int | None:
    """Restore ``axis`` from the newest checkpoint that is complete and matches; returns its number, None for none.

    A refused checkpoint is noted as an event with the reason, and the previous one is tried.
    """
    for number in folder.numbers():
        try:
            meta, state = folder.read(number)
            axis.restore(state)
        except ModelFileError as error:
            axis.note("checkpoint_refused", f"checkpoint {number}: {error}")
            continue
        axis.note("restored", f"from checkpoint {number}, sample {meta.seq}", checkpoint=number)
        return number
    return None


def learn_again(axis: Axis, recordings: Path) -> int:
    """Learn the samples after the restored state again, from the journals in the folder ``recordings``.

    Returns the number of samples. They are not recorded a second time.
    """
    rows = rows_behind(recordings, axis.sequence.received)
    if rows is None:
        return 0
    first = max(0, len(rows) - _MOST_AGAIN)
    for start in range(first, len(rows), _PORTION):
        part = rows.part(start, start + _PORTION)
        axis.handle(SampleBatch(part.seq, part.t_s, part.u_V, part.y_um))
    axis.note("learnt_again", f"{len(rows) - first} samples from the journal")
    return len(rows) - first
