"""The journal of a recording: samples appended as rows of fixed size, readable up to the last row after any crash.

A file has a header of 16 bytes, then records of 40 bytes: seq (i64), t_s, u_V, y_um (f64), index (u32), reason (u16)
and a mark (u16) that shows whether the record is complete. ``index`` counts the samples of the axis in the order in
which they were handled, modulo 2^32; a restart uses it to find the samples after a checkpoint. A record with reason
65535 defines a word: ``seq`` holds its number, the next 24 bytes its UTF-8 text. All values are little-endian.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray
from service.protocol.errors import FieldError

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


@dataclass(frozen=True, slots=True)
class Rows:
    """n samples as recorded; ``reason`` of each is ``learnt``, or the gate that refused it."""

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

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """The rows of all ``parts``, in order; ``parts`` must not be empty."""
        if len(parts) == 1:  # the usual case
            return parts[0]
        seq = np.concatenate([part.seq for part in parts])
        t_s, u_V, y_um = (np.concatenate([getattr(p, name) for p in parts]) for name in ("t_s", "u_V", "y_um"))
        return cls(seq, t_s, u_V, y_um, [word for part in parts for word in part.reason])

    def part(self, start: int, stop: int) -> Rows:
        """Rows ``start`` to ``stop`` - 1."""
        if start == 0 and stop == len(self):
            return self
        cut = slice(start, stop)
        return Rows(self.seq[cut], self.t_s[cut], self.u_V[cut], self.y_um[cut], self.reason[cut])


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

    def write(self, rows: Rows, index: NDArray[np.int64]) -> None:
        """Append ``rows`` with the (n,) ``index`` of each: all of them or none.

        The operating system has the rows when this returns, so a killed process does not lose them.
        """
        words = dict(self._words)
        new = [word for word in dict.fromkeys(rows.reason) if word not in words]
        for word in new:
            words[word] = len(words) % _WORD
        records = np.zeros(len(new) + len(rows), dtype=RECORD)
        for at, word in enumerate(new):
            records[at] = _definition(words[word], word)
        body = records[len(new) :]
        body["seq"], body["t_s"], body["u_V"], body["y_um"] = rows.seq, rows.t_s, rows.u_V, rows.y_um
        body["index"] = index % INDEX_MODULUS
        body["reason"] = [words[word] for word in rows.reason]
        records["mark"] = _MARK
        self._put(records.tobytes())
        self._size += records.nbytes
        self._words = words
        self.rows += len(rows)

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


def read_journal(path: Path) -> tuple[Rows, NDArray[np.int64]]:
    """(rows, (n,) index of each), up to the first incomplete record. Raises OSError if the disk fails."""
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
    reason = [words.get(number, "unknown") for number in body["reason"].tolist()]
    t_s, u_V, y_um = (body[name].astype(np.float64) for name in ("t_s", "u_V", "y_um"))
    rows = Rows(body["seq"].astype(np.int64), t_s, u_V, y_um, reason)
    return rows, body["index"].astype(np.int64)
