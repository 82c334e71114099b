"""Segments of a recording on disk: open ones as journals that survive a crash, closed ones as Parquet.

A Parquet file cannot be read until its end is written; a journal can be read up to its last row. The open segment is
therefore a journal. Closing it writes a Parquet file under a temporary name, syncs it and renames it. The journal of
the newest closed segment stays until the next segment is closed: a restart learns the samples after its checkpoint from
it.

The recorder has segments closed by a `BackgroundJob`, which runs this module: the conversion needs memory and the
interpreter's lock, which would delay the service. At its end the recorder closes them itself.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dehyst.service.background.job import BackgroundJob, run_worker
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.storage.output import PART, atomic_write
from dehyst.service.storage.owner import is_still_at, owner_of

# --- The journal of a recording: samples appended as rows of fixed size, readable up to the last row after any crash.
#
# A file has a header of 16 bytes, then records of 40 bytes: seq (i64), t_s, u_V, y_um (f64), index (u32), reason (u16)
# and a mark (u16) that shows whether the record is complete. ``index`` counts the samples of the axis in the order in
# which they were handled, modulo 2^32; a restart uses it to find the samples after a checkpoint. A record with reason
# 65535 defines a word: ``seq`` holds its number, the next 24 bytes its UTF-8 text. All values are little-endian.

HEADER: Final = b"dehyst journal 1"
RECORD: Final = np.dtype(
    [
        ("seq", "<i8"), ("t_s", "<f8"), ("u_V", "<f8"), ("y_um", "<f8"),
        ("index", "<u4"), ("reason", "<u2"), ("mark", "<u2"),
    ]
)  # fmt: skip
_MARK: Final = 0xD5A7
_WORD: Final = 0xFFFF
_WORD_BYTES: Final = 24
INDEX_MODULUS: Final = 2**32


#: n samples in memory; ``reason`` of each is ``learnt``, or the gate that refused it.
ROWS: Final = np.dtype(
    [("seq", "i8"), ("t_s", "f8"), ("u_V", "f8"), ("y_um", "f8"), ("index", "i8"), ("reason", "U24")]
)
Rows = NDArray[np.void]


def rows_of(seq: ArrayLike, t_s: ArrayLike, u_V: ArrayLike, y_um: ArrayLike, reason: str | list[str]) -> Rows:
    """(n,) rows, copied; ``reason`` is one word for all or one for each. Raises FieldError on unequal lengths."""
    rows = np.zeros(np.size(seq), dtype=ROWS)
    for name, column in (("seq", seq), ("t_s", t_s), ("u_V", u_V), ("y_um", y_um), ("reason", reason)):
        if name != "reason" and np.size(column) != rows.size:
            raise FieldError(name, f"{np.size(column)} values", f"{rows.size}, as many as seq")
        rows[name] = column
    return rows


class Journal:
    """A journal being written. Methods raise OSError if the disk fails, except `close`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = 0
        self._words: dict[str, int] = {}
        self._size = 0
        self._fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_APPEND, 0o644)
        try:
            self._put(HEADER)
            self._size = len(HEADER)
        except BaseException:
            os.close(self._fd)
            path.unlink(missing_ok=True)
            raise

    def write(self, rows: Rows) -> int:
        """Append ``rows``: all of them or none. Returns the bytes that it wrote.

        The operating system has the rows when this returns, so a killed process does not lose them.
        """
        words, reasons = dict(self._words), rows["reason"].tolist()
        new = [word for word in dict.fromkeys(reasons) if word not in words]
        for word in new:
            words[word] = len(words) % _WORD
        records = np.zeros(len(new) + len(rows), dtype=RECORD)
        for at, word in enumerate(new):
            records[at] = _definition(words[word], word)
        body = records[len(new) :]
        for name in ("seq", "t_s", "u_V", "y_um"):
            body[name] = rows[name]
        body["index"] = rows["index"] % INDEX_MODULUS
        body["reason"] = [words[word] for word in reasons]
        records["mark"] = _MARK
        self._put(records.tobytes())
        self._size += records.nbytes
        self._words = words
        self.rows += len(rows)
        return int(records.nbytes)

    @property
    def vanished(self) -> bool:
        """Whether the file is no longer at its path: further rows would be lost."""
        return not is_still_at(self._fd, self.path)

    def handle(self) -> int:
        """A duplicate descriptor of the file; the caller closes it."""
        return os.dup(self._fd)

    def close(self) -> None:
        """Close the file; never raises."""
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _put(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except OSError:
            # A full disk may have stored a part of a row; rows after an incomplete one could not be read.
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)
            raise


class Syncer:
    """Syncs a journal to the disk at intervals, in a thread of its own.

    A sync may take long. In the thread that writes, it would leave samples in memory, where a crash loses them.
    """

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._at = time.monotonic()
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None

    def look(self, journal: Journal) -> None:
        """Start a sync if one is due. Raises OSError if the previous one failed."""
        error, self._error = self._error, None
        if error is not None:
            raise error
        now = time.monotonic()
        if now - self._at < self._every_s or (self._thread is not None and self._thread.is_alive()):
            return
        self._at = now
        self._thread = threading.Thread(target=self._sync, args=(journal.handle(),), name="sync", daemon=True)
        self._thread.start()

    def _sync(self, handle: int) -> None:
        try:
            os.fsync(handle)
        except OSError as error:
            self._error = error
        finally:
            os.close(handle)


def _definition(number: int, word: str) -> Any:
    text = word.encode()[:_WORD_BYTES].ljust(_WORD_BYTES, b"\0")
    numbers = np.frombuffer(text, dtype="<f8")
    return (number, *numbers, 0, _WORD, _MARK)


def read_journal(path: Path) -> Rows:
    """The rows up to the first incomplete record. Raises OSError if the disk fails."""
    data = path.read_bytes()
    if data[: len(HEADER)] != HEADER:
        data = HEADER
    count = (len(data) - len(HEADER)) // RECORD.itemsize
    records = np.frombuffer(data, dtype=RECORD, count=count, offset=len(HEADER))
    whole = records["mark"] == _MARK
    if not whole.all():
        records = records[: int(np.argmin(whole))]
    definitions = records["reason"] == _WORD
    words = {
        int(record["seq"]): record.tobytes()[8 : 8 + _WORD_BYTES].rstrip(b"\0").decode(errors="replace")
        for record in records[definitions]
    }
    body = records[~definitions]
    reasons = [words.get(number, "unknown") for number in body["reason"].tolist()]
    rows = rows_of(body["seq"], body["t_s"], body["u_V"], body["y_um"], reasons)
    rows["index"] = body["index"]
    return rows


OPEN, CLOSED = ".journal", ".parquet"
#: File that says whose recording a folder holds, see `FolderOwner`.
LOCK: Final = ".lock"
#: Suffix of the journal of a closed segment.
DONE: Final = ".done"
#: Prefix of the names of journals: readers that take the folder as one data set, such as pyarrow, skip such files.
HIDDEN: Final = "_"
#: Longest time that the process which closes segments may take, s.
_CLOSING_S: Final = 3600.0


#: Columns of a segment.
COLUMNS: Final = ("seq", "t_s", "u_V", "y_um", "reason")


def convert(journal: Path) -> Path | None:
    """Convert a journal, complete or cut off, to Parquet. Returns the path of the segment; None if it has no rows.

    The journal is kept with the suffix ``.done``; a journal without rows is removed.
    """
    rows = read_journal(journal)
    if not len(rows):
        journal.unlink(missing_ok=True)
        return None
    import pyarrow as pa
    from pyarrow import parquet

    target = journal.with_name(journal.name.removeprefix(HIDDEN)).with_suffix(CLOSED)
    table = pa.table([pa.array(rows[name].tolist() if name == "reason" else rows[name]) for name in COLUMNS], COLUMNS)
    with atomic_write(target) as file:
        parquet.write_table(table, file, compression="zstd", use_dictionary=["reason"])
    os.replace(journal, journal.with_suffix(DONE))
    return target


def close_left_open(directory: Path, but: Path | None = None) -> list[Path]:
    """Close the open segments in ``directory``; remove incomplete files and journals that are no longer needed.

    ``but`` is the journal that is being written; it and later ones stay open. Returns the new segments. Raises OSError
    if the disk fails.
    """
    for part in directory.glob(f"*segment-*{PART}"):
        part.unlink(missing_ok=True)
    left = [path for path in left_open(directory) if but is None or number_of(path) < number_of(but)]
    made = []
    for path in left:
        # The process of an instance that was killed may still close them, too.
        with contextlib.suppress(FileNotFoundError):
            made.append(convert(path))
    # A restart may need the newest one.
    for done in _sorted(directory, DONE)[:-1]:
        done.unlink(missing_ok=True)
    return [path for path in made if path is not None]


def closing(directory: Path, but: Path) -> BackgroundJob:
    """`close_left_open` in a process of its own; see `closed_by` for its result."""
    order = {"directory": str(directory), "but": str(but)}
    job = BackgroundJob("dehyst.service.storage.segments", order, {}, _CLOSING_S)
    job.start()
    return job


def closed_by(job: BackgroundJob) -> list[Path]:
    """The new segments of a job that has ended. Raises OSError with its message if it failed."""
    result = job.result or {}
    if "error" in result:
        raise OSError(f"closing a segment: {result['error']}")
    return [Path(path) for path in result.get("closed", ())]


def _close(order: dict[str, Any], _: object) -> dict[str, Any]:
    try:
        return {"closed": [str(path) for path in close_left_open(Path(order["directory"]), Path(order["but"]))]}
    except OSError as error:
        return {"error": error.strerror or str(error)}


def rows_behind(directory: Path, index: int, owner: str) -> SampleBatch | None:
    """The samples from the ``index``-th handled one on, in the order of handling, up to the first missing one.

    Returns None if the journals do not reach back to that sample, hold no later one, or are not those of ``owner``
    (see `FolderOwner`).
    """
    if owner_of(directory, LOCK) not in ("", owner):
        return None
    found = np.zeros(0, dtype=ROWS)
    for path in [*_sorted(directory, DONE), *_sorted(directory, OPEN)]:
        with contextlib.suppress(OSError):
            rows = read_journal(path)
            # Position relative to ``index``; the stored count wraps around.
            place = (rows["index"] - index + INDEX_MODULUS // 2) % INDEX_MODULUS - INDEX_MODULUS // 2
            for run in np.split(np.arange(len(rows)), np.nonzero(np.diff(place) != 1)[0] + 1):
                at = int(place[run[0]]) if run.size else 0
                skip = max(0, -at)
                if at <= len(found) and skip < run.size:
                    # An instance that continued from an older state handles samples again: later rows replace earlier.
                    found = np.concatenate([found[: at + skip], rows[run[skip:]]])
    return SampleBatch(*(found[name].copy() for name in COLUMNS[:4])) if found.size else None


def number_of(path: Path) -> int:
    """The number in the name of a segment; -1 if the name is not that of a segment."""
    stem = path.stem.removeprefix(HIDDEN)
    return int(stem.removeprefix("segment-")) if stem.startswith("segment-") and stem[8:].isdigit() else -1


def segments(directory: Path) -> list[Path]:
    """Closed segments, oldest first."""
    return _sorted(directory, CLOSED)


def left_open(directory: Path) -> list[Path]:
    """Journals of open segments, oldest first: of the present recorder, or of one that was killed."""
    return _sorted(directory, OPEN)


def journal_of(directory: Path, number: int) -> Path:
    """The path of the journal of the open segment ``number``."""
    return directory / f"{HIDDEN}segment-{number:06d}{OPEN}"


def next_number(directory: Path) -> int:
    """One more than the number of any segment, open or closed, so that no name is used twice."""
    taken = [number_of(p) for p in directory.glob("*segment-*")]
    return max([0, *taken]) + 1


def make_room(directory: Path, max_bytes: int, coming_bytes: int = 0) -> int:
    """Remove the oldest closed segments until all files of the recording and ``coming_bytes`` more fit into
    ``max_bytes``: journals count too, but are never removed. Returns the number removed."""
    sizes: dict[Path, int] = {}
    for path in directory.glob("*segment-*"):
        with contextlib.suppress(FileNotFoundError):
            sizes[path] = path.stat().st_size
    total, removed = sum(sizes.values()) + coming_bytes, 0
    for path, size in [(path, sizes[path]) for path in segments(directory) if path in sizes]:
        if total <= max_bytes:
            break
        path.unlink(missing_ok=True)
        total -= size
        removed += 1
    return removed


def _sorted(directory: Path, suffix: str) -> list[Path]:
    return sorted((p for p in directory.glob(f"*segment-*{suffix}") if number_of(p) >= 0), key=number_of)


if __name__ == "__main__":
    sys.exit(run_worker(_close))
