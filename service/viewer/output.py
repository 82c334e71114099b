"""A sink in a process of its own behind a bounded queue, so that a slow, dead or stuck viewer holds up nothing else.

A stream to a viewer that has gone blocks its writer for ever. So the writer is a child process, and its queue holds a
bounded number of batches; further batches are dropped and counted. At the end the child has a bounded time to finish
before it is terminated.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import re
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Annotated, Final

from dehyst.adaptive.errors import InputError
from dehyst.service.background.job import step_back
from dehyst.service.config.schema import Setting, check_bounds
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.viewer.records import Record, SceneConfig

_NICE: Final = 5
#: How long a child may draw what waits after its parent has gone, s.
GRACE_S: Final = 5.0
_URL = re.compile(r"rerun(\+https?)?://[^/\s]+/proxy\Z")


@dataclass(frozen=True, slots=True)
class OutputConfig:
    """Where to draw: ``rrd``, a file, or ``connect``, the URL of a viewer; exactly one of them.

    ``queue_batches`` limits the waiting batches; at 0.2 s a batch, 100 of them are 20 s. Raises InputError.
    """

    scene: SceneConfig
    rrd: Path | None = None
    connect: str | None = None
    recording_id: str | None = None
    queue_batches: Annotated[int, Setting(low=1)] = 100

    def __post_init__(self) -> None:
        if (self.rrd is None) == (self.connect is None):
            raise InputError(f"rrd, connect: got {self.rrd!r} and {self.connect!r}, expected exactly one of them")
        if self.connect is not None and not _URL.match(self.connect):
            raise InputError(f"connect: got {self.connect!r}, expected such as rerun+http://127.0.0.1:9876/proxy")
        check_bounds(self)

    @property
    def name(self) -> str:
        return str(self.rrd) if self.rrd is not None else str(self.connect)


class Output:
    """A running sink; make it in the main thread. Raises InputError if the file cannot be written."""

    def __init__(self, config: OutputConfig) -> None:
        self.config = config
        self.dropped = 0
        if config.rrd is not None:
            make_file(config.rrd)
        # Spawn: zenoh's threads of this process do not survive a fork.
        context = multiprocessing.get_context("spawn")
        self._queue: Queue[Sequence[Record] | None] = context.Queue(config.queue_batches)
        self._process = context.Process(target=_draw, args=(config, self._queue), name="view", daemon=True)
        # Ctrl-C reaches the whole process group; the parent decides when to stop. The child inherits this.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._process.start()
        finally:
            signal.signal(signal.SIGINT, handler)

    @property
    def pid(self) -> int | None:
        """Process id of the child."""
        return self._process.pid

    def offer(self, batch: Sequence[Record]) -> bool:
        """Pass a batch to the child, or drop and count it; never waits. Returns whether it was taken."""
        if self._process.is_alive():
            with contextlib.suppress(queue.Full):
                self._queue.put_nowait(batch)
                return True
        self.dropped += 1
        return False

    def close(self, timeout_s: float = 10.0) -> bool:
        """Draw what waits, for at most ``timeout_s``; then end the child. Returns whether everything was drawn."""
        until = time.monotonic() + timeout_s
        try:
            self._queue.put(None, timeout=max(timeout_s, 1e-3))
        except queue.Full:
            pass
        else:
            self._process.join(max(0.0, until - time.monotonic()))
        finished = self._process.exitcode == 0
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(1.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        # No process reads the rest of the queue: without this the interpreter would wait for it at exit.
        self._queue.cancel_join_thread()
        self._queue.close()
        self._process.close()
        return finished


def make_file(path: Path) -> None:
    """Make an empty file and its folders. Raises InputError if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    except OSError as error:
        raise InputError(f"rrd: cannot write {path}: {error}; name a file in a folder you may write to") from error


def _draw(config: OutputConfig, batches: Queue[Sequence[Record] | None]) -> None:
    """The child process: draw batches until None comes or the parent is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_after, args=(parent,), name="view-end", daemon=True).start()
    # Low priority, in a session of its own: drawing must not take processor time from the service.
    with contextlib.suppress(OSError, AttributeError):
        os.setsid()
    step_back(_NICE)
    from dehyst.service.viewer.rerun_sink import RerunSink
    from dehyst.service.viewer.scene import Scene

    sink = RerunSink(config.scene, rrd=config.rrd, connect=config.connect, recording_id=config.recording_id)
    scene = Scene(sink, config.scene)
    while True:
        try:
            batch = batches.get(timeout=1.0)
        except queue.Empty:
            if not parent.is_alive():
                break
            continue
        if batch is None:
            break
        scene.take_all(batch)
    try:
        sink.close()
    except ServiceError:
        sys.exit(1)  # The parent reports it; Rerun has already printed the reason.


def _end_after(parent: multiprocessing.process.BaseProcess) -> None:
    """End this process some time after its parent. A parent that is killed while it writes a batch leaves half of it in
    the pipe, for the rest of which the main thread would wait for ever."""
    parent.join()
    time.sleep(GRACE_S)
    os._exit(1)
