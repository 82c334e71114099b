"""``dehyst`` with a wall clock that another process can set back.

``python -m lab.testbed.shifted_clock FILE COMMAND ...`` adds the seconds in FILE (8 bytes, a double) to ``time.time``
of this process. The system clock stays as it is: to set it needs rights that a test should not have. On SIGUSR2 the
process writes the stacks of its threads beside FILE.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import struct
import sys
import threading
import time
import traceback
from pathlib import Path

_SECONDS = struct.Struct("<d")


def write_offset(path: Path, seconds: float) -> None:
    """Set the clock of the process that runs with ``path``. The file is mapped, so it is written in place."""
    if not path.exists():
        path.write_bytes(_SECONDS.pack(seconds))
        return
    with path.open("r+b") as file:
        file.write(_SECONDS.pack(seconds))


def patch_clock(path: Path) -> None:
    """Make ``time.time`` and ``time.time_ns`` of this process follow the file."""
    real, real_ns = time.time, time.time_ns
    with path.open("rb") as file:
        shared = mmap.mmap(file.fileno(), _SECONDS.size, access=mmap.ACCESS_READ)

    def offset() -> float:
        return float(_SECONDS.unpack_from(shared)[0])

    time.time = lambda: real() + offset()
    time.time_ns = lambda: real_ns() + round(1e9 * offset())


def write_stacks_on_signal(folder: Path) -> None:
    """Let this process append the stacks of all its threads to a file in ``folder`` on SIGUSR2.

    Not by `faulthandler`: it walks the frames of threads that run meanwhile, and ended a service that way. The file has
    a first line as soon as the signal may be sent; before that it would end the process.
    """
    path = stacks_file(folder, os.getpid())

    def write(*_: object) -> None:
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        parts = [
            f"{names.get(number, number)}:\n{''.join(traceback.format_stack(frame))}"
            for number, frame in sys._current_frames().items()
        ]
        with contextlib.suppress(OSError), path.open("a", encoding="utf-8") as file:
            file.write("\n".join([f"--- {time.monotonic():.3f} s", *parts, ""]))

    signal.signal(signal.SIGUSR2, write)
    path.write_text("Stacks of all threads, the innermost call last, each time that nobody was answered.\n")


def stacks_file(folder: Path, pid: int) -> Path:
    """The file to which the process ``pid`` writes its stacks."""
    return folder / f"stacks-{pid}.txt"


if __name__ == "__main__":
    patch_clock(Path(sys.argv[1]))
    write_stacks_on_signal(Path(sys.argv[1]).parent)
    from lab.cli import main

    sys.exit(main(sys.argv[2:]))
