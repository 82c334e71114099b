"""``dehyst`` with a wall clock that another process can set back.

``python -m dehyst.lab.testbed.shifted_clock FILE COMMAND ...`` adds the seconds in FILE (8 bytes, a double) to
``time.time`` of this process. The system clock stays as it is: to set it needs rights that a test should not have.
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
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


if __name__ == "__main__":
    patch_clock(Path(sys.argv[1]))
    from dehyst.lab.cli import main

    sys.exit(main(sys.argv[2:]))
