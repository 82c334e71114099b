"""The journal of operations: one JSON line for each, appended, in a folder of the axis."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

FILE: Final = "operations.jsonl"
#: Beyond this size the journal begins anew and the one before is kept beside it as operations.1.jsonl, bytes.
MAX_BYTES: Final = 8 * 2**20


class Journal:
    """Appends what operators did. Never raises: a full disk must not keep an operator from freezing an axis.

    Parameters
    ----------
    folder : where ``operations.jsonl`` lies; None: nothing is written.
    wall_s : the time of day, s since 1970.
    """

    def __init__(
        self, folder: Path | None, wall_s: Callable[[], float] = time.time, max_bytes: int = MAX_BYTES
    ) -> None:
        self.path = None if folder is None else folder / FILE
        #: Operations that could not be written down.
        self.lost = 0
        self._wall_s = wall_s
        self._max_bytes = max_bytes

    def write(self, entry: Mapping[str, Any]) -> bool:
        """Append ``entry`` with the time of day; False where that failed. On the disk when it returns."""
        if self.path is None:
            return True
        line = json.dumps({"time_unix_s": self._wall_s(), **entry}, default=str).encode() + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists() and self.path.stat().st_size + len(line) > self._max_bytes:
                self.path.replace(self.path.with_name("operations.1.jsonl"))
            # One write of a whole line in append mode: lines of two processes do not mix.
            handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                if os.write(handle, line) != len(line):
                    raise OSError("written in part")
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError:
            self.lost += 1
            return False
        return True
