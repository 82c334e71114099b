"""The record of a run of a benchmark: what it came to as JSON values, how long it took, and why it failed."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dehyst.service.storage.output import append_line

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


def why_failed(record: Record) -> str:
    """The last line of the traceback."""
    return f"FAILED: {record['failed'].strip().splitlines()[-1]}"


def read_lines(paths: Iterable[Path]) -> list[Record]:
    """The records in files of JSON lines; an incomplete last line is left out."""
    records = []
    for path in paths:
        for text in path.read_text(encoding="utf-8").splitlines():
            try:
                records.append(json.loads(text))
            except json.JSONDecodeError:
                print(f"{path}: left out a line that is cut off", file=sys.stderr)
    return records


def add_line(path: Path | None, record: Record) -> None:
    """Add a record to a file of JSON lines, if there is one."""
    if path is not None:
        append_line(path, json.dumps(record).encode() + b"\n")
