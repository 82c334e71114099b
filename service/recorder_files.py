"""Segments of a recording on disk: open ones as Arrow streams that survive a crash, closed ones as Parquet.

A Parquet file is worthless until its end is written; an Arrow stream is whole up to its last batch. So the open
segment is a stream, and closing it writes the Parquet file beside it under another name, syncs it, renames it, and
only then removes the stream. A stream that a crash left behind is closed at the next start.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.errors import FieldError

OPEN, CLOSED, PART = ".arrows", ".parquet", ".part"


@dataclass(frozen=True, slots=True)
class Rows:
    """n samples as they are recorded; ``reason`` is what the learner did with each (``learnt``, or the gate)."""

    seq: NDArray[np.int64]
    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    reason: list[str]

    def __post_init__(self) -> None:
        n = len(self.seq)
        for name in ("t_s", "u_V", "y_um", "reason"):
            if len(getattr(self, name)) != n:
                raise FieldError(name, f"{len(getattr(self, name))} values", f"{n}, as many as seq")

    def __len__(self) -> int:
        return len(self.seq)


def schema() -> Any:
    """Columns of a segment: the canonical ones, ``seq``, and ``reason`` as a dictionary of words."""
    import pyarrow as pa

    numbers = [("t_s", pa.float64()), ("u_V", pa.float64()), ("y_um", pa.float64())]
    return pa.schema([("seq", pa.int64()), *numbers, ("reason", pa.string())])


class OpenSegment:
    """The segment being written. Every method raises OSError as the disk does."""

    def __init__(self, path: Path) -> None:
        import pyarrow as pa

        self.path = path
        self.rows = 0
        self._file = open(path, "xb")  # noqa: SIM115 - lives as long as the segment
        try:
            self._stream = pa.ipc.new_stream(self._file, schema())
        except BaseException:
            self._file.close()
            path.unlink(missing_ok=True)
            raise

    def write(self, rows: Rows) -> None:
        """Append one batch and hand it to the operating system: a killed process loses nothing of it."""
        import pyarrow as pa

        columns = [pa.array(column) for column in (rows.seq, rows.t_s, rows.u_V, rows.y_um)]
        batch = pa.record_batch([*columns, pa.array(rows.reason, pa.string())], schema=schema())
        self._stream.write_batch(batch)
        self._file.flush()
        self.rows += len(rows)

    def abandon(self) -> None:
        """Let go of the file as it is, after an error."""
        with contextlib.suppress(OSError, ValueError):
            self._file.close()

    def close(self) -> Path | None:
        """End the stream and turn it into Parquet; the path, None where the segment held nothing."""
        self._stream.close()
        self._file.close()
        return convert(self.path)


def convert(stream: Path) -> Path | None:
    """Turn an Arrow stream, cut off or whole, into Parquet. Returns its path, None where it held no rows."""
    import pyarrow as pa
    from pyarrow import parquet

    batches = []
    with open(stream, "rb") as file:
        try:
            for batch in pa.ipc.open_stream(file):
                batches.append(batch)
        except (pa.ArrowInvalid, OSError, EOFError):
            # Cut off in the middle of a batch: what came before it is whole.
            pass
    target: Path | None = None
    if batches:
        target = stream.with_suffix(CLOSED)
        part = stream.with_suffix(PART)
        try:
            with open(part, "wb") as out:
                table = pa.Table.from_batches(batches)
                parquet.write_table(table, out, compression="zstd", use_dictionary=["reason"])
                out.flush()
                os.fsync(out.fileno())
            os.replace(part, target)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise
    stream.unlink(missing_ok=True)
    return target


def claim(directory: Path) -> IO[bytes]:
    """Hold the directory for one process, until the file is closed. Raises BlockingIOError where another has it.

    Two recorders in one directory would take each other's open segment for the remains of a crash.
    """
    lock = open(directory / ".lock", "wb")  # noqa: SIM115 - held as long as the recorder lives
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.close()
        raise BlockingIOError(error.errno, f"another process records into {directory}") from error
    return lock


def number_of(path: Path) -> int:
    """The running number in a segment's name, -1 where it is no segment of ours."""
    stem = path.stem
    return int(stem.removeprefix("segment-")) if stem.startswith("segment-") and stem[8:].isdigit() else -1


def segments(directory: Path) -> list[Path]:
    """Closed segments, oldest first."""
    return sorted((p for p in directory.glob(f"segment-*{CLOSED}") if number_of(p) >= 0), key=number_of)


def next_number(directory: Path) -> int:
    """One more than any segment there has, open or closed: names are never used twice."""
    taken = [number_of(p) for p in directory.glob("segment-*")]
    return max([0, *taken]) + 1


def salvage(directory: Path) -> list[Path]:
    """Close the streams that a crash left behind, and remove half-written files. Returns the segments made."""
    for part in directory.glob(f"segment-*{PART}"):
        part.unlink(missing_ok=True)
    made = [convert(stream) for stream in sorted(directory.glob(f"segment-*{OPEN}"), key=number_of)]
    return [path for path in made if path is not None]


def make_room(directory: Path, max_bytes: int) -> int:
    """Remove the oldest closed segments until all of them fit into ``max_bytes``. Returns how many went."""
    sizes: list[tuple[Path, int]] = []
    for path in segments(directory):
        with contextlib.suppress(FileNotFoundError):
            sizes.append((path, path.stat().st_size))
    total, removed = sum(size for _, size in sizes), 0
    for path, size in sizes:
        if total <= max_bytes:
            break
        path.unlink(missing_ok=True)
        total -= size
        removed += 1
    return removed
