"""The record of a run of a benchmark: what it came to as JSON values, how long it took, and why it failed."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

Record = dict[str, Any]


@contextmanager
def recorded(record: Record) -> Iterator[None]:
    """Add the times that the block takes to ``record``, s: ``cpu_s`` and ``wall_s``. If it raises, the record gets the
    traceback as ``failed``, and the other runs go on."""
    begin, begin_cpu = time.perf_counter(), time.process_time()
    try:
        yield
    except Exception:
        record["failed"] = traceback.format_exc()
    record |= {"cpu_s": time.process_time() - begin_cpu, "wall_s": time.perf_counter() - begin}
