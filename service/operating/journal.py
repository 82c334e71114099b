"""The journal of operations: one JSON line per operation in a folder of the axis."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

FILE: Final = "operations.jsonl"
#: Size, bytes, beyond which the journal is renamed to operations.1.jsonl and a new one is started.
MAX_BYTES: Final = 8 * 2**20


class Journal:
    """Appends operations. Never raises: with a full disk an operator must still be able to freeze an axis.

    Parameters
    ----------
    folder : of ``operations.jsonl``; None: nothing is written.
    wall_s : returns the time, s since 1970. max_bytes : size at which a new file is started.
    """

    def __init__(
        self, folder: Path | None, wall_s: Callable[[], float] = time.time, max_bytes: int = MAX_BYTES
    ) -> None:
        self.path = None if folder is None else folder / FILE
        #: Operations that could not be written.
        self.lost = 0
        self._wall_s = wall_s
        self._max_bytes = max_bytes

    def write(self, entry: Mapping[str, Any]) -> bool:
        """Append ``entry`` with the time and sync it to the disk; False if that failed."""
        if self.path is None:
            return True
        line = json.dumps({"time_unix_s": self._wall_s(), **entry}, default=str).encode() + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists() and self.path.stat().st_size + len(line) > self._max_bytes:
                self.path.replace(self.path.with_name("operations.1.jsonl"))
            # One write per line in append mode, so that lines of two processes do not mix.
            handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                if os.write(handle, line) != len(line):
                    raise OSError("incomplete write")
                os.fsync(handle)
            finally:
                os.close(handle)
        except OSError:
            self.lost += 1
            return False
        return True
