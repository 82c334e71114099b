"""Segments of a recording on disk: open ones as journals that survive a crash, closed ones as Parquet.

A Parquet file is worthless until its end is written; a journal is whole up to its last row. So the open segment is a
journal, and closing it writes the Parquet file beside it under another name, syncs it and renames it. The journal of
the segment closed last stays until the next is closed: a restart goes on from it behind its checkpoint.
``python -m service.storage.segments DIRECTORY`` closes what lies open there; the recorder has that done by a process of
its own, because it takes memory and the interpreter's lock that the service needs for better things.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import subprocess
import sys
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from service.background.priority import step_back
from service.storage.atomic_write import PART, atomic_write
from service.storage.journal import INDEX_MODULUS, Rows, read_journal

OPEN, CLOSED = ".journal", ".parquet"
#: The name of the journal of a segment that is Parquet already.
DONE: Final = ".done"
#: Journals' names begin so: what reads the folder as one data set, as pyarrow does, passes over such files.
HIDDEN: Final = "_"
#: In place of the journal that is being written, where none is.
_NONE: Final = "-"
#: Longest time that the closing of a segment may take, s.
_CONVERT_S: Final = 120.0


def schema() -> Any:
    """Columns of a segment: the canonical ones, ``seq``, and ``reason`` as a dictionary of words."""
    import pyarrow as pa

    numbers = [("t_s", pa.float64()), ("u_V", pa.float64()), ("y_um", pa.float64())]
    return pa.schema([("seq", pa.int64()), *numbers, ("reason", pa.string())])


def convert(journal: Path) -> Path | None:
    """Turn a journal, cut off or whole, into Parquet. Returns its path, None where it held no rows.

    The journal stays, as ``.done``; one that held nothing goes.
    """
    rows, _ = read_journal(journal)
    if not len(rows):
        journal.unlink(missing_ok=True)
        return None
    import pyarrow as pa
    from pyarrow import parquet

    target = journal.with_name(journal.name.removeprefix(HIDDEN)).with_suffix(CLOSED)
    columns = [pa.array(column) for column in (rows.seq, rows.t_s, rows.u_V, rows.y_um)]
    table = pa.table([*columns, pa.array(rows.reason, pa.string())], schema=schema())
    with atomic_write(target) as file:
        parquet.write_table(table, file, compression="zstd", use_dictionary=["reason"])
    os.replace(journal, journal.with_suffix(DONE))
    return target


def close_left_open(directory: Path, but: Path | None = None) -> list[Path]:
    """Close the journals there, remove half-written files and journals no longer needed.

    ``but``: the journal that is being written; it and those after it are left alone. Returns the segments made.
    Raises OSError as the disk does.
    """
    for part in directory.glob(f"*segment-*{PART}"):
        part.unlink(missing_ok=True)
    left = [path for path in left_open(directory) if but is None or number_of(path) < number_of(but)]
    made = [path for path in map(convert, left) if path is not None]
    # The newest one that is done is what a restart may need.
    for done in _sorted(directory, DONE)[:-1]:
        done.unlink(missing_ok=True)
    return made


class Closer:
    """:func:`close_left_open` in a process of its own. Raises OSError where it cannot be started."""

    def __init__(self, directory: Path, but: Path | None) -> None:
        root = Path(__file__).resolve().parents[2]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.storage.segments", str(directory), str(but or _NONE)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            # Ctrl-C is for the service, which then waits for this one.
            start_new_session=True,
        )

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def result(self, timeout_s: float = _CONVERT_S) -> int:
        """Wait for it; the number of segments made. Raises OSError with its words where it failed."""
        try:
            out, err = self._process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            raise OSError(f"closing a segment took more than {timeout_s:g} s") from None
        if self._process.returncode:
            words = err.strip().splitlines() or [f"ended with status {self._process.returncode}"]
            raise OSError(f"closing a segment: {words[-1]}")
        return int(out)


def rows_behind(directory: Path, index: int) -> Rows | None:
    """The rows that were handled from the ``index``-th sample on, in that order, as far as none is missing.

    None where the journals do not reach back that far, or hold nothing newer.
    """
    columns: list[list[Any]] = [[] for _ in range(5)]
    for path in [*_sorted(directory, DONE), *_sorted(directory, OPEN)]:
        try:
            rows, numbers = read_journal(path)
        except OSError:
            continue
        # How far behind the checkpoint, in a count that wraps around.
        place = (numbers - index + INDEX_MODULUS // 2) % INDEX_MODULUS - INDEX_MODULUS // 2
        starts = [0, *(np.nonzero(np.diff(place) != 1)[0] + 1).tolist()] if len(rows) else []
        for start, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
            have, at = len(columns[0]), int(place[start])
            skip = max(0, -at)
            if at > have or skip >= stop - start:
                continue
            # Samples that were handled again, by an instance that took an older state over, replace what was before.
            run = rows.part(start + skip, stop)
            parts: tuple[Any, ...] = (run.seq, run.t_s, run.u_V, run.y_um, run.reason)
            for column, more in zip(columns, parts, strict=True):
                column[at + skip :] = list(more)
    if not columns[0]:
        return None
    seq, t_s, u_V, y_um, reason = columns
    return Rows(np.array(seq, dtype=np.int64), np.array(t_s), np.array(u_V), np.array(y_um), reason)


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
    stem = path.stem.removeprefix(HIDDEN)
    return int(stem.removeprefix("segment-")) if stem.startswith("segment-") and stem[8:].isdigit() else -1


def segments(directory: Path) -> list[Path]:
    """Closed segments, oldest first."""
    return _sorted(directory, CLOSED)


def left_open(directory: Path) -> list[Path]:
    """Journals there, oldest first: of who records into it now, or of who was killed."""
    return _sorted(directory, OPEN)


def journal_of(directory: Path, number: int) -> Path:
    """Where the open segment of that number is written."""
    return directory / f"{HIDDEN}segment-{number:06d}{OPEN}"


def next_number(directory: Path) -> int:
    """One more than any segment there has, open or closed: names are never used twice."""
    taken = [number_of(p) for p in directory.glob("*segment-*")]
    return max([0, *taken]) + 1


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


def _sorted(directory: Path, suffix: str) -> list[Path]:
    return sorted((p for p in directory.glob(f"*segment-*{suffix}") if number_of(p) >= 0), key=number_of)


def main() -> int:
    """Close what lies open in the directory named first; prints how many.

    A recorder, which holds the directory, names second the journal that it writes; without it nobody may hold it.
    """
    directory, but = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    if but not in (None, _NONE):
        # Samples go on coming; nobody waits for this.
        step_back()
    try:
        if but is None:
            held = claim(directory)  # noqa: F841 - until the process ends
        print(len(close_left_open(directory, None if but in (None, _NONE) else Path(but))))
    except OSError as error:
        print(f"{error.strerror or error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
